"""The report as Markdown."""

import re

from synthetic import EVIL, nasty

from delayrl.report.markdown import markdown
from delayrl.report.summary import summarise


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
