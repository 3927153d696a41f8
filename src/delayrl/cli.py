"""The command line. Every error that a person can make or meet is one line on stderr and a non-zero exit."""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

import numpy as np

from delayrl.errors import DelayRLError


class Parser(argparse.ArgumentParser):
    """argparse, with its errors in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage."""
        raise DelayRLError(f"{message.replace('argument ', '')} (see `{self.prog} --help`)")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `delayrl`."""
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
    except DelayRLError as error:
        print(f"delayrl: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # before OSError, which it is
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"delayrl: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def _run(arguments: list[str]) -> None:
    parser = Parser(prog="delayrl", description="Reinforcement learning when observations arrive late.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    commands.add_parser("train", help="train an agent, or resume a run", add_help=False)

    evaluate = commands.add_parser("evaluate", help="play a trained policy on start states that it never saw")
    evaluate.add_argument("run", type=Path, help="the run folder")
    evaluate.add_argument("--episodes", type=int, default=10, help="how many (default: 10)")
    evaluate.add_argument("--delay", type=_delay, help="another delay than the one it was trained for")
    evaluate.add_argument("--seed", type=int, default=0, help="of the start states (default: 0)")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")

    watch = commands.add_parser("watch", help="render an episode to a file")
    watch.add_argument("run", type=Path, help="the run folder")
    watch.add_argument("--out", type=Path, required=True, help="an .mp4 or .gif file")
    watch.add_argument("--delay", type=_delay, help="another delay than the one it was trained for")
    watch.add_argument("--seed", type=int, default=0, help="of the start state (default: 0)")

    commands.add_parser("bench", help="run a grid of agents, tasks, delays and seeds", add_help=False)
    commands.add_parser("agents", help="list the agents")
    commands.add_parser("tasks", help="list the tasks")

    if arguments[:1] == ["train"]:
        _train(arguments[1:])
        return
    if arguments[:1] == ["bench"]:
        from delayrl.experiments.cli import bench

        bench(arguments[1:])
        return
    given = parser.parse_args(arguments)
    {"evaluate": _evaluate, "watch": _watch, "agents": _agents, "tasks": _tasks}[given.command](given)


def _train(arguments: list[str]) -> None:
    from delayrl.config import check_names, options

    name = arguments[0] if arguments and not arguments[0].startswith("-") else None
    if name is None:
        if {"-h", "--help"} & set(arguments):
            print("usage: delayrl train AGENT --env ID --delay N [options]; `delayrl train AGENT --help` shows them\n")
            _agents(None)
            return
        raise DelayRLError("name the agent to train, e.g. `delayrl train vdpo`; `delayrl agents` lists them")
    from delayrl.training import find_agent, train

    entry = find_agent(name)
    first = Parser(prog=f"delayrl train {name}", add_help=False)
    first.add_argument("--preset", choices=list(entry.presets), default="paper")
    preset = first.parse_known_args(arguments[1:])[0].preset
    base = entry.presets[preset]

    parser = Parser(prog=f"delayrl train {name}", description=entry.summary, allow_abbrev=False)
    parser.add_argument("--env", required=True, metavar="ID", help="a Gymnasium task; `delayrl tasks` lists some")
    parser.add_argument("--delay", type=_delay, default=0, metavar="N", help="environment steps (default: 0)")
    parser.add_argument("--preset", choices=list(entry.presets), default="paper", help="the defaults (default: paper)")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="fixes everything (default: 0)")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="train seeds K..K+N-1 in lockstep (default: 1)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="the run folder (default: below runs/)")
    parser.add_argument("--device", choices=["cpu", "gpu"], help="(default: what JAX finds)")
    parser.add_argument("--overwrite", action="store_true", help="start afresh where a run exists")
    parser.add_argument(
        "--protocol", choices=["corrected", "official"], default="corrected", help="official: as the released code does"
    )
    parser.add_argument("--track", choices=["tensorboard", "wandb"], help="log there too")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    for title, config in (("schedule", base.schedule), ("hyperparameters", base.agent)):
        group = parser.add_argument_group(f"{title} (preset {preset})")
        for option in options(config):
            words: dict[str, Any] = {"type": option.kind}
            if get_origin(option.kind) is Literal:
                words = {"choices": get_args(option.kind)}
            elif get_origin(option.kind) is tuple:
                words = {"type": get_args(option.kind)[0], "nargs": "+"}
            shown = " ".join(map(str, option.default)) if isinstance(option.default, tuple) else option.default
            metavar = None if "choices" in words else "VALUE"
            group.add_argument(
                f"--{option.name.replace('_', '-')}",
                default=argparse.SUPPRESS,
                metavar=metavar,
                help=f"{option.help} (default: {shown})",
                **words,
            )
    given, rest = parser.parse_known_args(arguments[1:])
    unknown = [word for word in rest if word.startswith("--")]
    names = [word[2:].split("=")[0].replace("-", "_") for word in unknown]
    check_names(names, base.agent, base.schedule, also=[key for key in vars(given) if key not in names])
    if rest:
        raise DelayRLError(f"unexpected {' '.join(rest)!r} (see `delayrl train {name} --help`)")
    values = vars(given)
    own = {key: values.pop(key) for key in ("env", "delay", "quiet")}
    runs = train(name, own["env"], own["delay"], progress=not own["quiet"], **values)
    for run in runs if isinstance(runs, list) else [runs]:
        _summary(run)


def _summary(run: Any) -> None:
    """What came out, where it lies, what to type next."""
    rows, config = run.read("rows"), run.config
    last = max((row["step"] for row in rows), default=0)
    print(f"{config['agent']} on {config['env']}, delay {config['delay']}, seed {config['seed']}: {last:,} steps")
    for policy, label in (
        ("agent", "return under delay" if config["delay"] else "return"),
        ("reference", "its reference, no delay"),
    ):
        returns = [row["return"] for row in rows if row["step"] == last and row["policy"] == policy]
        if returns:
            print(f"  {label:<24} {np.mean(returns):.1f} ± {np.std(returns):.1f}  ({len(returns)} episodes)")
    print(f"  run folder               {run.path}")
    print(f"  learning curve           {run.path / 'curve.png'}")
    print(f"  next                     delayrl evaluate {run.path} --episodes 20")
    print(f"                           delayrl watch {run.path} --out episode.gif")


def _evaluate(given: argparse.Namespace) -> None:
    from delayrl.evaluation import evaluate

    result = evaluate(given.run, given.episodes, given.delay, given.seed)
    if given.json:
        print(json.dumps(result))
        return
    print(
        f"{result['agent']} on {result['env']}, delay {result['delay']}: return {result['mean_return']:.1f} "
        f"± {result['std_return']:.1f} over {result['episodes']} episodes"
    )


def _watch(given: argparse.Namespace) -> None:
    from delayrl.video import watch

    frames, total = watch(given.run, given.out, given.delay, given.seed)
    print(f"{given.out}: {frames} frames, return {total:.1f}")


def _agents(given: Any) -> None:
    from delayrl.agents import AGENTS

    _table(["agent", "what it is", "paper"], [[name, e.summary, e.paper] for name, e in AGENTS.items()])


def _tasks(given: Any) -> None:
    from delayrl.envs import tasks

    head = ["task", "observation", "action", "range", "time limit", "seconds a step"]
    rows = [
        [
            t.name,
            t.obs_size,
            t.action_size,
            f"±{t.action_high:g}",
            t.time_limit or "-",
            f"{t.seconds:g}" if t.seconds else "-",
        ]
        for t in tasks()
    ]
    _table(head, rows)
    print("\nAny other Gymnasium task with flat Box observations and bounded Box actions works as well.")


def _table(head: list[str], rows: list[list[Any]]) -> None:
    cells = [head, *[[str(cell) for cell in row] for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    for row in cells:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _delay(text: str) -> int:
    from delayrl.delays import Constant

    try:
        number = float(text)
    except ValueError:
        raise DelayRLError(f"--delay takes a number of environment steps; got {text!r}") from None
    return Constant(int(number) if number.is_integer() else number).steps  # type: ignore[arg-type]
