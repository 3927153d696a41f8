"""A bundle may come from anybody: broken and malicious ones give a one-line error; nothing runs or is written."""

import contextlib
import json
import os
import pickle
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from bundles import bundle_of, policy_of
from hypothesis import given, settings
from hypothesis import strategies as st

from delayrl import deploy
from delayrl.agents.normalised import Moments
from delayrl.cli.main import main
from delayrl.deploy import Bundle, load_bundle
from delayrl.deploy.backends.network import parse
from delayrl.deploy.backends.numpy_policy import numpy_policy
from delayrl.deploy.export import network_of
from delayrl.deploy.files import DOCUMENT, GRAPH, WEIGHTS, checksum, read_files, seal, write_files
from delayrl.deploy.packing import check_same, pack
from delayrl.errors import DelayRLError
from delayrl.play.policy import Policy


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bundle_of(tmp_path_factory.mktemp("original") / "bundle", policy_of("vdpo"))


@pytest.fixture
def bundle(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "bundle"))


def refused(path: Path, words: str, backend: str = "numpy") -> None:
    with pytest.raises(DelayRLError) as error:
        load_bundle(path, backend)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 400


def forge(bundle: Path, change: Callable[[dict[str, Any]], Any] | None = None, **files: bytes) -> None:
    """Write what an attacker can write: a changed bundle with valid checksums."""
    document = json.loads((bundle / DOCUMENT).read_text())
    if change is not None:
        change(document)
    content = {name: (bundle / name).read_bytes() for name in (WEIGHTS, GRAPH)}
    content |= {{"weights": WEIGHTS, "graph": GRAPH}[name]: data for name, data in files.items()}
    for name, data in seal({k: v for k, v in document.items() if k not in ("files", "checksum")}, content).items():
        (bundle / name).write_bytes(data)


def test_intact_bundles_load(bundle: Path) -> None:
    policy = load_bundle(bundle)
    assert (policy.obs_size, policy.action_size, policy.max_age, policy.dt) == (10, 2, 4, 0.02)
    assert policy.metadata["env"] == "Reacher-v5"
    forge(bundle)  # forging alone breaks nothing
    (bundle / "README.md").write_text("a model card may lie beside it")
    assert load_bundle(bundle, "onnx").metadata["checksum"] == policy.metadata["checksum"]


@pytest.mark.parametrize(
    ("obs", "actions", "age", "words"),
    [
        (np.zeros(9), np.zeros((4, 2)), 0, "size 10; got shape (9,)"),
        (np.zeros(10), np.zeros((3, 2)), 0, "history of shape (4, 2); got (3, 2)"),
        (np.zeros(10), np.zeros((4, 2)), 5, "ages 0..4; got 5"),
        (np.zeros(10), np.zeros((4, 2)), -1, "ages 0..4; got -1"),
        (np.zeros(10), np.zeros((4, 2)), 1.5, "whole steps; got 1.5"),
        (np.full(10, np.nan), np.zeros((4, 2)), 0, "not a finite number"),
        (np.full(10, np.inf), np.zeros((4, 2)), 3, "not a finite number"),
        (np.zeros(10), np.full((4, 2), np.nan), 1, "not a finite number"),
        (np.full(10, 1e39), np.zeros((4, 2)), 0, "not a finite number"),
        ("abcd", np.zeros((4, 2)), 0, "arrays of numbers"),
        (np.zeros(10), [[1.0], [1.0, 2.0]], 0, "arrays of numbers"),
        ([10**400] * 10, np.zeros((4, 2)), 0, "arrays of numbers"),
        (np.full(10, 3e38), np.zeros((4, 2)), 2, "so large"),
    ],
)
def test_calls_that_cannot_be_answered(original: Path, obs: Any, actions: Any, age: int, words: str) -> None:
    for backend in ("numpy", "onnx"):
        with pytest.raises(DelayRLError, match=words.replace("(", r"\(").replace(")", r"\)")):
            load_bundle(original, backend)(obs, actions, age)


def test_no_bundle(tmp_path: Path, original: Path) -> None:
    refused(tmp_path / "nowhere", "not a folder")
    refused(tmp_path, "it has no bundle.json")
    refused(original / WEIGHTS, "not a folder")
    with pytest.raises(DelayRLError, match="unknown backend 'torch'; there are numpy, onnx, jax"):
        load_bundle(original, "torch")


