"""push and pull against a hub that is a folder. Its calls must fit the signatures of the real client."""

import inspect
import json
import pickle
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import huggingface_hub
import pytest
from bundles import bundle_of, policy_of

from delayrl.cli import main
from delayrl.deploy import load_bundle
from delayrl.deploy.files import LIMITS, WEIGHTS
from delayrl.deploy.hub import card, pull, push
from delayrl.errors import DelayRLError

Real = huggingface_hub.HfApi


class Hub:
    """Repositories are folders below `root`."""

    root: Path
    asked: list[str]
    sizes: dict[str, int]

    def _fits(self, method: str, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return inspect.signature(getattr(Real, method)).bind(self, *args, **kwargs).arguments

    def create_repo(self, *args: Any, **kwargs: Any) -> str:
        given = self._fits("create_repo", *args, **kwargs)
        huggingface_hub.utils.validate_repo_id(given["repo_id"])
        (self.root / given["repo_id"]).mkdir(parents=True, exist_ok=given["exist_ok"])
        return f"https://hub.example/{given['repo_id']}"

    def create_commit(self, *args: Any, **kwargs: Any) -> None:
        given = self._fits("create_commit", *args, **kwargs)
        for operation in given["operations"]:
            with operation.as_file() as file:
                (self.root / given["repo_id"] / operation.path_in_repo).write_bytes(file.read())

    def get_paths_info(self, *args: Any, **kwargs: Any) -> list[Any]:
        given = self._fits("get_paths_info", *args, **kwargs)
        home = self.root / given["repo_id"]
        if not home.is_dir():
            raise OSError(f"404 Client Error: no repository {given['repo_id']}\nand a second line")
        files = [home / name for name in given["paths"] if (home / name).exists()]
        return [SimpleNamespace(path=f.name, size=self.sizes.get(f.name, f.stat().st_size)) for f in files]

    def hf_hub_download(self, *args: Any, **kwargs: Any) -> str:
        given = self._fits("hf_hub_download", *args, **kwargs)
        self.asked.append(given["filename"])
        return shutil.copy(self.root / given["repo_id"] / given["filename"], given["local_dir"])


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> type[Hub]:
    Hub.root, Hub.asked, Hub.sizes = tmp_path / "hub", [], {}
    monkeypatch.setattr(huggingface_hub, "HfApi", Hub)
    return Hub


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    evaluation = {"step": 15000, "episodes": 10, "mean_return": 987.654321, "std_return": 1.5, "protocol": "corrected"}
    return bundle_of(tmp_path / "bundle", policy_of("vdpo"), evaluation=evaluation, agent="vdpo")


def test_there_and_back(hub: type[Hub], bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["push", str(bundle), "some/pendulum"])
    assert "https://hub.example/some/pendulum" in capsys.readouterr().out
    (hub.root / "some/pendulum/evil.pkl").write_bytes(b"not asked for")
    main(["pull", "some/pendulum", "--out", str(tmp_path / "back")])
    assert "vdpo on Reacher-v5, ages 0..4" in capsys.readouterr().out
    names = sorted(file.name for file in bundle.iterdir())
    assert sorted(file.name for file in (tmp_path / "back").iterdir()) == names
    for name in names:
        assert (tmp_path / "back" / name).read_bytes() == (bundle / name).read_bytes()
    assert hub.asked == ["bundle.json", "policy.safetensors", "policy.onnx"]
    load_bundle(tmp_path / "back", "onnx")


def test_card(hub: type[Hub], bundle: Path) -> None:
    push(bundle, "some/pendulum", private=True)
    text = (hub.root / "some/pendulum/README.md").read_text()
    head = text.split("---")[1]
    assert 'library_name: "delayrl"' in head
    for words in ("vdpo on Reacher-v5, delay 4", "0 .. 4", "987.654 ± 1.5", "at step 15000"):
        assert words in text
    assert load_bundle(bundle).metadata["checksum"] in text


def test_cards_are_text() -> None:
    """Names from somebody else's metadata stay in their cells."""
    evil = "x\n---\n<script>alert(1)</script> | [link](http://evil) \x1b[31m" + "y" * 1000
    metadata = {"agent": evil, "env": evil, "delay": evil, "checksum": "0"}
    metadata["policy"] = {"obs_size": 1, "action_size": 1, "max_age": 0}
    text = card(metadata)
    assert "<" not in text
    assert "\x1b" not in text
    assert text.count("\n---\n") == 1
    assert max(map(len, text.splitlines())) < 500


def test_a_bundle_that_is_broken_is_not_pushed(hub: type[Hub], bundle: Path) -> None:
    (bundle / WEIGHTS).write_bytes(b"")
    with pytest.raises(DelayRLError, match="cut or changed"):
        push(bundle, "some/pendulum")
    assert not hub.root.exists()


def test_what_is_broken_does_not_arrive(hub: type[Hub], bundle: Path, tmp_path: Path) -> None:
    """Nothing is left in the target, nor beside it, and no local path stands in the message."""
    push(bundle, "some/pendulum")
    home, out = hub.root / "some/pendulum", tmp_path / "back"
    before = sorted(tmp_path.iterdir())

    def refused(words: str) -> None:
        with pytest.raises(DelayRLError, match=words) as error:
            pull("some/pendulum", out)
        assert "\n" not in str(error.value)
        assert "/tmp" not in str(error.value)
        assert sorted(tmp_path.iterdir()) == before

    whole = (home / WEIGHTS).read_bytes()
    (home / WEIGHTS).write_bytes(pickle.dumps([1, 2]))
    refused("some/pendulum/policy.safetensors is cut or changed")
    (home / WEIGHTS).unlink()
    refused("is missing")
    (home / WEIGHTS).write_bytes(whole)
    hub.asked.clear()
    hub.sizes = {"bundle.json": LIMITS["bundle.json"] + 1}
    refused("larger than")
    assert hub.asked == []
    hub.sizes = {}
    document = json.loads((home / "bundle.json").read_text())
    document["files"]["../../../evil"] = document["files"][WEIGHTS]
    (home / "bundle.json").write_text(json.dumps(document))
    refused("checksum")
    (home / "bundle.json").unlink()
    refused("some/pendulum holds no policy bundle")


def test_pull_overwrites_nothing(hub: type[Hub], bundle: Path, tmp_path: Path) -> None:
    push(bundle, "some/pendulum")
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for force in (False, True):
        with pytest.raises(DelayRLError, match="not empty"):
            pull("some/pendulum", out, force=force)
    assert [file.name for file in out.iterdir()] == ["mine.txt"]
    with pytest.raises(DelayRLError, match="not empty"):
        pull("some/pendulum", bundle)
    pull("some/pendulum", bundle, force=True)


def test_the_hub_says_no(hub: type[Hub], bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command, words in (
        (["pull", "some/where", "--out", str(tmp_path / "back")], "404 Client Error: no repository some/where"),
        (["push", str(bundle), "not a name"], "cannot push to not a name: "),
    ):
        with pytest.raises(SystemExit) as end:
            main(command)
        out, err = capsys.readouterr()
        assert (end.value.code, out, err.count("\n")) == (2, "", 1)
        assert words in err
