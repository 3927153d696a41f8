"""Compare policies that know about the delay with ones that do not: simulator and controller talk over UDP.

python examples/udp_demo/demo.py --policy RUN      (a run folder, a bundle, or "predictor", which needs no training)

To train a policy: delayrl train vdpo --env InvertedPendulum-v5 --delay 5 --preset small --out RUN
"""

import argparse
import json
import subprocess
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from link import Link

from delayrl.errors import needs_extra

HERE = Path(__file__).parent
Row = dict[str, Any]


@dataclass(frozen=True)
class Scenario:
    """A network, the controller behind it, and whether it runs in real time.

    The controller `delayed` keeps the history. So does `deaf`, but it ignores what the actuator reports. `blind` takes
    every observation for the current one.
    """

    name: str
    link: Link
    controller: str
    real_time: bool = False


ROUGH = Link(2, 5, loss=0.1, double=0.05)
BOTH = ("blind", "delayed")
SCENARIOS = [
    Scenario("no delay", Link(), "blind"),
    *(Scenario("5 steps late", Link(5, 5), controller) for controller in BOTH),
    *(Scenario("3 to 5 steps late", Link(3, 5), controller) for controller in BOTH),
    *(Scenario("2 to 5 steps late, 10 % lost, 5 % twice", ROUGH, controller) for controller in BOTH),
    *(
        Scenario("so, and 20 % of the commands lost", replace(ROUGH, missed=0.2), controller)
        for controller in ("blind", "deaf", "delayed")
    ),
]
REAL_TIME = [
    Scenario("real time, 2 to 5 steps late, 10 % lost, 5 % twice", ROUGH, controller, real_time=True)
    for controller in BOTH
]


def play(scenario: Scenario, policy: str, episodes: int, seed: int, steps: int | None = None) -> tuple[list[Row], Row]:
    """Run both processes to their end; return a row for each episode, and the controller's statistics.

    Raises:
        SystemExit: with the error message of a process that failed.
    """
    network = [f"--{name}={value}" for name, value in asdict(scenario.link).items()]
    options = ["--real-time"] if scenario.real_time else []
    limit = [f"--steps={steps}"] if steps else []
    plant = _start("simulator.py", *network, f"--episodes={episodes}", f"--seed={seed}", *limit, *options)
    try:
        assert plant.stdout is not None
        first = plant.stdout.readline()
        if not first:
            raise SystemExit(plant.communicate()[1].strip())
        kind = {"blind": ["--blind"], "deaf": ["--deaf"], "delayed": []}[scenario.controller]
        control = _start("control.py", f"--policy={policy}", f"--port={json.loads(first)['port']}", *kind, *options)
        try:
            statistics, errors = control.communicate()
            if control.returncode:
                raise SystemExit(errors.strip())
            lines, errors = plant.communicate(timeout=60)
            if plant.returncode:
                raise SystemExit(errors.strip())
        finally:
            control.kill()
    finally:
        plant.kill()
    return [json.loads(line) for line in lines.splitlines()], json.loads(statistics)


def _start(program: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(HERE / program), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def describe(policy: str) -> Row:
    """Return what was run, and with which versions, for the rows."""
    from delayrl.run.provenance import versions

    about: Row = {"agent": policy if policy == "predictor" else "bundle"}
    if (Path(policy) / "checkpoints").is_dir():
        run = json.loads((Path(policy) / "config.json").read_text())
        about = {name: run[name] for name in ("agent", "env", "delay", "preset", "seed", "schedule", "versions")}
    return {"policy": about, "versions": versions()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="predictor", help="a run folder, a bundle, or: predictor (default)")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of start states and network (default: 0)")
    parser.add_argument("--real-time", action="store_true", help="also run in real time: 40 s for each full episode")
    parser.add_argument("--rows", type=Path, default=Path("udp.jsonl"), help="(default: udp.jsonl)")
    parser.add_argument("--picture", type=Path, default=Path("udp.png"), help="(default: udp.png)")
    given = parser.parse_args()
    try:
        import mujoco  # noqa: F401  # the simulator, a process of its own, needs it

        import delayrl.run.provenance  # noqa: F401
    except ModuleNotFoundError as error:
        raise SystemExit(needs_extra(error) or error) from error
    if given.policy == "predictor":
        print("no --policy: running the predictor, which needs no training.\n" + __doc__.splitlines()[-1] + "\n")

    lines: list[Row] = [describe(given.policy) | {"episodes": given.episodes, "seed": given.seed}]
    print(f"{'observations':<52}{'policy':<9}{'mean':>7}{'worst':>7}   age")
    for scenario in SCENARIOS + (REAL_TIME if given.real_time else []):
        episodes, statistics = play(scenario, given.policy, given.episodes, given.seed)
        about = {"scenario": scenario.name, "controller": scenario.controller}
        lines += [about | episode for episode in episodes]
        lines.append(about | {"link": asdict(scenario.link), "real_time": scenario.real_time, "statistics": statistics})
        returns = [episode["return"] for episode in episodes]
        age = "" if statistics["age_mean"] is None else f"{statistics['age_mean']:.1f} ± {statistics['age_std']:.1f}"
        print(
            f"{scenario.name:<52}{about['controller']:<9}{np.mean(returns):7.0f}{np.min(returns):7.0f}   {age}",
            flush=True,
        )
    given.rows.write_text("".join(json.dumps(line) + "\n" for line in lines))
    from picture import draw

    draw(lines, given.picture)
    print(f"\nrows: {given.rows}, picture: {given.picture}")


if __name__ == "__main__":
    main()