@pytest.mark.parametrize(("module", "error"), [("jax.numpy", DelayRLError), ("arm", ModuleNotFoundError)])
def test_an_extra_that_is_not_installed(module: str, error: type, monkeypatch: pytest.MonkeyPatch) -> None:
    def lacks(name: str) -> None:
        raise ModuleNotFoundError(name=module)

    monkeypatch.setattr("delayrl.errors.import_module", lacks)
    with pytest.raises(error, match="train" if error is DelayRLError else None):
        deploy.export_run  # noqa: B018


def test_a_backend_that_is_not_installed(original: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "delayrl.deploy.backends.jax_policy", raising=False)
    monkeypatch.setitem(sys.modules, "jax", None)  # Python's way to say that a module is not there
    with pytest.raises(DelayRLError, match=r"this needs jax: pip install 'delayrl\[train\]'"):
        load_bundle(original, "jax")


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_action_is_in_its_range(original: Path, sign: int) -> None:
    """A plant may refuse a command that is beyond its range by a rounding."""
    policy = load_bundle(original)
    end = policy.high if sign > 0 else policy.low
    beyond = np.nextafter(end, np.float32(sign * np.inf))
    rounded = Bundle(policy.network, policy.metadata, lambda *_: beyond, "numpy")
    np.testing.assert_array_equal(rounded(np.zeros(10), np.zeros((4, 2)), 0), end)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b'{"a":' * 100_000, "not JSON"),
        (b"\x80\x04\x95", "not JSON"),
        (b'{"format": NaN}', "not JSON"),
        (b'{"format": 1, "format": 1}', "not JSON"),
        (b'{"format": ' + b"9" * 5000 + b"}", "not JSON"),
        (b"[]", "no format"),
        (b"{}", "no format"),
        (b'{"format": 2}', "format 2; this version reads 1"),
        (b'{"format": true}', "format True; this version reads 1"),
        (b'{"format": "1"}', "format '1'; this version reads 1"),
        (b'{"format": "x\\ny\\u001b[31m"}', r"format 'x\ny\x1b[31m'; this"),
        (b'{"format": 1}', "checksum"),
        (b'{"format": 1, "checksum": "\\ud800"}', "checksum"),
        (b" " * (1 << 20) + b"{}", "larger than"),
    ],
    ids=range(17),
)
def test_broken_documents(bundle: Path, content: bytes, words: str) -> None:
    (bundle / DOCUMENT).write_bytes(content)
    refused(bundle, words)


def test_changed_documents(bundle: Path) -> None:
    document = json.loads((bundle / DOCUMENT).read_text())
    document["policy"]["high"][0] = 100.0
    (bundle / DOCUMENT).write_text(json.dumps(document))
    refused(bundle, "checksum")


BAD_POLICIES: list[tuple[str, Any]] = [
    *(("obs_size", value) for value in (0, -1, 1.0, "10", True, None, 10**30, 11)),
    *(("action_size", value) for value in (0, 3, [2])),
    *(("max_age", value) for value in (-1, 0, 5, 10**6)),
    *(("low", value) for value in ([0.0], [0.0, "a"], [10**400, 0], [0.0, 3.0], [1e38, 0], {}, [True, 0])),
    *(("high", value) for value in ([0.4], [-0.4, 3.0], None)),
    *(("input", value) for value in ("observation", "augmented", "pickle", None, ["transformer"])),
    *(("hidden", value) for value in ([], [16], [0, 16], [16] * 1000, None, [10**6, 10**6])),
    *(("current", value) for value in (None, [], 3)),  # below: also where the weights would fit
    *(("width", value) for value in (0, 9, 10**6)),
    *(("blocks", value) for value in (0, 1, 3, 1000, 10**6)),
]


@pytest.mark.parametrize(("name", "value"), BAD_POLICIES, ids=range(len(BAD_POLICIES)))
def test_policies_that_are_not_the_weights(bundle: Path, name: str, value: Any) -> None:
    """A valid bundle whose description does not fit is refused before anything large is allocated."""
    forge(bundle, lambda document: document["policy"].update({name: value}))
    refused(bundle, "")


@pytest.mark.parametrize("value", [None, [], [0], [16] * 1000, "x", {}])
def test_a_forecast_is_as_the_bundle_describes_it(value: Any, tmp_path: Path) -> None:
    bundle = bundle_of(tmp_path / "bundle", policy_of("any-age"))
    forge(bundle, lambda document: document["policy"].update(forecast=value))
    refused(bundle, "forecast")
    forge(bundle, lambda document: document["policy"].update(input="augmented", forecast=[16, 16]))
    refused(bundle, "needs a forecast if its input is forecast, and must have none otherwise")
    arrays = safetensors.numpy.load((bundle / WEIGHTS).read_bytes())
    arrays.pop("forecast.0.norm.scale")
    weights = safetensors.numpy.save(arrays)
    forge(bundle, lambda document: document["policy"].update(input="forecast", forecast=[16, 16]), weights=weights)
    refused(bundle, "the weights lack array 'forecast.0.norm.scale'")


