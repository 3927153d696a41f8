"""The page on the Python functions says where each of them is imported from, and `import delayrl` offers the rest."""

import re
from importlib import import_module
from pathlib import Path

import pytest

import delayrl

PAGE = Path(__file__).parents[1] / "docs" / "api.md"
SECTIONS = PAGE.read_text().split("\n## ")[1:]
NAMES = [(section, name) for section in SECTIONS for name in re.findall(r"^::: ([\w.]+)$", section, re.MULTILINE)]


@pytest.mark.parametrize(("section", "path"), NAMES, ids=[path for _, path in NAMES])
def test_where_it_is_imported_from(section: str, path: str) -> None:
    home, _, name = path.rpartition(".")
    if home.startswith("delayrl.batched.brax"):
        pytest.importorskip("brax")
    thing = getattr(import_module(home), name)
    place = re.search(rf"^From `([\w.]+)`.*: .*`{name}`", section, re.MULTILINE)
    assert (place is None) == (name in delayrl.__all__), "it is imported from delayrl, or the page says from where"
    assert getattr(import_module(place[1]) if place else delayrl, name) is thing


def test_what_is_offered_is_on_the_page() -> None:
    shown = {path.rpartition(".")[2] for _, path in NAMES}
    assert set(delayrl.__all__) - shown == {"AGENTS", "DelayRLError", "DelayWarning", "StoppedError"}
