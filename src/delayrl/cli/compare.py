"""`delayrl compare A B …`: what differs between runs, in options and in returns."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from delayrl.cli.console import print_table
from delayrl.errors import DelayRLError
from delayrl.run.rows import number_in_words, shown_like

if TYPE_CHECKING:
    from delayrl.play.plots import Line
    from delayrl.play.run import Run

LABELS = "ABCDEFGH"
ABOUT = ("seed", "versions", "later_versions", "cost", "configuration", "format", "privileged")
"""Entries of a configuration that are no options."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the runs and the picture."""
    words = "two to eight run folders, or folders of the runs of several seeds"
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help=words)
    parser.add_argument("--out", type=Path, default=Path("compare.png"), help="the picture (default: compare.png)")


def run(given: argparse.Namespace) -> None:
    """Print the options that differ and the returns, and draw the learning curves."""
    from delayrl.play.plots import curves

    if not 2 <= len(given.runs) <= len(LABELS):
        raise DelayRLError(f"compare takes two to {len(LABELS)} runs; got {len(given.runs)}")
    if given.out.suffix not in (".png", ".pdf", ".svg"):
        raise DelayRLError(f"--out must end in .png, .pdf or .svg; got {given.out}")
    groups = [_seeds(path) for path in given.runs]
    configs = [group[0].config | {"delay": group[0].delay} for group in groups]
    learned = [_curve(group) for group in groups]  # what cannot be read is refused before anything is printed
    ends = [config["schedule"]["steps"] for config in configs]
    labels = LABELS[: len(groups)]
    for label, path, group in zip(labels, given.runs, groups, strict=True):
        print(f"{label}  {path}" + (f" ({len(group)} seeds)" if len(group) > 1 else ""))
    print()
    print_table(["option", *labels], differences(configs) or [["all options", *["the same"] * len(labels)]])
    lines = [
        (f"{label}: {config['agent']}, delay {config['delay']}", *curve)
        for label, config, curve in zip(labels, configs, learned, strict=True)
    ]
    print()
    _print_returns(labels, lines, ends)
    curves(lines, given.out, configs[0]["env"] if len({config["env"] for config in configs}) == 1 else "")
    print(f"{given.out}: learning curves")


def _seeds(path: Path) -> list["Run"]:
    """Return the runs of all seeds in a folder. Raises DelayRLError if they differ in more than the seed."""
    from delayrl.play.run import Run
    from delayrl.run.folder import seed_folders

    group = [Run(folder.path) for folder in seed_folders(path)]
    if apart := differences([one.config for one in group]):
        names = ", ".join(name for name, *_ in apart)
        raise DelayRLError(f"the seeds in {path} differ in {names}; name runs alone")
    return group


def _curve(group: Sequence["Run"]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return steps that all seeds have, [N], and mean returns, [seeds, N]. Raises DelayRLError if there are none."""
    from delayrl.report.statistics import common_steps

    means = [{int(step): float(x.mean()) for step, x in zip(*one.curve(), strict=True)} for one in group]
    steps, returns = common_steps(means)
    if not len(steps):
        path = group[0].path.parent if len(group) > 1 else group[0].path
        if all(means):
            raise DelayRLError(f"the seeds in {path} have no evaluation at a common step; name runs alone")
        raise DelayRLError(f"{path} has no whole evaluation: it has just begun, or its rows are lost")
    return steps, returns


def _print_returns(labels: str, lines: Sequence["Line"], ends: Sequence[int]) -> None:
    """Print the last and the mean return of each line, with intervals where there are several seeds.

    `ends` are the steps of complete runs. Of several seeds the last evaluation is the last that all of them have.
    """
    from delayrl.report.statistics import FEWEST, area, mean_interval

    rows = []
    for label, (_, steps, returns), end in zip(labels, lines, ends, strict=True):
        cells = [label, f"{int(steps[-1]):,}" + (f" of {end:,}" if steps[-1] < end else ""), len(returns)]
        for values in (returns[:, -1], area(steps, returns)):
            mean, bounds = float(values.mean()), mean_interval(values) if len(values) > 1 else ()
            like = shown_like(mean, *bounds)
            interval = f" [{', '.join(number_in_words(bound, like) for bound in bounds)}]" if bounds else ""
            cells.append(number_in_words(mean, like) + interval)
        rows.append(cells)
    print_table(["", "steps", "seeds", "last return", "mean over training"], rows)
    if seeds := [len(returns) for _, _, returns in lines if len(returns) > 1]:
        few = f"; with fewer than {FEWEST} it is about their range, and covers less" if min(seeds) < FEWEST else ""
        print(f"[low, high]: 95 % bootstrap interval over seeds{few}")


def differences(configs: Sequence[Mapping[str, Any]]) -> list[list[Any]]:
    """Return name and values of each option in which configurations differ; "-" where one has no such option."""
    options: list[dict[str, Any]] = [{} for _ in configs]
    for own, config in zip(options, configs, strict=True):
        for name, value in config.items():
            if name == "unnamed":  # checksums of parts that have no name
                own |= {f"what {part} holds": checksum for part, checksum in value.items()}
            elif name not in ABOUT:
                own |= value if isinstance(value, dict) else {name: value}
        if origin := own.get("from"):
            own["from"] = f"{origin.get('agent')} at step {origin.get('step')}, {str(origin.get('networks'))[:8]}"
    names = dict.fromkeys(name for own in options for name in own)
    rows = [[name, *(own.get(name, "-") for own in options)] for name in names]
    return [row for row in rows if any(value != row[1] for value in row[2:])]
