"""One side of a comparison, as a process: `python worker.py SIDE`, with SIDE a JSON object; talks as gate.py says.

Each function below starts one side's own training loop on the gated task and comes back only by `Stop`. Runs in the
environment of the side that it measures: imports only what that side needs.
"""

import json
import os
import random
import runpy
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from gate import Gate, Stop, pin, register

CAPACITY = 1_000_000
"""Rows of everybody's replay: what the papers train with."""
NEVER = 10**9


def ours(side: dict[str, Any], gate: Gate) -> None:
    """`delayrl.train`, all seeds in lockstep."""
    from delayrl import train

    env = register(gate, side["env"])
    train(
        side["agent"],
        env,
        side["delay"],
        preset=side["preset"],
        seeds=side["seeds"],
        out=Path("runs"),
        device=side["device"],
        progress=False,
        steps=NEVER,
        random_steps=random_steps(side),
        replay_capacity=side.get("capacity", CAPACITY),
        evaluate_every=NEVER,
        evaluation_episodes=1,
        **side["options"],
    )


def vdpo(side: dict[str, Any], gate: Gate) -> None:
    """The released trainer, unchanged: it reads the global `config` of its module, and logs as it always does."""
    sys.path.insert(0, side["path"])
    import torch
    import VDPO as released  # noqa: N811

    config = vars(released.parser.parse_args([])) | {
        "env": register(gate, side["env"]),
        "device": torch.device("cuda" if side["device"] == "gpu" else "cpu"),
        "total_timesteps": NEVER,
        "learn_start": random_steps(side),
        "buffer_size": side.get("capacity", CAPACITY),
        "eval_freq": NEVER,
        "delay": side["delay"],
        **side["options"],
    }
    released.config = config
    trainer = released.Trainer(config, "logs")
    for name in ("train_sac", "train_belief", "train_kl"):
        timed(trainer, name, gate)
    trainer.train()


def sb3(side: dict[str, Any], gate: Gate) -> None:
    """Stable-Baselines3's SAC with its defaults: 256 × 256, batch 256, one update a step."""
    from stable_baselines3 import SAC

    env = register(gate, side["env"])
    SAC(
        "MlpPolicy",
        env,
        learning_starts=random_steps(side),
        buffer_size=side.get("capacity", CAPACITY),
        device="cuda" if side["device"] == "gpu" else "cpu",
        **side["options"],
    ).learn(NEVER)


def sbx(side: dict[str, Any], gate: Gate) -> None:
    """SBX's SAC with its defaults: 256 × 256, batch 256, one update a step."""
    import jax
    from sbx import SAC

    env = register(gate, side["env"])
    with jax.default_device(jax.devices(side["device"])[0]):  # it has no option for that
        SAC(
            "MlpPolicy",
            env,
            learning_starts=random_steps(side),
            buffer_size=side.get("capacity", CAPACITY),
            **side["options"],
        ).learn(NEVER)


def cleanrl(side: dict[str, Any], gate: Gate) -> None:
    """CleanRL's script, run as a script. Under Gymnasium 1 it fails at a time limit, so its task has none."""
    sys.path.insert(0, side["path"])
    env = register(gate, side["env"], endless=True)
    words = {
        "env-id": env,
        "learning-starts": random_steps(side),
        "buffer-size": side.get("capacity", CAPACITY),
        "total-timesteps": NEVER,
        **side["options"],
    }
    sys.argv = ["sac_continuous_action.py", *(f"--{name}={value}" for name, value in words.items())]
    sys.argv += [] if side["device"] == "gpu" else ["--no-cuda"]
    runpy.run_path(str(Path(side["path"]) / "cleanrl" / "sac_continuous_action.py"), run_name="__main__")


def dummy(side: dict[str, Any], gate: Gate) -> None:
    """No learning at all: what the harness itself costs, and what tests it."""
    import gymnasium as gym

    env = gym.make(register(gate, side["env"]))
    env.reset(seed=0)
    while True:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


SIDES: dict[str, Callable[[dict[str, Any], Gate], None]] = {
    side.__name__: side for side in (ours, vdpo, sb3, sbx, cleanrl, dummy)
}
PACKAGES = ("delayrl", "torch", "jax", "jaxlib", "stable_baselines3", "sbx_rl", "gymnasium", "mujoco", "numpy")


def random_steps(side: dict[str, Any]) -> int:
    """Steps without learning: enough that everyone's replay has whole batches of different rows."""
    return 300 if side["delay"] < 50 else 500


def timed(owner: Any, name: str, gate: Gate) -> None:
    """Have the calls of a method timed as a part of the slice."""
    method = getattr(owner, name)

    def wrapped(*args: Any) -> Any:
        with gate.part(name):
            return method(*args)

    setattr(owner, name, wrapped)


def settle() -> None:
    """Wait until the device has nothing left to do."""
    if jax := sys.modules.get("jax"):
        jax.block_until_ready(jax.live_arrays())
    if (torch := sys.modules.get("torch")) and torch.cuda.is_available():
        torch.cuda.synchronize()


def hello() -> dict[str, Any]:
    """Versions of what is measured."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    report: dict[str, Any] = {"packages": found}
    if "delayrl" in sys.modules:
        from delayrl.run.provenance import versions

        report["versions"] = versions()
    return report


def main() -> None:
    """Start the side; its prints go to stderr, the reports alone to stdout."""
    pin()
    side = json.loads(sys.argv[1])
    reports = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    random.seed(0)
    gate = Gate(sys.stdin, reports, (random_steps(side) + side["warmup"]) * side["seeds"], settle, hello)
    with tempfile.TemporaryDirectory() as scratch:  # runs, logs
        os.chdir(scratch)
        try:
            SIDES[side["kind"]](side, gate)
        except Stop:
            os.chdir("/")


if __name__ == "__main__":
    main()
