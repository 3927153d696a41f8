"""JAX, NumPy, ONNX and C++ compute the same action: every agent, every age, random inputs."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from bundles import AGENTS, bundle_of, policy_of

from delayrl.agents.registry import AGENTS as REGISTRY
from delayrl.core import networks
from delayrl.core.types import Spec
from delayrl.deploy import load_bundle
from delayrl.deploy.backends.network import Network
from delayrl.deploy.backends.numpy_policy import _gelu, numpy_policy
from delayrl.deploy.backends.onnx_policy import onnx_policy
from delayrl.deploy.export import network_of
from delayrl.errors import DelayRLError
from delayrl.play.policy import Policy
from random_states import random_state

SOURCE = Path(__file__).parents[2] / "examples" / "cpp" / "controller.cpp"
REPEATS = 5


@pytest.fixture(scope="module")
def controller(tmp_path_factory: pytest.TempPathFactory) -> str:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        assert not os.environ.get("CI"), "there is no C++ compiler"  # in CI the comparison must be made
        pytest.skip("there is no C++ compiler")
    program = tmp_path_factory.mktemp("cpp") / "controller"
    flags = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run([compiler, *flags, "-o", program, SOURCE], check=True)
    return str(program)


def ask(controller: str, bundle: Path, inputs: list) -> np.ndarray:
    lines = [" ".join([str(age), *(f"{x:.9g}" for x in (*obs, *actions.ravel()))]) for obs, actions, age in inputs]
    done = subprocess.run([controller, str(bundle)], input="\n".join(lines), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return np.array([line.split() for line in done.stdout.splitlines()], float)


def random_inputs(policy: Policy, ages) -> list:
    """Sample inputs. Histories are full of actions at any age: those after the first `age` must not matter."""
    random = np.random.default_rng(1)
    shape = (policy.spec.delay, policy.spec.action_size)
    return [
        (
            random.normal(size=policy.spec.obs_size).astype(np.float32),
            random.uniform(policy.low, policy.high, shape).astype(np.float32),
            age,
        )
        for age in ages
        for _ in range(REPEATS)
    ]


def wanted(policy: Policy, inputs: list) -> np.ndarray:
    return np.array([policy.act(obs, {"age": age, "actions": actions}) for obs, actions, age in inputs])


def test_every_agent_is_exported() -> None:
    assert set(AGENTS) >= set(REGISTRY) - {"random"}
    random = REGISTRY["random"].presets["paper"].agent
    spec = Spec(3, 1, 2)
    with pytest.raises(DelayRLError, match="no deterministic policy"):
        network_of(Policy(random, random_state(random, spec), spec, -np.ones(1), np.ones(1)))


@pytest.mark.parametrize("name", list(AGENTS))
def test_backends_agree(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    policy = policy_of(name)
    path = bundle_of(tmp_path / "bundle", policy)
    inputs = random_inputs(policy, range(policy.spec.delay + 1))
    expected = wanted(policy, inputs)
    width = policy.high - policy.low
    assert ((expected - policy.low) / width).std(0).max() > 0.1  # agreement on a constant would show little
    for backend in ("numpy", "onnx", "jax"):
        bundle = load_bundle(path, backend)
        actual = np.array([bundle(*given) for given in inputs])
        assert actual.dtype == np.float32
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5, err_msg=backend)
    actual = ask(request.getfixturevalue("controller"), path, inputs)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5)


def test_no_rounding_brings_an_action_beyond_its_bounds(tmp_path: Path, controller: str) -> None:
    """Of a saturated policy low + 2 (high - low) / 2 is above high in float32 for a sixth of all ranges."""
    low, high = np.sort(np.random.default_rng(0).uniform(-3, 3, (2, 1000)).astype(np.float32), 0)
    beyond = low + 2 * ((high - low) / np.float32(2)) > high
    bounds = low[beyond][:2], high[beyond][:2]
    usual = policy_of("bpql")
    policy = Policy(usual.agent, usual.state, usual.spec, *bounds)
    last = policy.state.actor[-1]
    last["b"] = np.full_like(last["b"], 1e6)
    path = bundle_of(tmp_path / "bundle", policy)
    inputs = random_inputs(policy, [1])
    onnx = onnx_policy(*network_of(policy))
    assert (onnx(*inputs[0]) == bounds[1]).all()
    assert (ask(controller, path, inputs).astype(np.float32) == bounds[1]).all()


def test_numbers_so_large_that_there_is_no_action(tmp_path: Path, controller: str) -> None:
    """Each is finite, but not their sum: a NaN would be sent to the drives."""
    policy = policy_of("bpql")
    path = bundle_of(tmp_path / "bundle", policy)
    obs = np.full(policy.spec.obs_size, 3e38, np.float32)
    with pytest.raises(DelayRLError, match="so large that"):
        load_bundle(path)(obs, np.zeros((policy.spec.delay, policy.spec.action_size)), 1)
    line = " ".join(["1", *["3e38"] * policy.spec.obs_size, *["0"] * policy.spec.delay * policy.spec.action_size])
    done = subprocess.run([controller, str(path)], input=line, capture_output=True, text=True)
    assert done.returncode != 0
    assert "not finite" in done.stderr
    assert "nan" not in done.stdout


@pytest.mark.parametrize("name", ["vdpo", "bpql", "any-age"])
def test_preset_paper_agrees(name: str, tmp_path: Path, controller: str) -> None:
    """The widths and depth of the preset, at HalfCheetah's sizes and Δ = 25."""
    agent, spec = REGISTRY[name].presets["paper"].agent, Spec(17, 6, 25)
    policy = Policy(agent, random_state(agent, spec), spec, -np.ones(6), np.ones(6))
    path = bundle_of(tmp_path / "bundle", policy)
    inputs = random_inputs(policy, (0, 1, 2, 13, 25))
    expected = wanted(policy, inputs)
    for backend in ("numpy", "onnx"):
        bundle = load_bundle(path, backend)
        np.testing.assert_allclose(np.array([bundle(*given) for given in inputs]), expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ask(controller, path, inputs), expected, rtol=0, atol=1e-5)


