"""Another library's SAC without delay, evaluated as ours is: `python peer.py sb3 HalfCheetah-v5 --seed 0 --out DIR`.

It runs in an environment with that library, without delayrl:

    pip install torch==2.13.0 stable-baselines3 sbx-rl 'gymnasium[mujoco]' mujoco==3.17.0

Settings are the library's defaults (256 x 256, batch 256, 3e-4, one update a step), with 5,000 random steps. Every
5,000 steps it plays ten deterministic episodes, from the start states that `delayrl train` draws for the same seed.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

COMMON = ("gymnasium", "mujoco", "numpy")
PACKAGES = {"sb3": (*COMMON, "stable-baselines3", "torch"), "sbx": (*COMMON, "sbx-rl", "jax")}
EVALUATION = 1
"""The stream of start states that evaluation uses (delayrl's `reset_seed`)."""


def main() -> None:
    """Train, and write one file of rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("library", choices=["sb3", "sbx"])
    parser.add_argument("env")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--evaluate-every", type=int, default=5_000)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    out = given.out / f"{given.library}-{given.env}-seed{given.seed}.jsonl"
    if out.exists():
        print(f"{out} is there already")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    if given.library == "sb3":
        import torch
        from stable_baselines3 import SAC

        torch.set_num_threads(1)
        options: dict[str, Any] = {"device": "cpu"}
    else:
        from sbx import SAC

        options = {}
    model = SAC(
        "MlpPolicy",
        gymnasium.make(given.env),
        learning_starts=5_000,
        buffer_size=given.steps,
        seed=given.seed,
        **options,
    )
    settings = {"library": given.library, "env": given.env, "seed": given.seed, "steps": given.steps}
    lines: list[dict[str, Any]] = [{"config": settings, "versions": versions(PACKAGES[given.library])}]
    envs = [gymnasium.make(given.env) for _ in range(given.episodes)]
    began, playing = time.perf_counter(), 0.0
    for step in range(given.evaluate_every, given.steps + 1, given.evaluate_every):
        model.learn(given.evaluate_every, reset_num_timesteps=False)
        paused = time.perf_counter()
        seeds = [reset_seed(given.seed, EVALUATION, step, episode) for episode in range(given.episodes)]
        returns = play(model, envs, seeds)
        playing += time.perf_counter() - paused
        for episode, (seed, value) in enumerate(zip(seeds, returns, strict=True)):
            lines.append({"step": step, "episode": episode, "reset_seed": seed, "return": value})
        speed = step / (time.perf_counter() - began - playing)
        print(
            f"{given.library} {given.env} seed {given.seed}: {step:,} steps, {np.mean(returns):.0f}, {speed:.0f}/s",
            flush=True,
        )
    lines[0]["steps_per_second"] = round(speed, 2)
    draft = out.with_suffix(".draft")
    draft.write_text("".join(json.dumps(line) + "\n" for line in lines))
    draft.rename(out)


def play(model: Any, envs: list[Any], seeds: list[int]) -> list[float]:
    """Undiscounted returns of deterministic episodes, all stepped together."""
    seen = np.stack([env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=True)])
    returns, running = np.zeros(len(envs)), np.ones(len(envs), bool)
    while running.any():
        actions, _ = model.predict(seen, deterministic=True)
        for i in np.flatnonzero(running):
            seen[i], reward, terminated, truncated, _ = envs[i].step(actions[i])
            returns[i] += float(reward)
            running[i] = not (terminated or truncated)
    return [float(value) for value in returns]


def reset_seed(seed: int, *stream: int) -> int:
    """As `delayrl` makes it."""
    return int(np.random.SeedSequence([seed, *stream]).generate_state(1)[0] >> 1)


def versions(packages: Sequence[str]) -> dict[str, Any]:
    """Return the versions of packages, None where one is missing, and the hardware."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    found: dict[str, Any] = {"python": platform.python_version(), "cores": cores}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found | {"machine": f"{platform.system()} {platform.machine()}"}


if __name__ == "__main__":
    main()
