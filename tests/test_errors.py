"""Errors are one line each."""

from delayrl.errors import described, first_line


def test_first_lines() -> None:
    assert first_line(ValueError("\n first\nsecond")) == "first"
    assert first_line(MemoryError()) == described(MemoryError()) == "MemoryError"
    assert described(ValueError("first\nsecond")) == "ValueError: first"