def test_an_observation_alone_and_a_network_for_age_0() -> None:
    network = Network(3, 2, 4, (-1.0, -2.0), (1.0, 3.0), "observation", (5,), current=(6,))
    random = np.random.default_rng(0)
    arrays = {name: random.normal(size=shape).astype(np.float32) for name, shape in network.shapes().items()}
    network.check(arrays)
    obs, actions = random.normal(size=3).astype(np.float32), np.zeros((4, 2), np.float32)
    expected, given = (
        np.array([act(obs, actions, age) for age in range(5)])
        for act in (numpy_policy(network, arrays), onnx_policy(network, arrays))
    )
    np.testing.assert_allclose(given, expected, rtol=0, atol=1e-5)
    assert np.abs(expected[0] - expected[1]).max() > 0.1


def test_jax_does_not_round_its_factors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By default a GPU does. A CPU does not, so this looks at the setting while the networks are traced."""
    settings = []

    def mlp(*given: Any) -> Any:
        settings.append(jax.default_matmul_precision.value)
        return original(*given)

    original = networks.mlp
    monkeypatch.setattr(networks, "mlp", mlp)
    policy = load_bundle(bundle_of(tmp_path / "bundle", policy_of("bpql")), "jax")
    policy(np.zeros(policy.obs_size), np.zeros((policy.max_age, policy.action_size)), 1)
    assert set(settings) == {"float32"}


@pytest.mark.parametrize("name", ["vdpo", "any-age"])
@pytest.mark.parametrize("backend", ["numpy", "onnx", "jax"])
def test_what_stands_after_the_age_is_not_read(name: str, backend: str, tmp_path: Path) -> None:
    bundle = load_bundle(bundle_of(tmp_path / "bundle", policy_of(name)), backend)
    random = np.random.default_rng(0)
    obs = random.normal(size=bundle.obs_size)
    actions = random.uniform(bundle.low, bundle.high, (bundle.max_age, bundle.action_size))
    for age in range(bundle.max_age + 1):
        other = actions.copy()
        other[age:] = np.nan
        np.testing.assert_array_equal(bundle(obs, actions, age), bundle(obs, other, age))
        if age:
            other = actions.copy()
            other[age - 1] += 0.1
            assert np.abs(bundle(obs, actions, age) - bundle(obs, other, age)).max() > 1e-4


def test_log_std_is_left_out() -> None:
    """The log-std is half of the last layer's outputs; DIDA's student has none."""
    for name in ("bpql", "dida"):
        network, arrays = network_of(policy_of(name))
        last = f"head.{len(network.hidden)}.b"
        assert arrays[last].shape == (2,)


def test_gelu() -> None:
    x = np.linspace(-12, 12, 20001).astype(np.float32)
    exact = [value * 0.5 * math.erfc(-value * 0.5**0.5) for value in x.tolist()]
    np.testing.assert_allclose(_gelu(x), exact, rtol=1e-6, atol=3e-7)


def test_needs_neither_jax_nor_gymnasium(tmp_path: Path) -> None:
    """On the robot: NumPy and safetensors. The other backends say what they lack."""
    path = bundle_of(tmp_path / "bundle", policy_of("vdpo"))
    code = """
