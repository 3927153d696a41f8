"""Run one side of a comparison as a process: `python worker.py SIDE`, where SIDE is a JSON object.

The process answers requests as gate.py describes. Each function below starts one side's own training loop on the gated
task and only ends by `Stop`. The script runs in the environment of its side and imports only what that side needs.
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
"""Rows of the replay on every side, as in the papers."""
NEVER = 10**9


def ours(side: dict[str, Any], gate: Gate) -> None:
    """Run `delayrl.train` with all seeds in lockstep."""
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
    """Run the released trainer, unchanged. It reads the global `config` of its module and logs as usual."""
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
        if side["device"] == "cpu":  # on a GPU it would wait at each call, which ours does not
            timed(trainer, name, gate)
    trainer.train()


def sb3(side: dict[str, Any], gate: Gate) -> None:
    """Run Stable-Baselines3's SAC with its defaults: 256 × 256, batch 256, one update per step."""
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
    """Run SBX's SAC with its defaults: 256 × 256, batch 256, one update per step."""
    import jax
    from sbx import SAC

    env = register(gate, side["env"])
    with jax.default_device(jax.devices(side["device"])[0]):  # SBX has no option for the device
        SAC(
            "MlpPolicy",
            env,
            learning_starts=random_steps(side),
            buffer_size=side.get("capacity", CAPACITY),
            **side["options"],
        ).learn(NEVER)


def cleanrl(side: dict[str, Any], gate: Gate) -> None:
    """Run CleanRL's script. It fails at a time limit under Gymnasium 1, so its task has none."""
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
    """Step without learning, to test the harness and measure its own cost."""
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
    """Return the steps before learning: enough for every side's replay to fill batches with different rows."""
    return 300 if side["delay"] < 50 else 500


def timed(owner: Any, name: str, gate: Gate) -> None:
    """Time the calls of a method as a part of the slice."""
    method = getattr(owner, name)

    def wrapped(*args: Any) -> Any:
        with gate.part(name):
            return method(*args)

    setattr(owner, name, wrapped)


def settle() -> None:
    """Wait until the device is idle."""
    if jax := sys.modules.get("jax"):
        jax.block_until_ready(jax.live_arrays())
    if (torch := sys.modules.get("torch")) and torch.cuda.is_available():
        torch.cuda.synchronize()


def hello() -> dict[str, Any]:
    """Return the versions of the installed packages, and of delayrl on our side."""
    packages = {}
    for package in PACKAGES:
        try:
            packages[package] = version(package)
        except PackageNotFoundError:
            continue
    report: dict[str, Any] = {"packages": packages}
    if "delayrl" in sys.modules:
        from delayrl.run.provenance import versions

        report["versions"] = versions()
    return report


def main() -> None:
    """Start the side. Its prints go to stderr; only reports go to stdout."""
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
