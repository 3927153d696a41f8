"""`delayrl train AGENT`: train an agent, or resume a run. `delayrl train RUN`: train a run further."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from delayrl.cli import agents
from delayrl.cli.console import Numbers, Parser, add_env_kwargs, add_stored, add_wrappers, quoted, whole
from delayrl.errors import DelayRLError
from delayrl.play.run import Run
from delayrl.run.folder import seed_folders
from delayrl.run.rows import return_in_words


def add_options(parser: Parser, words: Sequence[str]) -> None:
    """Add the options of the agent that comes first in `words`, with the defaults of their preset."""
    from delayrl.run.agents import agent_names, find_agent

    if not words or words[0].startswith("-"):
        if {"-h", "--help"} & set(words):
            print("usage: delayrl train AGENT --env ID --delay N [options]; `delayrl train AGENT --help` shows them")
            print("       delayrl train RUN --steps N; trains the run in this folder further\n")
            agents.run()
            parser.exit()
        raise DelayRLError("name the agent first, e.g. `delayrl train vdpo`; `delayrl agents` lists them")
    if seed_folders(words[0])[0].exists and words[0] not in agent_names():
        _add_options_of_a_run(parser, words[0])
        return
    if "/" in words[0] and ":" not in words[0]:
        raise DelayRLError(f"there is no run folder {words[0]}; `delayrl runs` lists the runs below runs/")
    agent = find_agent(words[0])
    parser.prog, parser.description = f"delayrl train {words[0]}", agent.summary
    parser.allow_abbrev = False
    first = Parser(prog=parser.prog, add_help=False, allow_abbrev=False)
    usual = "paper" if "paper" in agent.presets else next(iter(agent.presets))
    first.add_argument("--preset", choices=list(agent.presets), default=usual)
    preset = first.parse_known_args(words)[0].preset

    add = parser.add_argument
    add("agent", help=argparse.SUPPRESS)
    add("--env", required=True, metavar="ID", help="a Gymnasium task (`delayrl tasks` lists some), or MODULE:NAME")
    add_env_kwargs(parser)
    add_wrappers(parser)
    add("--delay", default="0", metavar="DELAY", help="steps, or e.g. 80ms, uniform:1:5 (default: 0)")
    add("--preset", choices=list(agent.presets), default=usual, help=f"the defaults of the options (default: {usual})")
    add("--seed", type=whole, default=0, metavar="K", help="fixes everything (default: 0)")
    add("--seeds", type=whole, default=1, metavar="N", help="train seeds K..K+N-1 in lockstep (default: 1)")
    add("--out", type=Path, metavar="DIR", help="the run folder (default: below runs/)")
    add("--from", type=Path, dest="start_from", metavar="RUN", help="begin with the networks of this run that fit")
    add("--overwrite", action="store_true", help="start afresh where a run exists")
    add("--protocol", choices=["corrected", "official"], default="corrected", help="official: like the released code")
    _add_ways(parser)
    base = agent.presets[preset]
    _add_group(parser, f"schedule (preset {preset})", base.schedule)
    _add_group(parser, f"hyperparameters (preset {preset})", base.agent)


def _add_options_of_a_run(parser: Parser, folder: str) -> None:
    parser.prog, parser.description = f"delayrl train {folder}", "Train a run further, with its own options."
    parser.add_argument("run", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--steps", type=whole, required=True, help="the new number of steps, from the run's beginning")
    add_stored(parser)
    _add_ways(parser)


def _add_ways(parser: Parser) -> None:
    """Add the options that do not change what is learned."""
    add = parser.add_argument
    add("--device", choices=["cpu", "gpu"], help="where to compute (default: JAX's choice)")
    add("--track", choices=["tensorboard", "wandb"], help="log to this service as well")
    add("--threads", type=whole, default=1, help="threads that step the environments (default: 1)")
    add("--slim", action="store_true", help="delete the replay at the end: the run cannot be trained further then")
    add("--quiet", action="store_true", help="show no progress bar and no notes")


def _add_group(parser: Parser, title: str, config: Any) -> None:
    from delayrl.run.configuration import options

    group = parser.add_argument_group(title)
    for option in options(config):
        settings: dict[str, Any] = {"type": _reader(option.kind), "metavar": "VALUE"}
        default = option.default
        if get_origin(option.kind) is Literal:
            settings = {"choices": get_args(option.kind), "type": type(get_args(option.kind)[0])}
        elif get_origin(option.kind) is tuple:
            settings |= Numbers.of(_reader(get_args(option.kind)[0]))
            default = " ".join(map(str, default))
        name = f"--{option.name.replace('_', '-')}"
        words = f"{option.help} (default: {default})".replace("%", "%%")
        try:
            group.add_argument(name, default=argparse.SUPPRESS, help=words, **settings)
        except argparse.ArgumentError as error:
            raise DelayRLError(f"the agent has an option {name}, as the command has: give it another name") from error


def _reader(kind: Any) -> Any:
    return whole if kind is int else kind


def run(given: argparse.Namespace) -> None:
    """Train, and print the results of each run."""
    from delayrl.training.further import go_on
    from delayrl.training.train import train

    values = dict(vars(given))
    if "env_kwargs" in values:
        values["env_kwargs"] = dict(values["env_kwargs"])
    runs = (go_on if "run" in values else train)(progress=not values.pop("quiet"), **values)
    for result in runs if isinstance(runs, list) else [runs]:
        _print_summary(result)


def _print_summary(run: Run) -> None:
    """Print the last returns of a run, its folder, and what to type next."""
    config, last = run.config, max(run.curve().steps, default=0)
    about = f"{config['agent']} on {config['env']}, delay {run.delay}, seed {config['seed']}"
    print(f"{about}: {last:,} steps")
    label = "return under delay" if config["delay"] != 0 else "return"
    for policy, text in (("agent", label), ("reference", "its reference, no delay")):
        steps, returns = run.curve(policy)
        if last in steps:
            print(f"  {text:<24} {return_in_words(returns[-1])}")
    print(f"  run folder               {run.path}")
    print(f"  learning curve           {run.path / 'curve.png'}")
    print(f"  next                     delayrl evaluate {quoted(run.path)} --episodes 20")
    print(f"                           delayrl watch {quoted(run.path)} --out episode.gif")
