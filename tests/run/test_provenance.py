"""The commit that is written down is the package's, and says where files differ from it."""

import subprocess
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from delayrl.run import provenance
from delayrl.run.provenance import versions


@pytest.mark.parametrize("place", ["training/loop.py", "run/provenance.py", "new.py"])
def test_a_changed_file_anywhere_in_the_package_is_noticed(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "src" / "delayrl"
    for name in ("training/loop.py", "run/provenance.py"):
        (package / name).parent.mkdir(parents=True)
        (package / name).write_text("")
    (tmp_path / "README.md").write_text("")
    identity = ["-c", "user.name=test", "-c", "user.email=test@example.org"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    monkeypatch.setattr(provenance, "__file__", str(package / "run" / "provenance.py"))
    clean = provenance.commit()
    assert clean is not None
    assert len(clean) == 12
    (tmp_path / "README.md").write_text("outside of the package")
    assert provenance.commit() == clean
    (package / place).write_text("changed")
    assert provenance.commit() == f"{clean}-changed"


def test_a_package_outside_of_a_checkout_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subprocess.run(["git", "-C", str(tmp_path), "init", "-q"], check=True)
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "run" / "provenance.py"))
    assert provenance.commit() is None


def test_the_device_that_is_written_down_is_the_one_in_use(monkeypatch) -> None:
    """`--device cpu` where there is a GPU too."""
    cpu = jax.devices("cpu")[0]
    monkeypatch.setattr(jax, "devices", lambda *_: [SimpleNamespace(device_kind="GPU")])
    with jax.default_device(cpu):
        assert versions()["device"] == "cpu"
