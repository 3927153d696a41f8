"""A timed run gets what its command line says."""

import json
import sys
from pathlib import Path

import pytest
import timed

import delayrl
from delayrl.training.recorder import Recorder


def test_options_on_the_command_line_are_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers, lists and truths reach `train` as such, names as text; the file of rows is named by the words."""
    seen: dict[str, object] = {}
    monkeypatch.setattr(Recorder, "evaluate", Recorder.evaluate)  # which a timed run replaces
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "0")
    monkeypatch.setattr(delayrl, "train", lambda *_, **options: seen.update(options))
    words = ["batch_size=64", "hidden=[8,8]", "online=true", "precision=bfloat16", "steps=500"]
    command = ["timed.py", "bpql", "X-v0", "--delay", "5", "--out", str(tmp_path), "--set", *words]
    monkeypatch.setattr(sys, "argv", command)
    timed.main()
    names = ("batch_size", "hidden", "online", "precision", "steps")
    assert [seen[name] for name in names] == [64, [8, 8], True, "bfloat16", 500]
    (file,) = tmp_path.iterdir()
    assert file.name == f"bpql-matched-{'-'.join(words)}-X-v0-delay5-seed0.jsonl"
    assert json.loads(file.read_text().splitlines()[0])["config"]["set"] == words
