"""The list of mutants: small wrong changes of the code, each with the tests that should notice it."""

import hashlib
import tomllib
from dataclasses import astuple, dataclass
from pathlib import Path

LIST = Path(__file__).parent / "list"


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    name: str  # the file of the list, without its suffix, and the name of the table in it
    file: str  # the file that is changed, from the root of the repository
    breaks: str  # what the change breaks, in a few words
    before: str  # a text that occurs once in the file
    after: str  # what replaces it
    tests: tuple[str, ...]  # arguments of pytest: test files or single tests
    survives: str = ""  # why no test can notice it, where that is so

    @property
    def files(self) -> set[str]:
        """The test files."""
        return {test.partition("::")[0] for test in self.tests}

    def stale(self, root: Path) -> str:
        """Return what is wrong with the entry, or nothing: its text must occur once, and its tests must be there."""
        file = root / self.file
        if (count := file.read_text(encoding="utf-8").count(self.before) if file.is_file() else 0) != 1:
            return f"{self.name}: its text must occur once in {self.file}; it occurs {count} times"
        missing = sorted(file for file in self.files if not (root / file).is_file())
        return f"{self.name}: there is no {', '.join(missing)}" if missing else ""

    def digest(self, root: Path) -> str:
        """Return a hash of the mutant, its file and its test files, by which a result that is current is known."""
        texts = [(root / file).read_text(encoding="utf-8") for file in sorted({self.file, *self.files})]
        return hashlib.sha256(repr((astuple(self)[:-1], texts)).encode()).hexdigest()[:16]


def read() -> list[Mutant]:
    """Return all mutants of the list.

    Each file of the list is TOML: `file` and `tests` hold for all its mutants, and each other table is a mutant with
    `breaks`, `before` and `after`, which may have `tests` of its own and `survives`. A test without a file is in the
    first of the shared ones.
    """
    mutants = []
    for path in sorted(LIST.glob("*.toml")):
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        shared = {"file": content.pop("file"), "tests": content.pop("tests")}
        here = shared["tests"][0].partition("::")[0]
        for name, entry in content.items():
            fields = shared | entry
            tests = tuple(test if "/" in test else f"{here}::{test}" for test in fields["tests"])
            mutants.append(Mutant(f"{path.stem}/{name}", **fields | {"tests": tests}))
    return mutants
