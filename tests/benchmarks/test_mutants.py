"""The list of mutants fits the code. Whether the tests notice them, `make mutants` finds out."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def mutants(monkeypatch: pytest.MonkeyPatch) -> Iterator[list]:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "mutants"))
    import catalogue

    yield catalogue.read()
    del sys.modules["catalogue"]


def test_no_entry_is_stale(mutants: list) -> None:
    """The text that a mutant replaces occurs once in its file, and the tests that should notice it are there."""
    assert len(mutants) >= 150
    assert not [why for mutant in mutants if (why := mutant.stale(ROOT))]
    for mutant in mutants:
        assert mutant.before != mutant.after
        for test in mutant.tests:
            file, _, name = test.partition("::")
            assert not name or f"def {name}(" in (ROOT / file).read_text(), f"{mutant.name}: there is no {test}"
