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
    evaluate.add_argument("--delay", metavar="DELAY", help="another delay than the one it was trained for")
    evaluate.add_argument("--sweep", action="store_true", help="every delay from 0 to the longest, with a picture")
    evaluate.add_argument("--seed", type=int, default=0, help="of the start states (default: 0)")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")

    watch = commands.add_parser("watch", help="render an episode to a file")
    watch.add_argument("run", type=Path, help="the run folder")
    watch.add_argument("--out", type=Path, required=True, help="an .mp4 or .gif file")
    watch.add_argument("--delay", metavar="DELAY", help="another delay than the one it was trained for")
    watch.add_argument("--seed", type=int, default=0, help="of the start state (default: 0)")

    measure = commands.add_parser("measure", help="measure the delay of an environment, or from a log")

    export = commands.add_parser("export", help="write a run's policy as a bundle, for use without JAX")
    export.add_argument("run", type=Path, help="the run folder")
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    export.add_argument("--force", action="store_true", help="replace a bundle that lies there")

    latency = commands.add_parser("latency", help="measure how long one decision of a bundle takes")
    latency.add_argument("bundle", type=Path, help="its folder")
    latency.add_argument("--period", type=float, metavar="MS", help="the control period (default: the task's step)")
    latency.add_argument("--backend", choices=["numpy", "onnx", "jax"], help="(default: all that are installed)")
    latency.add_argument("--ages", type=int, nargs="+", metavar="N", help="(default: 5, 25, 50 and the longest)")
    latency.add_argument("--decisions", type=int, default=2000, metavar="N", help="for each age (default: 2000)")

    push = commands.add_parser("push", help="upload a bundle to the Hugging Face Hub")
    push.add_argument("bundle", type=Path, help="its folder")
    push.add_argument("repo", help="OWNER/NAME")
    push.add_argument("--private", action="store_true", help="where the repository is new")

    pull = commands.add_parser("pull", help="download a bundle from the Hugging Face Hub, and check it")
    pull.add_argument("repo", help="OWNER/NAME")
    pull.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    pull.add_argument("--revision", help="a branch, tag or commit")
    pull.add_argument("--force", action="store_true", help="replace a bundle that lies there")

    commands.add_parser("bench", help="run a grid of agents, tasks, delays and seeds", add_help=False)
    commands.add_parser("agents", help="list the agents")
    commands.add_parser("tasks", help="list the tasks")

    if arguments[:1] == ["train"]:
        _train(arguments[1:])
        return
    if arguments[:1] == ["measure"]:
        from delayrl.cli import measure as command

        command.add_options(measure)
        command.run(parser.parse_args(arguments))
        return
    if arguments[:1] == ["bench"]:
        from delayrl.cli.bench import bench

        bench(arguments[1:])
        return
    given = parser.parse_args(arguments)
    {
        "evaluate": _evaluate,
        "watch": _watch,
        "export": _export,
        "latency": _latency,
        "push": _push,
        "pull": _pull,
        "agents": _agents,
        "tasks": _tasks,
    }[given.command](given)


def _train(arguments: list[str]) -> None:
    from delayrl.run.configuration import check_names, options

    name = arguments[0] if arguments and not arguments[0].startswith("-") else None
    if name is None:
        if {"-h", "--help"} & set(arguments):
            print("usage: delayrl train AGENT --env ID --delay N [options]; `delayrl train AGENT --help` shows them\n")
            _agents(None)
            return
        raise DelayRLError("name the agent to train, e.g. `delayrl train vdpo`; `delayrl agents` lists them")
    from delayrl.training.train import find_agent, train

    entry = find_agent(name)
    first = Parser(prog=f"delayrl train {name}", add_help=False)
    first.add_argument("--preset", choices=list(entry.presets), default="paper")
    preset = first.parse_known_args(arguments[1:])[0].preset
    base = entry.presets[preset]

    parser = Parser(prog=f"delayrl train {name}", description=entry.summary, allow_abbrev=False)
    parser.add_argument("--env", required=True, metavar="ID", help="a Gymnasium task; `delayrl tasks` lists some")
    parser.add_argument("--delay", default="0", metavar="DELAY", help="steps, or e.g. 80ms, uniform:1:5 (default: 0)")
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
    parser.add_argument("--threads", type=int, default=1, help="that step the environments (default: 1)")
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
        ("agent", "return under delay" if config["delay"] != 0 else "return"),
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
    from delayrl.play.evaluation import evaluate, sweep

    if given.sweep:
        if given.delay is not None:
            raise DelayRLError("--sweep plays every delay; leave --delay out")
        from tqdm import tqdm

        from delayrl.play.policy import load

        delays = load(given.run).spec.delay + 1
        bar = tqdm(sweep(given.run, given.episodes, given.seed), total=delays, unit="delay", disable=given.json)
        _sweep(given, list(bar))
        return
    result = evaluate(given.run, given.episodes, given.delay, given.seed)
    if given.json:
        print(json.dumps(result))
        return
    print(
        f"{result['agent']} on {result['env']}, delay {result['delay']}: return {result['mean_return']:.1f} "
        f"± {result['std_return']:.1f} over {result['episodes']} episodes"
    )


def _sweep(given: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    from delayrl.play.plots import against_delay

    if given.json:
        print(json.dumps(results))
    else:
        rows = [[r["delay"], f"{r['mean_return']:.1f}", f"{r['std_return']:.1f}", r["episodes"]] for r in results]
        _table(["delay", "mean return", "std", "episodes"], rows)
    picture = given.run / "delays.png"
    against_delay(results, picture)
    print(f"picture: {picture}", file=sys.stderr)


def _watch(given: argparse.Namespace) -> None:
    from delayrl.play.video import watch

    frames, total = watch(given.run, given.out, given.delay, given.seed)
    print(f"{given.out}: {frames} frames, return {total:.1f}")


def _export(given: argparse.Namespace) -> None:
    from delayrl.deploy.export import export_run

    metadata = export_run(given.run, given.out, force=given.force)
    print(f"{given.out}: {metadata['agent']} on {metadata['env']}, ages 0..{metadata['ages'][1]}")
    print(f"  next                     delayrl latency {given.out}")


def _latency(given: argparse.Namespace) -> None:
    from delayrl.deploy.bundle import BACKENDS, load_bundle
    from delayrl.deploy.latency import available, latency, table

    policy = load_bundle(given.bundle)
    period = given.period if given.period is not None else policy.dt and 1000 * policy.dt
    if period is not None and not 0 < period < float("inf"):
        raise DelayRLError(f"--period takes milliseconds above 0; got {period:g}")
    chosen = [given.backend] if given.backend else [name for name in BACKENDS if available(name)]
    rows = {name: latency(given.bundle, name, decisions=given.decisions, ages=given.ages) for name in chosen}
    _table(*table(rows, period))
    told = f"control period {period:g} ms" if period else "control period unknown: give --period MS"
    print(f"\n{given.decisions:,} decisions each, back to back, on one thread of one core; {told}")


def _push(given: argparse.Namespace) -> None:
    from delayrl.deploy.hub import push

    print(push(given.bundle, given.repo, private=given.private))


def _pull(given: argparse.Namespace) -> None:
    from delayrl.deploy.hub import plain, pull

    metadata = pull(given.repo, given.out, revision=given.revision, force=given.force)
    agent, env, longest = plain(metadata.get("agent")), plain(metadata.get("env")), metadata["policy"]["max_age"]
    print(f"{given.out}: {agent} on {env}, ages 0..{longest}")


def _agents(given: Any) -> None:
    from delayrl.agents.registry import AGENTS

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
