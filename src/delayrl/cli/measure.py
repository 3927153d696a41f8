"""`delayrl measure ENV|LOG`: the options and the printed result."""

import argparse
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path

from tqdm import tqdm

from delayrl.cli.console import add_env_kwargs, add_wrappers, seconds, whole
from delayrl.envs.task import as_task
from delayrl.errors import DelayRLError, count
from delayrl.measure.estimated import Estimated
from delayrl.measure.log import from_log
from delayrl.measure.plot import plot
from delayrl.measure.probing import Counts, Probed, probe
from delayrl.measure.reading import UNITS, doubt

COLUMNS = ("time", "commands", "observations", "episode", "stamp", "received")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `delayrl measure`."""
    add = parser.add_argument
    add(
        "target",
        metavar="ENV|LOG",
        help="a Gymnasium task, or module:function that makes one; or a CSV or Parquet file",
    )
    add("--json", action="store_true", help="print one JSON object")
    add("--seed", type=whole, default=0, help="seed of the episodes, or of the bootstrap (default: 0)")
    words = "the longest delay to look for: steps (200), or time (100 rows of the log)"
    add("--longest", type=_steps_or_seconds, metavar="N|TIME", help=words)
    environment = parser.add_argument_group("environment")
    environment.add_argument("--episodes", type=whole, help="episodes to play (default: 8)")
    add_env_kwargs(environment)
    add_wrappers(environment)
    add = parser.add_argument_group("log").add_argument
    words = "control period, e.g. 20ms or 50Hz (default: the spacing of the rows)"
    add("--period", type=seconds, metavar="TIME", help=words)
    add("--time", metavar="NAME", help="column of the time stamps (default: time, timestamp or t)")
    add(
        "--commands",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="columns, or how they begin (default: command, cmd, action)",
    )
    add(
        "--observations",
        metavar="NAME",
        nargs="+",
        action="extend",
        help="columns, or how they begin (default: observation, obs)",
    )
    add("--episode", metavar="NAME", help="column that changes where a new recording begins")
    add("--stamp", metavar="NAME", help="column of the time when an observation was made (default: stamp)")
    add("--received", metavar="NAME", help="column of the time when it arrived (default: received)")
    add("--unit", choices=list(UNITS), help="unit of the time stamps (default: s)")
    words = "time to leave out at the start (default: a twentieth of the log)"
    add("--warm-up", type=seconds, metavar="TIME", help=words)
    add("--plot", type=Path, metavar="FILE", help="plot the result as .png, .svg or .pdf")
    add("--save", type=Path, metavar="FILE", help="write a delay of each step, for --delay recorded:FILE (with stamps)")


def run(given: argparse.Namespace) -> None:
    """Measure the delay and print it."""
    path = Path(given.target)
    if os.path.isfile(path) or path.suffix.lower() in (".csv", ".tsv", ".txt", ".parquet", ".pq"):
        _refuse(given, ("episodes", "env_kwargs", "wrappers", "flatten"), "an environment", "a log")
        if isinstance(given.longest, int):
            raise DelayRLError(f"--longest is a time such as 200ms in a log; got {given.longest}")
        options = {name: getattr(given, name) for name in (*COLUMNS, "period", "longest", "warm_up", "seed")}
        result = from_log(given.target, **options, unit=given.unit)
        if given.save:
            result.save(given.save)
        if given.plot:
            plot(result, given.plot)
        doubtful = given.unit is None and doubt(result.row, result.period, None, result.method) != ""
        print(json.dumps(result.json()) if given.json else _show_log(result, given.save, doubtful))
        return
    _refuse(given, ("period", *COLUMNS, "unit", "warm_up", "plot", "save"), "a log", "an environment")
    if isinstance(given.longest, float):
        raise DelayRLError(f"--longest counts steps of an environment; got {given.longest:g} s")
    longest = 200 if given.longest is None else given.longest
    episodes = 8 if given.episodes is None else given.episodes
    bar = partial(tqdm, desc="pushing", unit="episode", leave=False, disable=None)  # None: only on a terminal
    task = as_task(given.target, dict(given.env_kwargs), given.wrappers, given.flatten)
    probed = probe(task, episodes, given.seed, longest, bar)
    print(json.dumps(probed.json()) if given.json else _show_environment(probed))


def _steps_or_seconds(text: str) -> int | float:
    for read in (whole, seconds):
        with suppress(argparse.ArgumentTypeError):
            return read(text)
    raise argparse.ArgumentTypeError(f"must be a number of steps, or a time such as 20ms or 0.02s; got {text!r}")


def _show_environment(p: Probed) -> str:
    lines = [f"{p.environment}: {p.episodes} episodes of at most {p.length} steps, one action changed at a time", ""]
    for title, counts in (("action", p.action), ("observation", p.observation), ("total", p.total)):
        lines += _counts(f"{title} delay", counts)
    lines += ["", "0 is no delay: the observation that step(a) returns reacts to that a."]
    lines.append(f"Acting is seen from {p.action_from}.")
    if p.lost > 0:
        lines.append(f"{p.lost:.0%} of the actions changed nothing: held, overtaken or without effect where they came.")
    if p.echoes:
        lines += [f"Components {_ranges(p.echoes)} of the observation repeat the action itself; they are not counted."]
    components: dict[int, list[int]] = {}
    for component, steps in enumerate(p.components):
        if steps is not None:
            components.setdefault(steps, []).append(component)
    if len(components) > 1:
        each = "; ".join(f"{_ranges(numbers)} after {steps}" for steps, numbers in sorted(components.items()))
        lines.append(f"Components of the observation react at the earliest: {each}.")
        if 0 in components:
            lines.append(
                f"Those that react at once ({_ranges(components[0])}) hide the delay of the others. If they are made"
            )
            lines.append("from the action, such as an error or a command in other units, measure without them.")
    if p.maximum:
        actions = count(p.maximum, "action")
        lines += ["", f"An agent must remember {actions}. `delayrl train` does not see this delay:"]
        lines.append("remove it from the environment, and give it as --delay.")
    return "\n".join(lines)


def _counts(title: str, counts: Counts | None) -> list[str]:
    if counts is None:
        return [f"{title:<18} unknown"]
    if len(counts) == 1:
        ((steps, times),) = counts.items()
        return [f"{title:<18} {count(steps, 'step')}  ({times} times)"]
    total = sum(counts.values())
    mean = sum(steps * times for steps, times in counts.items()) / total
    head = f"{title:<18} {min(counts)} to {max(counts)} steps, mean {mean:.2f}, {total} times"
    return [head] + [f"{'':<18}   {steps:>3}  {times / total:6.1%}" for steps, times in counts.items()]


def _show_log(e: Estimated, saved: Path | None, doubtful: bool) -> str:
    lines = [f"{e.path}: {e.rows:,} rows, one each {_ms(e.row)}, without the first {e.warm_up:.3g} s", ""]
    lines += _show_stamps(e) if e.method == "stamps" else _show_correlation(e)
    if doubtful:
        lines += [
            "",
            "which delay to train with depends on the units: give --unit, that of the time stamps, and --period",
        ]
    elif e.in_step == e.train_with:
        lines += ["", f"train with: --delay {e.train_with}"]
    else:
        lines += ["", f"train with: --delay {e.train_with:<12} if the sensor runs on a clock of its own"]
        lines.append(f"        or: --delay {e.in_step:<12} if it is in step with the control loop")
    if saved:
        lines.append(f"        or: --delay recorded:{saved}")
    return "\n".join(lines)


def _show_stamps(e: Estimated) -> list[str]:
    spread = f"{_ms(e.low)} to {_ms(e.high)} for 95 % of the observations"
    lines = [f"delay (received - stamp)  {_ms(e.delay)} median, {spread}", f"{'':<26}{_ms(e.longest)} at worst"]
    if e.slowest_warm_up is not None:
        lines.append(f"{'during the warm-up':<26}{_ms(e.slowest_warm_up)} at worst; not counted")
    lines.append(f"{'age when the next arrives':<26}{_ms(e.span[1])} or less for 99 % of those in use")
    lines.append(f"{'in steps of ' + _ms(e.period):<26}" + _shares(e.counts))
    note = "Exact if one clock gave both stamps: an offset between two clocks is in every delay, and cannot be seen."
    lines += [note, "It is the way of the observation alone: if commands act N steps late, add +action=N."]
    if e.drift is not None and abs(e.drift) > 200:
        lines.append(f"The smallest delays change by {e.drift:.0f} parts per million: the clocks may run apart.")
    return lines


def _show_correlation(e: Estimated) -> list[str]:
    assert e.peak is not None
    peak = f"at {_ms(e.peak.lag)}, r = {e.peak.r:.2f}, {e.peak.command} and {e.peak.observation}"
    lines = [
        f"{'dead time':<26}{_ms(e.delay)}, 95 % between {_ms(e.low)} and {_ms(e.high)}",
        f"{'':<26}{e.strength:.1f} times what chance gives in one log of a thousand",
        f"{'increments correlate most':<26}{peak}",
    ]
    if e.wait > 0:
        lines.insert(1, f"{'':<26}(up to {_ms(e.wait)} of it until the sensor is read again)")
    if e.peak.lag >= e.delay:  # with feedback in the commands it may be earlier
        lines.append(f"{'':<26}(that is the dead time, the plant's own lag, and a row)")
    if e.echoes:
        lines.append(f"{', '.join(e.echoes)} {'repeats' if len(e.echoes) == 1 else 'repeat'} a command:")
        kept = e.peak.observation in e.echoes
        what = (
            "the answer may not be the plant's; name others" if kept else "left out; if it is a sensor, name it alone"
        )
        lines.append(f"{'':<26}{what} (--observations)")
    if len(e.windows) > 1:
        parts = ", ".join(f"{delay * 1e3:.4g}" for _, delay in e.windows)
        lines.append(f"{'in parts of the log':<26}{parts} ms")
    shares = f"; parts: {_shares(e.counts)}" if len(e.counts) > 1 else ""
    lines.append(f"{'in steps of ' + _ms(e.period):<26}{e.step}{shares}")
    if e.renewed is not None and e.renewed > 1.2 * e.period:
        every = f"The observation changes every {_ms(e.renewed)}, more rarely than the loop decides"
        lines.append(f"{every}: its age varies, and this is one of its values. Log stamps instead (docs/measure.md).")
    if e.high - e.low > 4.5 * e.row:
        lines += ["The log does not settle it: the interval is wide. --plot shows what else is there; log more rows."]
    if e.row > 0.6 * e.period:
        lines.append("Rows are as far apart as steps: up to one step more cannot be seen. Log faster to see it.")
    return lines


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.4g} ms"


def _shares(counts: Counts) -> str:
    total = sum(counts.values())
    most = sorted(counts.items(), key=lambda item: -item[1])[:8]
    text = ", ".join(f"{steps} ({count / total:.0%})" for steps, count in sorted(most))
    return text + (f" and {len(counts) - 8} rarer" if len(counts) > 8 else "")


def _ranges(numbers: Iterable[int]) -> str:
    """Return numbers as ranges, such as `0-3, 7`."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(f"{low}" if low == high else f"{low}-{high}" for low, high in runs)


def _refuse(given: argparse.Namespace, names: tuple[str, ...], of: str, target: str) -> None:
    """Raise DelayRLError if an option was given that the target does not have."""
    for name in names:
        value = getattr(given, name)
        if value is not None and value is not False and value != []:
            option = "wrapper" if name == "wrappers" else name.replace("_", "-")
            raise DelayRLError(f"--{option} is an option of {of}; {given.target} is taken for {target}")
