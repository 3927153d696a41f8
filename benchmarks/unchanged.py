"""Whether a redesign changed a result: record short runs before and after it, and compare bit for bit.

    python benchmarks/unchanged.py record before        # at the old commit
    python benchmarks/unchanged.py record after         # at the new commit, on the same machine
    python benchmarks/unchanged.py compare before after
    python benchmarks/unchanged.py reopen before        # at the new commit: old runs, bundles and tables still open

It uses only the command line and the public names of delayrl, so that it survives a move of every module. Compiled
arithmetic differs between processors and JAX versions; so both sides are recorded on one machine, and not committed.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

HERE = Path(__file__).parent
TASK = "InvertedPendulum-v5"
LENGTH = {
    "--steps": 480,
    "--random-steps": 120,
    "--evaluate-every": 160,
    "--evaluation-episodes": 2,
    "--replay-capacity": 300,
}
SAC = ["--hidden", "16", "16", "--batch-size", "16"]
VDPO = "--width 8 --layers 2 --dropout 0.1 --clone-every 40 --clone-updates 5".split()  # noqa: SIM905
DIDA = ["--expert-steps", "240", "--round-steps", "40", "--imitation-updates", "5", "--student-hidden", "8", "8"]
RUNS: dict[str, list[str]] = {
    "vdpo": ["vdpo", "--delay", "3", *SAC, *VDPO],
    "any-age": ["any-age", "--delay", "3", *SAC],
    "any-age-transformer": ["any-age", "--delay", "3", *SAC, "--encoder", "transformer", "--pull-weight", "1"],
    "lifting": ["lifting", "--delay", "3", *SAC, "--lifting-hold", "160", "--lifting-end", "400"],
    "ad-sac": ["ad-sac", "--delay", "3", *SAC],
    "dida": ["dida", "--delay", "3", *SAC, *DIDA],
    "dcac": ["dcac", "--delay", "3", *SAC],
    "bpql": ["bpql", "--delay", "3", *SAC],
    "a-sac": ["a-sac", "--delay", "3", *SAC],
    "sac-memoryless": ["sac-memoryless", "--delay", "3", *SAC],
    "sac": ["sac", *SAC],
    "random": ["random", "--delay", "3"],
    "vdpo-random-delay": ["vdpo", "--delay", "uniform:1:4", *SAC, *VDPO],
    "dcac-random-delay": ["dcac", "--delay", "paper-stochastic-5", *SAC],
    "a-sac-channels": ["a-sac", "--delay", "gilbert:0:3:0.3:0.4@fifo+action=1+reward=2", *SAC],
    "vdpo-official": ["vdpo", "--delay", "3", "--protocol", "official", *SAC, *VDPO],
    "ad-sac-official": ["ad-sac", "--delay", "3", "--protocol", "official", *SAC],
    "bpql-lockstep": ["bpql", "--delay", "3", "--seeds", "2", *SAC],
    "vdpo-blocks": ["vdpo", "--delay", "3", "--updates-per-call", "4", *SAC, *VDPO],
    "vdpo-stopped": ["vdpo", "--delay", "3", "--seed", "5", *SAC, *VDPO],
    "bpql-stopped": ["bpql", "--delay", "3", "--seeds", "2", "--updates-per-call", "4", *SAC],
}
STOPS = {"vdpo-stopped": 150, "bpql-stopped": 301}
"""Stopped once their environments have taken that many steps together, in the middle of a block, then resumed."""
DELAYS = (
    "0",
    "3",
    "uniform:1:4@fifo",
    "poisson:2:5@raw",
    "gamma:2:1:5",
    "markov:0,4:0.9,0.1/0.5,0.5",
    "walk:3",
    "choice:1=0.5,3=0.5",
    "2+action=1",
)
TABLES = ("first.sqlite", "updates-per-call.sqlite", "any-age-ladder.sqlite")
GRIDS = ("smoke", "first", "any-age-ladder", "paper-table1", "paper-table2", "paper-ablation", "paper-stochastic")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("record", "reopen"):
        commands.add_parser(name).add_argument("folder", type=Path)
    both = commands.add_parser("compare")
    both.add_argument("before", type=Path)
    both.add_argument("after", type=Path)
    commands.add_parser("stop", help=argparse.SUPPRESS).add_argument("folder", type=Path)
    given = parser.parse_args()
    if given.command == "record":
        record(given.folder)
    elif given.command == "reopen":
        reopen(given.folder)
    elif given.command == "stop":
        stop(given.folder)
    else:
        compare(facts_of(given.before), facts_of(given.after))


def record(folder: Path) -> None:
    """Train, export, evaluate and report; write what came out to facts.json."""
    folder.mkdir(parents=True)
    facts: dict[str, Any] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = {name: pool.submit(train, folder / "runs" / name, name) for name in RUNS}
        others: dict[str, Any] = {"wrappers": pool.submit(shown)}
        for grid in GRIDS:
            others[f"cells of {grid}"] = pool.submit(cells, grid, folder / "none")
        for table in TABLES:
            others[table] = pool.submit(report, folder, table)
        for name, run in (runs | others).items():
            facts[name] = run.result()
            print(name, "is recorded", flush=True)
    (folder / "facts.json").write_text(json.dumps(facts, indent=1))


def facts_of(folder: Path) -> dict[str, Any]:
    """What `record` wrote."""
    return dict(json.loads((folder / "facts.json").read_text()))


def reopen(folder: Path) -> None:
    """Open what an older version wrote: evaluate its runs, resume the one that was stopped, load its bundles."""
    before, after = facts_of(folder), dict[str, Any]()
    for name in RUNS:
        after[name] = before[name] | use(folder / "runs" / name, name)
    for name in STOPS:
        resumed = folder / "resumed" / name
        shutil.rmtree(resumed, ignore_errors=True)
        shutil.copytree(folder / "stopped" / name, resumed)
        delayrl("train", *RUNS[name], *common(resumed))
        after[name] |= results(resumed)
    after |= {table: report(folder, table) for table in TABLES}
    compare({name: before[name] for name in after}, after)


def compare(before: dict[str, Any], after: dict[str, Any]) -> None:
    """Say what differs; exit with 1 if anything does."""
    different = [name for name in before | after if before.get(name) != after.get(name)]
    for name in different:
        old, new = before.get(name), after.get(name)
        parts = [k for k in old if old[k] != new.get(k)] if isinstance(old, dict) and isinstance(new, dict) else ["all"]
        print(f"{name} differs: {', '.join(parts)}")
    print(f"{len(before) - len(different)} of {len(before)} are bitwise equal")
    sys.exit(bool(different))


def common(out: Path) -> list[str]:
    """The options of every run."""
    return [
        "--env",
        TASK,
        "--preset",
        "small",
        "--quiet",
        "--out",
        str(out),
        *(str(word) for pair in LENGTH.items() for word in pair),
    ]


def train(out: Path, name: str) -> dict[str, Any]:
    """Train one of RUNS; everything that it wrote, as digests."""
    if name in STOPS:
        subprocess.run([sys.executable, __file__, "stop", str(out)], check=False, env=quiet())
        (newest,) = sorted(next(iter(sorted(out.glob("seed*"))), out).glob("checkpoints/*/manifest.json"))[-1:]
        if json.loads(newest.read_text())["complete"]:
            raise SystemExit(f"{name} was to be stopped, but it is complete")
        shutil.copytree(out, out.parent.parent / "stopped" / name)
    delayrl("train", *RUNS[name], *common(out))
    return results(out) | use(out, name)


def stop(out: Path) -> None:
    """Train, and send this process SIGTERM in the middle of a step."""
    import signal
    from importlib.metadata import entry_points

    from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

    step, count = InvertedPendulumEnv.step, 0

    def counted(self: Any, action: Any) -> Any:
        nonlocal count
        count += 1
        if count == STOPS[out.name]:
            signal.raise_signal(signal.SIGTERM)
        return step(self, action)

    InvertedPendulumEnv.step = counted
    sys.argv = ["delayrl", "train", *RUNS[out.name], *common(out)]

    (command,) = entry_points(group="console_scripts", name="delayrl")
    command.load()()


def results(out: Path) -> dict[str, Any]:
    """What the finished runs of all seeds hold."""
    seeds = sorted(out.glob("seed*")) or [out]
    return {f"{key} {i}": value for i, run in enumerate(seeds) for key, value in result(run).items()}


def result(run: Path) -> dict[str, Any]:
    """Configuration, rows, metrics and weights of a finished run, whose optimiser states were once called memory."""
    config = json.loads((run / "config.json").read_text())
    metrics = (
        [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        if (run / "metrics.jsonl").exists()
        else []
    )
    (weights,) = run.glob("checkpoints/*/agent.safetensors")
    names = re.compile(r"(?<![^.])((?:\w+_)?)memory(?![^.])")
    arrays = {names.sub(r"\1opt_state", name): array for name, array in load_file(weights).items()}
    return {
        "config": {key: value for key, value in config.items() if key != "versions"},
        "rows": (run / "rows.jsonl").read_text(),
        "metrics": [{k: v for k, v in line.items() if not k.endswith("steps_per_second")} for line in metrics],
        "weights": {name: digest(f"{x.dtype}{x.shape}".encode() + x.tobytes()) for name, x in sorted(arrays.items())},
    }


def use(out: Path, name: str) -> dict[str, Any]:
    """What a run's policy returns, and its bundle."""
    run = next(iter(sorted(out.glob("seed*"))), out)
    facts: dict[str, Any] = {"evaluate": delayrl("evaluate", str(run), "--episodes", "2", "--json")}
    if name == "random":
        return facts
    facts["sweep"] = delayrl("evaluate", str(run), "--episodes", "1", "--sweep", "--json")
    (run / "delays.png").unlink()
    bundle = out.parent.parent / "bundles" / name
    if not bundle.exists():
        delayrl("export", str(run), "--out", str(bundle))
    from delayrl.deploy import load_bundle

    policy = load_bundle(bundle)
    obs, actions = np.linspace(-1, 1, 4), np.linspace(-1, 1, policy.max_age).reshape(-1, 1)
    acted = [policy(obs, actions, age).tolist() for age in range(policy.max_age + 1)]
    files = {file.name: digest(file.read_bytes()) for file in sorted(bundle.glob("*.safetensors"))}
    return facts | {"bundle": files, "bundle acts": acted}