def test_a_transformer_needs_a_network_for_age_0(bundle: Path) -> None:
    arrays = safetensors.numpy.load((bundle / WEIGHTS).read_bytes())
    rest = {name: array for name, array in arrays.items() if not name.startswith("current.")}
    forge(bundle, lambda document: document["policy"].update(current=None), weights=safetensors.numpy.save(rest))
    refused(bundle, "needs a current")


@pytest.mark.parametrize(("max_age", "action_size"), [(10_001, 1), (10_000, 1001)])
def test_a_small_file_cannot_ask_for_much_memory(max_age: int, action_size: int) -> None:
    """A policy that reads only the observation has the same weights at any max_age."""

    def document(max_age: int) -> dict[str, Any]:
        low, high = ([value] * action_size for value in (-1.0, 1.0))
        sizes = {"obs_size": 1, "action_size": action_size, "max_age": max_age, "width": 0, "blocks": 0}
        return {**sizes, "low": low, "high": high, "input": "observation", "hidden": [2], "current": None}

    parse(document(9_000))
    with pytest.raises(DelayRLError, match="history too large"):
        parse(document(max_age))
    attending = {"input": "transformer", "width": 1, "blocks": 1, "current": [2]}  # one number for each pair of ages
    parse(document(3_000) | attending)
    with pytest.raises(DelayRLError, match="too large for a transformer: 4,000 steps"):
        parse(document(4_000) | attending)


@pytest.mark.parametrize(
    "name", ["../../evil", "/etc/passwd", "policy.pkl", "bundle.json", "..", "", "policy.onnx/../x"]
)
def test_other_names(bundle: Path, name: str) -> None:
    document = json.loads((bundle / DOCUMENT).read_text())
    document["files"][name] = document["files"][WEIGHTS]
    (bundle / DOCUMENT).write_text(json.dumps(document | {"checksum": checksum(document)}))
    refused(bundle, "names a file that no bundle has")


def test_names_of_another_kind(bundle: Path) -> None:
    for files in (None, [], {}, {WEIGHTS: None}, {WEIGHTS: []}, {WEIGHTS: {"bytes": 1}}, "policy.safetensors"):
        document = json.loads((bundle / DOCUMENT).read_text()) | {"files": files}
        document["checksum"] = checksum(document)
        (bundle / DOCUMENT).write_text(json.dumps(document))
        refused(bundle, "")


class Bomb:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.path),))


def test_pickles_are_not_opened(bundle: Path, tmp_path: Path) -> None:
    bomb = pickle.dumps(Bomb(tmp_path / "executed"))
    (bundle / "policy.pkl").write_bytes(bomb)
    forge(bundle, graph=bomb)
    load_bundle(bundle, "onnx")
    forge(bundle, weights=bomb)
    refused(bundle, "", "onnx")
    assert not (tmp_path / "executed").exists()
    pickle.loads(bomb)
    assert (tmp_path / "executed").exists()  # the bomb was alive


def header(data: bytes) -> tuple[dict[str, Any], bytes]:
    length = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def with_header(entries: dict[str, Any], rest: bytes) -> bytes:
    text = json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text + rest


def test_broken_weights(bundle: Path) -> None:
    data = (bundle / WEIGHTS).read_bytes()
    entries, rest = header(data)
    name = "head.0.w"

    def changed(**values: Any) -> bytes:
        return with_header(entries | {name: entries[name] | values}, rest)

    huge = [2**31, 2**31]
    for broken, words in [
        (b"", "not a safetensors"),
        (data[:7], "not a safetensors"),
        (data[:100], "not a safetensors"),
        (data[:-1], "not a safetensors"),
        (data + b"\0", "not a safetensors"),
        (struct.pack("<Q", 2**63) + data[8:], "header is too long"),
        (struct.pack("<Q", (1 << 20) + 1) + b" " * (1 << 21), "header is too long"),
        (with_header({}, b""), "lack array"),
        (changed(shape=huge), "not a safetensors"),
        (changed(shape=huge, data_offsets=[0, 2**64 - 1]), "not a safetensors"),
        (changed(shape=[-1, 2]), "not a safetensors"),
        (changed(data_offsets=[0, 4]), "not a safetensors"),
        (changed(dtype="I32"), "expected float32"),
        (changed(dtype="PICKLE"), "not a safetensors"),
        (changed(shape=[1, *entries[name]["shape"]]), "expected float32"),
    ]:
        forge(bundle, weights=broken)
        refused(bundle, words)


