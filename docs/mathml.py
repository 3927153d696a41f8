"""A hook of MkDocs: writes the formulas of a page as MathML, which browsers draw without a script or a network."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replace each formula in the HTML of a page. Raises ValueError for a command that is not known."""
    return FORMULA.sub(_mathml, content)


def _mathml(match: re.Match[str]) -> str:
    display = "inline" if match[1] == "span" else "block"
    text = re.sub(r"(\\math(?:bb|cal)) (\w)", r"\1{\2}", html.unescape(match[2]).strip())  # else plain letters
    formula = convert(re.sub(r"\\[bB]ig(\\\|)", r"\1", text), display=display)
    if unknown := re.search(r"\\\S+", html.unescape(formula)):
        raise ValueError(f"{unknown[0]} is not known in the formula {match[2]!r}")
    return f'<{match[1]} class="formula">{formula}</{match[1]}>'
