"""Apply one mutant after the other to a copy of the code, and run the tests that should notice it.

    python benchmarks/mutants/run.py                     # all; a result that is still current is not computed again
    python benchmarks/mutants/run.py --only agents-sac --workers 1

The results go to `results.jsonl`, a line for each mutant, and a page of them to `docs/mutants.md`. The command fails if
a mutant survives of which the list does not say why, or if an entry of the list is stale.
"""

import argparse
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import page
from catalogue import Mutant, read

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Path(__file__).parent / "results.jsonl"
LIMIT = 600  # seconds for the tests of one mutant; a mutant that takes longer counts as killed
OUTCOMES = {0: "survived", 1: "killed"}  # by pytest's exit status; any other means that no test has run


def copied(folder: Path) -> Path:
    """Copy the working tree, without ignored files, to a folder, and return it."""
    for name in git("ls-files", "--cached", "--others", "--exclude-standard").splitlines():
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def tested(root: Path, tests: tuple[str, ...]) -> dict[str, Any]:
    """Run tests in a copy of the repository until the first one fails. Returns the outcome, the test and the time."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-rfE", "--tb=line", "--hypothesis-seed=0"]
    environment = os.environ | {
        "PYTHONPATH": str(root / "src"),
        "PYTHONDONTWRITEBYTECODE": "1",  # two versions of a file may have one size and one time
        "JAX_COMPILATION_CACHE_DIR": str(root.parent / "compiled"),  # most programs of a mutant are the code's own
    }
    began = time.perf_counter()
    options = {"cwd": root, "env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    try:
        done = subprocess.run([*command, "-p", "no:cacheprovider", *tests], timeout=LIMIT, check=False, **options)
        outcome, output = OUTCOMES.get(done.returncode, "broken"), done.stdout
    except subprocess.TimeoutExpired:
        outcome, output = "timeout", ""
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    seconds = round(time.perf_counter() - began, 1)
    return {"outcome": outcome, "by": failed[0] if failed else "", "seconds": seconds, "output": output}


def failing(root: Path, mutants: list[Mutant], workers: int) -> set[str]:
    """Run every test that the mutants name on the unchanged code, and return the files in which one fails.

    Their failures would mean nothing. This also fills the cache of compiled programs.
    """
    code = "import delayrl; print(delayrl.__file__)"
    options = {"cwd": root, "env": os.environ | {"PYTHONPATH": str(root / "src")}, "text": True, "check": True}
    place = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, **options).stdout.strip()
    if not place.startswith(str(root)):
        raise SystemExit(f"the tests would import {place} instead of the copy in {root}")

    def result_of(file: str) -> dict[str, Any]:
        names = {test for mutant in mutants for test in mutant.tests if test.partition("::")[0] == file}
        result = tested(root, (file,) if file in names else tuple(sorted(names)))
        print(f"unmutated  {file}  {result['seconds']:.0f} s  {result['outcome']}", flush=True)
        return result

    files = sorted({file for mutant in mutants for file in mutant.files})
    with ThreadPoolExecutor(workers) as pool:
        results = dict(zip(files, pool.map(result_of, files), strict=True))
    wrong = {file for file in files if results[file]["outcome"] != "survived"}
    print(*(results[file]["output"][-2000:] for file in sorted(wrong)), sep="\n", end="", flush=True)
    return wrong


def run(mutants: list[Mutant], workers: int, root: Path, known: dict[str, Any]) -> None:
    """Test mutants, each worker in a copy of its own, and append each result to the file."""
    commit = git("rev-parse", "--short", "HEAD") + " with changes" * bool(git("status", "--porcelain", "src", "tests"))
    copies: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for number in range(workers):
        copies.put(shutil.copytree(root, root.parent / f"worker{number}"))

    def row_of(mutant: Mutant) -> dict[str, Any]:
        copy = copies.get()
        file, original = copy / mutant.file, (copy / mutant.file).read_text(encoding="utf-8")
        file.write_text(original.replace(mutant.before, mutant.after), encoding="utf-8")
        last = known.get(mutant.name, {}).get("by", "")  # what killed it last time runs first
        first = (last,) if last.partition("::")[0] in mutant.files else ()
        result = tested(copy, (*first, *mutant.tests))
        file.write_text(original, encoding="utf-8")
        copies.put(copy)
        made = {"digest": mutant.digest(root), "commit": commit, "date": time.strftime("%Y-%m-%d")}
        return {"name": mutant.name, **result, **made}

    began = time.perf_counter()
    with ThreadPoolExecutor(workers) as pool:
        rows = as_completed([pool.submit(row_of, mutant) for mutant in mutants])
        for count, row in enumerate((future.result() for future in rows), 1):
            output = row.pop("output")
            left = (time.perf_counter() - began) / count * (len(mutants) - count) / 60
            print(
                f"[{count}/{len(mutants)}, {left:.0f} min left] {row['outcome']:8} {row['name']}  {row['by']}",
                flush=True,
            )
            if row["outcome"] == "broken":
                print(output[-2000:], flush=True)
            known[row["name"]] = row
            with RESULTS.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")


def current(mutant: Mutant, rows: dict[str, Any]) -> bool:
    """Tell whether there is a result of this mutant, with its file and its tests as they are."""
    row = rows.get(mutant.name, {"outcome": "broken"})
    return row["outcome"] != "broken" and not mutant.stale(ROOT) and row["digest"] == mutant.digest(ROOT)


def git(*words: str) -> str:
    """Return what a git command prints."""
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="mutants whose names contain a text")
    parser.add_argument("--workers", type=int, default=2, help="how many to test at a time (2)")
    parser.add_argument("--fresh", action="store_true", help="compute all results again")
    arguments = parser.parse_args()
    everything = read()
    stale = {mutant.name: why for mutant in everything if (why := mutant.stale(ROOT))}
    mutants = [mutant for mutant in everything if any(text in mutant.name for text in arguments.only)]
    mutants = [mutant for mutant in mutants if mutant.name not in stale]
    lines = RESULTS.read_text(encoding="utf-8").splitlines() if RESULTS.exists() else []
    known = {row["name"]: row for row in map(json.loads, lines)}
    due = [mutant for mutant in mutants if arguments.fresh or not current(mutant, known)]
    print(f"{len(mutants)} mutants, {len(mutants) - len(due)} of them with a current result", flush=True)
    if due:
        with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
            root = copied(Path(scratch) / "unmutated")
            wrong = failing(root, due, arguments.workers)
            for mutant in due:
                if wrong & mutant.files:
                    stale[mutant.name] = f"{mutant.name}: its tests fail without it"
            run([mutant for mutant in due if mutant.name not in stale], arguments.workers, root, known)
    rows = {mutant.name: known[mutant.name] for mutant in everything if mutant.name in known}
    RESULTS.write_text("".join(json.dumps(row) + "\n" for row in rows.values()), encoding="utf-8")
    older = {mutant.name for mutant in everything if mutant.name in rows and not current(mutant, rows)}
    (ROOT / "docs" / "mutants.md").write_text(page.text(everything, rows, older), encoding="utf-8")
    alive = [mutant for mutant in mutants if rows.get(mutant.name, {}).get("outcome") == "survived"]
    failed = [mutant.name for mutant in alive if not mutant.survives]
    for line in [*stale.values(), *(f"{name}: no test notices it" for name in failed)]:
        print(line, file=sys.stderr)
    raise SystemExit(bool(stale or failed))


if __name__ == "__main__":
    main()
