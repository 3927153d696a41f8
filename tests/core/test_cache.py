"""Compiled programs are found again by the next process, in a folder to which only the user may write."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from delayrl.core import cache

CODE = """
import json, sys, jax
from delayrl.core import cache
cache.LARGEST = int(sys.argv[1])
folder = cache.keep_compiled()
hits = []
jax.monitoring.register_event_listener(lambda event, **kwargs: hits.append(event.endswith("cache_hits")))
result = jax.jit(lambda x: (x @ x).sum(0) * 3)(jax.numpy.ones((20, 20)))
print(json.dumps([folder and str(folder), sum(hits), result.tolist()]))
"""


def compile_in(home: Path, largest: int = 2**30, **environment: str) -> tuple[str | None, int]:
    """Compile in a process of its own. Returns the folder, and how many programs were found there."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    variables |= {"JAX_PLATFORMS": "cpu", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    variables |= {"XDG_CACHE_HOME": str(home)} | environment
    words = [sys.executable, "-c", CODE, str(largest)]
    folder, hits, result = json.loads(subprocess.run(words, env=variables, stdout=subprocess.PIPE, check=True).stdout)
    assert result == [1200] * 20
    return folder, hits


@pytest.fixture
def folder_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], Path | None]:
    """The folder that is kept for programs in a home, and of which JAX is told, if it has none yet."""

    def folder(home: Path) -> Path | None:
        told: dict[str, object] = {}
        unset = {"jax_compilation_cache_dir": None, "jax_enable_compilation_cache": True}
        config = SimpleNamespace(**unset, update=told.__setitem__)
        monkeypatch.setattr(cache, "jax", SimpleNamespace(config=config))
        monkeypatch.setenv("XDG_CACHE_HOME", str(home))
        kept = cache.keep_compiled()
        assert told.get("jax_compilation_cache_dir") == (kept and str(kept))
        return kept

    return folder


def test_the_next_process_finds_what_this_one_compiled(tmp_path: Path) -> None:
    folder, hits = compile_in(tmp_path)
    assert folder is not None
    assert hits == 0
    assert compile_in(tmp_path) == (folder, entries := len(list(Path(folder).iterdir())))
    assert entries >= 1
    for path in (Path(folder), Path(folder).parent):
        assert path.stat().st_mode & 0o777 == 0o700
    assert compile_in(tmp_path, largest=1) == (folder, 0)  # too large together: deleted, and made again


@pytest.mark.parametrize("level", [0, 1])
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path: Path, level: int, folder_in) -> None:
    """An entry is code, which any of them could have put there."""
    folder = folder_in(tmp_path)
    assert folder is not None
    path = [folder, folder.parent][level]
    path.chmod(0o777)
    assert folder_in(tmp_path) is None
    path.chmod(0o700)
    assert folder_in(tmp_path) == folder
    tmp_path.chmod(0o777)  # anybody could put another folder in its place
    assert folder_in(tmp_path) is None
    tmp_path.chmod(0o1777)  # but not here, as in /tmp
    assert folder_in(tmp_path) == folder


def test_a_link_is_followed(tmp_path: Path, folder_in) -> None:
    """Home folders of clusters are small. What counts is the folder that it leads to."""
    (tmp_path / "large").mkdir(mode=0o700)
    (tmp_path / "delayrl").symlink_to(tmp_path / "large")
    folder = folder_in(tmp_path)
    assert folder is not None
    assert folder.parent == tmp_path / "large"
    (tmp_path / "large").chmod(0o777)
    assert folder_in(tmp_path) is None


def test_settings_of_jax_come_first(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    assert compile_in(tmp_path, JAX_COMPILATION_CACHE_DIR=str(elsewhere)) == (None, 0)
    assert compile_in(tmp_path, JAX_COMPILATION_CACHE_DIR=str(elsewhere))[1] == len(list(elsewhere.iterdir())) > 0
    assert compile_in(tmp_path, JAX_ENABLE_COMPILATION_CACHE="0") == (None, 0)
    assert not (tmp_path / "delayrl").exists()


def test_a_relative_folder_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder_in) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = folder_in(Path("here"))
    assert folder is not None
    assert folder.parent == tmp_path / ".cache" / "delayrl"


def test_without_a_home_nothing_is_kept(tmp_path: Path, folder_in) -> None:
    (tmp_path / "file").write_text("")
    assert folder_in(tmp_path / "file") is None
    assert compile_in(tmp_path / "file") == (None, 0)


def test_the_command_line_keeps_what_it_compiles(tmp_path: Path) -> None:
    words = "train own_agents:Shrink --env Pendulum-v1 --delay 2 --preset small --steps 120 --random-steps 100"
    variables = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    variables |= {"JAX_PLATFORMS": "cpu", "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-m", "delayrl", *words.split(), "--quiet", "--evaluation-episodes", "1"]
    subprocess.run([*command, "--out", str(tmp_path / "run")], env=variables, stdout=subprocess.DEVNULL, check=True)
    assert len(list((tmp_path / "delayrl").rglob("*-cache"))) > 0
