"""Errors are one line each."""

import pytest

from delayrl.errors import DelayRLError, described, first_line, near_names, needs_extra, one_line


def test_first_lines() -> None:
    assert first_line(ValueError("\n first\nsecond")) == "first"
    assert first_line(MemoryError()) == described(MemoryError()) == "MemoryError"
    assert described(ValueError("first\nsecond")) == "ValueError: first"


@pytest.mark.parametrize("module", ["mujoco", "PIL.Image"])
def test_an_extra_that_is_missing(module: str) -> None:
    """Its line comes from the import itself, and from an error that other code raises because of it."""
    line = f"this needs {module.partition('.')[0]}: pip install 'delayrl[train]'"
    error = RuntimeError("not installed")
    error.__cause__ = ModuleNotFoundError(name=module)
    with pytest.raises(DelayRLError) as found, one_line("task 'Ant-v5' cannot be made here"):
        raise error
    assert str(found.value) == line == str(needs_extra(ModuleNotFoundError(name=module)))


def test_other_modules_are_of_no_extra() -> None:
    assert needs_extra(ModuleNotFoundError(name="mujoco_arm")) is None
    assert needs_extra(NameError(name="jax")) is None


@pytest.mark.parametrize(
    ("name", "known", "near"),
    [
        ("gamma", ["grow", "discount"], ["discount"]),
        ("--buffer_size", ["--batch-size", "--replay-capacity"], ["--replay-capacity"]),
        ("gamma", ["gammas"], ["gammas"]),  # where there is no such option of ours
        ("lr", ["layers", "learning_rate", "actor_learning_rate"], ["learning_rate", "actor_learning_rate"]),
        ("discont", ["discount", "steps"], ["discount"]),
        ("quite_different", ["discount", "steps"], []),
    ],
)
def test_names_that_may_be_meant(name: str, known: list[str], near: list[str]) -> None:
    assert near_names(name, known) == near
