"""Rows that are damaged, incomplete or there twice."""

import math
from typing import Any

import pytest
from synthetic import anchored, small

from delayrl.errors import DelayRLError
from delayrl.report.rows import group_rows


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"return": math.nan}, "damaged"),
        ({"return": "12"}, "damaged"),
        ({"step": 1.5}, "damaged"),
        ({"step": 10**30}, "damaged"),
        ({"episode": -1}, "damaged"),
        ({"delay": 10**30}, "damaged"),
        ({"delay": [5]}, "damaged"),
        ({"delay": True}, "damaged"),
        ({"delay": 2**31}, "damaged"),
        ({"policy": {}}, "damaged"),
        ({"episode": 1, "step": 100}, "twice"),
    ],
)
def test_a_damaged_row_is_one_line(change: dict[str, Any], words: str) -> None:
    every = anchored(small())
    with pytest.raises(DelayRLError, match=f"^row {len(every) + 1} .*{words}") as error:
        group_rows([*every, every[0] | {"episode": 2} | change])
    assert "\n" not in str(error.value)


def test_an_evaluation_that_a_crash_cut_does_not_count() -> None:
    rows = [row for row in anchored(small()) if row["seed"] == 0]
    last = max(row["step"] for row in rows)
    cut = [row for row in rows if row["step"] < last or row["episode"] == 0]
    for whole, group in zip(group_rows(rows), group_rows(cut), strict=True):
        (returns,), (fewer,) = whole.runs("agent").values(), group.runs("agent").values()
        assert len(returns) > 1
        assert fewer == {step: value for step, value in returns.items() if step < last}


def test_a_row_without_a_column() -> None:
    with pytest.raises(DelayRLError, match="row 1 of the results has no column 'seed'"):
        group_rows([{k: v for k, v in anchored(small())[0].items() if k != "seed"}])
