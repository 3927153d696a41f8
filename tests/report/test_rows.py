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


def test_a_row_without_a_column() -> None:
    with pytest.raises(DelayRLError, match="row 1 of the results has no column 'seed'"):
        group_rows([{k: v for k, v in anchored(small())[0].items() if k != "seed"}])
