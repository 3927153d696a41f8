"""Compare three answers to an untrained age on one run: `python benchmarks/overruns.py RUN OUT.jsonl`.

`hold` and `clip` are the controller's. `last` is what a buffer of fixed length does: it drops the oldest actions.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonl
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "udp_demo"))

from link import Link, Travelling
from policies import RunPolicy

from delayrl.deploy import Controller, ControlPolicy
from delayrl.run.provenance import versions

LINKS = [Link(4, 6), Link(4, 7), Link(3, 8), Link(4, 8), Link(3, 5, loss=0.4), Link(6, 6)]
EPISODES = 10


class Last:
    """A policy that is shown the newest Δ actions, however old the observation is."""

    def __init__(self, policy: ControlPolicy) -> None:
        self._policy = policy
        self.obs_size, self.action_size, self.dt = policy.obs_size, policy.action_size, policy.dt
        self.low, self.high, self.max_age = policy.low, policy.high, 64

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        """Act on the observation and the newest of the actions since."""
        longest = self._policy.max_age
        if age <= longest:
            return self._policy(obs, actions[:longest], age)
        return self._policy(obs, actions[age - longest : age], longest)


def returns(env: gym.Env[Any, Any], controller: Controller, link: Link) -> list[float]:
    """Return the returns of `EPISODES` episodes, each with its own start state and random link."""
    totals = []
    for episode in range(EPISODES):
        obs, _ = env.reset(seed=1_000_000 + episode)
        controller.reset()
        travelling, made, total, done = Travelling(link, [0, episode]), [], 0.0, False
        while not done:
            made.append(obs)
            travelling.send(len(made) - 1)
            for k in travelling.due(len(made) - 1):
                controller.observe(made[k], k)
            obs, reward, terminated, truncated, _ = env.step(controller.act())
            total, done = total + float(reward), terminated or truncated
        totals.append(total)
    return totals


def main() -> None:
    """Play every link with every answer and write the returns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument("out", type=Path, help="a file for the returns, one line for each link and answer")
    given = parser.parse_args()
    run, out = given.run, given.out
    config = json.loads((run / "config.json").read_text())
    policy = RunPolicy(run)
    env = gym.make(config["env"])
    kept = ("agent", "env", "delay", "preset", "seed", "schedule")
    lines: list[dict[str, Any]] = [{"policy": {name: config[name] for name in kept}, "versions": versions()}]
    for link in LINKS:
        for name, player, on_overrun in (
            ("clip", policy, "clip"),
            ("hold", policy, "hold"),
            ("last", Last(policy), "raise"),
        ):
            controller = Controller(player, on_overrun=on_overrun)
            lines.append({"link": asdict(link), "answer": name, "returns": returns(env, controller, link)})
            print(link, name, np.mean(lines[-1]["returns"]), flush=True)
    jsonl.write(out, lines)


if __name__ == "__main__":
    main()
