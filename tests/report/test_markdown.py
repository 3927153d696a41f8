"""The report as Markdown."""

import re

import pytest
from synthetic import EVIL, nasty

from delayrl.report import wording
from delayrl.report.markdown import markdown
from delayrl.report.summary import summarise
from delayrl.run.rows import return_in_words


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *(
            (0.0042, "0.00420"),
            (-0.0012, "-0.00120"),
            (0.5, "0.500"),
            (-3.14159, "-3.14"),
            (-1e-17, "0.00"),
            (0.0, "0.00"),
        ),
        *((31.44, "31.4"), (-4026.4, "-4,026"), (float("nan"), "")),
    ],
)
def test_numbers_have_three_digits_and_0_no_sign(value: float, text: str) -> None:
    assert wording.number(value) == text


def test_a_mean_near_0_has_the_decimals_of_its_deviation() -> None:
    assert wording.spread(0.02, 3000.5) == "0 ± 3,000"
    assert wording.spread(0.02, 0.003) == "0.0200 ± 0.0030"
    assert return_in_words([0.3, -12.5, 12.3]) == "0.0 ± 12.4 over 3 episodes"


def test_steps_of_different_evaluations_read_apart() -> None:
    """At 100,000 steps and more too; those of the paper's tables have two decimals."""
    texts = [wording.steps(n) for n in (95_000, 115_000, 120_000, 125_000, 1_250_000)]
    assert texts == ["95,000", "0.115M", "0.12M", "0.125M", "1.25M"]
    assert [wording.normalised(x) for x in (-0.004, -0.006, 0.525)] == ["0.00", "-0.01", "0.53"]


def test_names_cannot_break_a_markdown_table() -> None:
    cells, every = nasty()
    text = markdown(summarise(every, cells), EVIL, {})
    assert not re.search(r"<(?!br>|span style=\"color:#888\">|/span>)", text)
    widths: list[int] = []
    for line in text.splitlines():
        if not line.startswith("|"):
            widths = []
            continue
        widths.append(len(re.findall(r"(?<!\\)\|", line)))
        assert widths[0] == widths[-1], line