import sys
for name in ("jax", "gymnasium", "mujoco", "optax", "jaxtyping", "onnx", "matplotlib", "scipy"):
    sys.modules[name] = None
from delayrl.deploy import load_bundle
import numpy as np
from delayrl.errors import DelayRLError
policy = load_bundle(sys.argv[1])
print(policy(np.zeros(policy.obs_size), np.zeros((policy.max_age, policy.action_size)), policy.max_age))
for backend in ("onnx", "jax"):
    try:
        load_bundle(sys.argv[1], backend)
    except (DelayRLError, ImportError) as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    _, onnx, jax = done.stdout.splitlines()
    assert onnx == "this needs onnx: pip install 'delayrl[deploy]'"
    assert "jax" in jax


def test_controller_in_cpp_refuses(controller: str, tmp_path: Path) -> None:
    path = bundle_of(tmp_path / "bundle", policy_of("bpql"))
    weights = (path / "policy.safetensors").read_bytes()
    document = (path / "bundle.json").read_text()

    def refused(*words: str) -> str:
        done = subprocess.run([controller, *words], input="", capture_output=True, text=True)
        assert done.returncode == 2
        assert done.stderr.startswith("controller: ")
        assert done.stderr.count("\n") == 1
        return done.stderr

    assert "usage" in refused()
    assert "cannot read" in refused(str(tmp_path / "nowhere"))
    for broken in (weights[:500], b"", b"\x80\x04." * 100, (1 << 62).to_bytes(8, "little") + weights[8:]):
        (path / "policy.safetensors").write_bytes(broken)
        refused(str(path))
    (path / "policy.safetensors").write_bytes(weights)
    for broken in ("", "{", "[" * 10_000, document.replace('"obs_size": 10', '"obs_size": 1e300')):
        (path / "bundle.json").write_text(broken)
        refused(str(path))
    (path / "bundle.json").write_text(document.replace('"obs_size": 10', '"obs_size": 11'))
    assert "head.0.w" in refused(str(path))
    (path / "bundle.json").write_text(document)
    inputs = [1, *[0.5] * 10, *[0.1] * (4 * 2)]
    for odd in (
        [5.5, *inputs[1:]],
        [1.5, *inputs[1:]],
        [*inputs, 0.0],
        inputs[:-1],
        [5, *inputs[1:]],
        [1e300, *inputs[1:]],
    ):
        line = " ".join(map(str, odd))
        done = subprocess.run([controller, str(path)], input=line, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (2, ""), odd


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("vdpo", {"current": None}, "network for age 0"),
        ("vdpo", {"width": 0}, "head.0.w"),
        ("vdpo", {"max_age": 0}, "needs an age"),
        ("bpql", {"max_age": 0}, "needs an age"),
        ("bpql", {"max_age": 10_001}, "out of range"),
        ("bpql", {"low": [0.4, -2.0]}, "low must lie below high"),
        ("bpql", {"high": [1e300, 3.0]}, "low must lie below high"),
        ("bpql", {"high": ["1", 3.0]}, "must be numbers"),
    ],
)
def test_controller_in_cpp_refuses_what_has_no_meaning(
    controller: str, tmp_path: Path, name: str, changes: dict, words: str
) -> None:
    path = bundle_of(tmp_path / "bundle", policy_of(name))
    document = json.loads((path / "bundle.json").read_text())
    document["policy"] |= changes
    (path / "bundle.json").write_text(json.dumps(document))
    done = subprocess.run([controller, str(path)], input="", capture_output=True, text=True)
    assert done.returncode == 2
    assert words in done.stderr