def test_weights_of_other_kinds(bundle: Path) -> None:
    arrays = safetensors.numpy.load((bundle / WEIGHTS).read_bytes())
    head = arrays["head.0.w"]

    def forged(words: str, **changes: Any) -> None:
        mine = {
            k: v for k, v in (arrays | {k.replace("_", "."): v for k, v in changes.items()}).items() if v is not None
        }
        forge(bundle, weights=safetensors.numpy.save(mine))
        refused(bundle, words)

    for value in (np.nan, np.inf, -np.inf):
        bad = head.copy()
        bad[-1, -1] = value
        forged("head.0.w holds numbers that are not finite", head_0_w=bad)
    forged("float64", head_0_w=head.astype(np.float64))
    forged("float16", head_0_w=head.astype(np.float16))
    forged("expected float32", head_0_w=head[:-1])
    forged("lack array 'head.0.w'", head_0_w=None)
    forged("unknown array 'head.9.w'", head_9_w=head)
    forged("unknown array", **{"x" * 5000: head})


def test_sums_of_other_files(bundle: Path, tmp_path: Path) -> None:
    """Foreign, cut and missing weights: without a forged checksum they do not reach the parser."""
    other = bundle_of(tmp_path / "other", policy_of("vdpo", seed=1))
    shutil.copy(other / WEIGHTS, bundle / WEIGHTS)
    refused(bundle, "cut or changed")
    (bundle / WEIGHTS).write_bytes((other / WEIGHTS).read_bytes()[:-10])
    refused(bundle, "cut or changed")
    (bundle / WEIGHTS).unlink()
    refused(bundle, "missing")