def shown() -> dict[str, str]:
    """What the wrappers show of an episode, for many delays."""
    import gymnasium

    import delayrl as library

    facts = {}
    for text in DELAYS:
        for name in ("delayrl/Counter-v0", TASK):
            env = library.AugmentedObservation(library.make(name, text))
            seen: list[Any] = [env.reset(seed=3)]
            env.action_space.seed(0)
            for _ in range(120):
                seen.append(env.step(env.action_space.sample()))
                if seen[-1][2] or seen[-1][3]:
                    seen.append(env.reset())
            facts[f"{name} {text}"] = digest(repr(seen).encode())
        vector = library.AugmentedVectorObservation(library.DelayedVector(gymnasium.make_vec("Pendulum-v1", 3), text))
        seen = [vector.reset(seed=3)]
        vector.action_space.seed(0)
        seen += [vector.step(vector.action_space.sample()) for _ in range(220)]
        facts[f"vector {text}"] = digest(repr(seen).encode())
    return facts


def cells(grid: str, runs: Path) -> list[str]:
    """The cells of a grid that comes with the package, with their ids."""
    plan = delayrl("bench", "plan", grid, "--runs", str(runs))
    return plan.split("\n\n")[0].splitlines()


def report(folder: Path, table: str) -> dict[str, str]:
    """The report of a committed table, file by file."""
    out = folder / "reports" / table
    shutil.rmtree(out, ignore_errors=True)
    delayrl("bench", "report", str(HERE / "results" / table), "--out", str(out))
    return {str(file.relative_to(out)): digest(file.read_bytes()) for file in sorted(out.rglob("*.*"))}


def delayrl(*words: str) -> str:
    """Run a command of delayrl; what it printed."""
    done = subprocess.run([sys.executable, "-m", "delayrl", *words], capture_output=True, text=True, env=quiet())
    if done.returncode:
        raise SystemExit(f"delayrl {' '.join(words)} failed: {done.stderr.strip()}")
    return done.stdout


def quiet() -> dict[str, str]:
    """One thread each, and no GPU: the order of additions does not depend on the machine's load."""
    flags = "--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=1"
    return os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags, "OMP_NUM_THREADS": "1"}


def digest(data: bytes) -> str:
    """A short name for the bytes."""
    return hashlib.sha256(data).hexdigest()[:16]


if __name__ == "__main__":
    main()