@pytest.mark.parametrize("name", [DOCUMENT, WEIGHTS, GRAPH])
def test_links_and_pipes(bundle: Path, tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside"
    shutil.move(bundle / name, outside)
    (bundle / name).symlink_to(outside)

    def unread(words: str) -> None:
        with pytest.raises(DelayRLError, match=words):
            read_files(bundle, (WEIGHTS, GRAPH))

    unread("is a link")
    (bundle / name).unlink()
    os.mkfifo(bundle / name)
    unread("not a regular file")
    (bundle / name).unlink()
    (bundle / name).mkdir()
    unread("not a regular|cannot be read")


def test_a_graph_in_a_bundle_is_not_run(bundle: Path, tmp_path: Path) -> None:
    """It is foreign, broken, not what bundle.json lists, or missing: the policy is that of the weights."""
    other = bundle_of(tmp_path / "other", policy_of("vdpo", seed=1))
    obs, actions = np.ones(10), np.full((4, 2), 0.1)
    expected = load_bundle(bundle)(obs, actions, 3)
    assert np.abs(load_bundle(other)(obs, actions, 3) - expected).max() > 0.01

    def same() -> None:
        np.testing.assert_allclose(load_bundle(bundle, "onnx")(obs, actions, 3), expected, rtol=0, atol=1e-5)

    for graph in ((other / GRAPH).read_bytes(), b"", b"garbage"):
        forge(bundle, graph=graph)
        same()
    (bundle / GRAPH).write_bytes(b"changed")
    same()
    (bundle / GRAPH).unlink()
    same()


def test_a_bundle_that_could_not_be_read_is_not_written(bundle: Path) -> None:
    before = {file.name: file.read_bytes() for file in bundle.iterdir()}
    words = r"^bundle.json would have 1,0\d\d,\d{3} bytes, a bundle allows 1,048,576: use .*$"
    with pytest.raises(DelayRLError, match=words):
        write_files(bundle, pack(*network_of(policy_of("bpql")), {"hyperparameters": "x" * (1 << 20)}), force=True)
    assert {file.name: file.read_bytes() for file in bundle.iterdir()} == before


@pytest.mark.parametrize(
    ("name", "bad", "unknown", "good"),
    [
        (
            "idle",
            [1.0, [], [1.0], [1.0, 2.0, 3.0], [1.0, "2"], [True, 0.0], [1e39, 0.0], [10**400, 0.0]],
            None,
            [1, -0.5],
        ),
        ("ages", [[], 2, ["2", 4], [True, 4], [-1, 4], [9, 9], [0.5, 4], [2, 3], [3, 2], [4]], 0, [2, 4]),
        ("action_delay", [5, -1, 1.0, "1", True, []], 0, 3),
        ("dt", [0, -1, "1", True, 1e300, [1]], None, 0.5),
    ],
)
def test_what_a_bundle_says_of_itself(bundle: Path, name: str, bad: list, unknown: Any, good: Any) -> None:
    """What is absent or null is unknown, as in older bundles; what cannot be is refused."""

    def value() -> Any:
        own = getattr(load_bundle(bundle), {"ages": "min_age"}.get(name, name))
        return own.tolist() if isinstance(own, np.ndarray) else own

    for wrong in bad:
        forge(bundle, lambda document, wrong=wrong: document.update({name: wrong}))
        with pytest.raises(DelayRLError, match=rf"bundle.json is damaged: {name} is "):
            load_bundle(bundle)
    forge(bundle, lambda document: document.update({name: None}))
    assert value() == unknown
    forge(bundle, lambda document: document.pop(name))
    assert value() == unknown
    forge(bundle, lambda document: document.update({name: good}))
    assert value() == (good[0] if name == "ages" else good)


@settings(max_examples=150, deadline=None, database=None)
@given(data=st.data())
def test_any_change_is_noticed(original: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Bytes changed, removed or inserted in any file give one line, or (spaces in the JSON) the same policy."""
    home = tmp_path_factory.mktemp("changed")
    name = data.draw(st.sampled_from([DOCUMENT, WEIGHTS]))
    content = bytearray((original / name).read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    length = data.draw(st.integers(0, 20))
    content[at : at + length] = data.draw(st.binary(max_size=20))
    shutil.copytree(original, home, dirs_exist_ok=True)
    (home / name).write_bytes(content)
    try:
        policy = load_bundle(home)
    except DelayRLError as error:
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert policy.metadata == load_bundle(original).metadata
    finally:
        shutil.rmtree(home)


@settings(max_examples=150, deadline=None, database=None)
@given(content=st.binary(max_size=200), length=st.integers(0, 2**64 - 1) | st.integers(0, 300))
def test_any_weights_are_refused(original: Path, tmp_path_factory: Any, content: bytes, length: int) -> None:
    """A fuzzer with valid checksums, so that the parser itself meets garbage."""
    home = tmp_path_factory.mktemp("fuzzed")
    shutil.copytree(original, home, dirs_exist_ok=True)
    forge(home, weights=struct.pack("<Q", length) + content)
    refused(home, "cannot be used")
    shutil.rmtree(home)


def test_the_command_line_says_it_in_one_line(bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forge(bundle, weights=pickle.dumps(Bomb(tmp_path / "executed")))
    for command in (["latency", str(bundle)], ["push", str(bundle), "some/where"]):
        with pytest.raises(SystemExit) as end:
            main(command)
        out, err = capsys.readouterr()
        assert (end.value.code, out, err.count("\n")) == (2, "", 1)
        assert "not a safetensors file" in err
    assert not (tmp_path / "executed").exists()


def test_the_check_of_an_export_sees_where_the_policy_works() -> None:
    """Far from 0 single precision has few digits left; around 0 this network and its bundle agree."""
    policy = policy_of("bpql, normalised")
    size, seen = policy.spec.obs_size, 1e6
    for mean, right in ((0.0, True), (1e3, True), (5e5, False)):
        moments = Moments(jnp.float32(seen), jnp.full(size, mean), jnp.full(size, seen))
        state = policy.state._replace(moments=moments)
        moved = Policy(policy.agent, state, policy.spec, policy.low, policy.high)
        network, arrays = network_of(moved)
        usual = np.full(size, mean, np.float32), np.ones(size, np.float32)

        def act(obs: np.ndarray, actions: np.ndarray, age: int, moved: Any = moved) -> np.ndarray:
            return moved.act(obs, {"age": age, "actions": actions})

        check_same(network, arrays, act, "differs")
        with contextlib.nullcontext() if right else pytest.raises(DelayRLError, match="too few digits"):
            check_same(network, arrays, act, "differs", usual)


def test_the_check_of_an_export_sees_the_oldest_ages() -> None:
    network, arrays = network_of(policy_of("bpql", delay=300))
    act = numpy_policy(network, arrays)
    check_same(network, arrays, act, "differs")
    with pytest.raises(DelayRLError, match=r"^differs: at age 300 it is"):
        check_same(network, arrays, lambda obs, actions, age: act(obs, actions, age) + (age == 300), "differs")
