"""One side's return against wall-clock: `python timed.py any-age HalfCheetah-v5 --delay 25 --minutes 20 --out DIR`.

Sides are our agents by name; `sb3` and `sbx`, those libraries' SAC with their defaults on `AugmentedObservation`; and
`released`, VDPO's code with its own sizes and evaluation (`--code PATH`). Each runs in an environment that has it; all
but `released` need delayrl there, whose wrappers import without JAX. The clock runs from before the imports,
compiling included (ours keeps no compiled programs), and stands still while a policy is evaluated.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from peer import EVALUATION, play, reset_seed, versions

EPISODES = 10
PACKAGES = ("delayrl", "gymnasium", "jax", "mujoco", "numpy", "sbx-rl", "stable-baselines3", "torch")
NEVER = 10**9


class Clock:
    """Seconds of training."""

    def __init__(self) -> None:
        self._began, self._pauses = time.perf_counter(), 0.0

    @property
    def seconds(self) -> float:
        """Since the start, without pauses."""
        return time.perf_counter() - self._began - self._pauses

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stand still."""
        began = time.perf_counter()
        yield
        self._pauses += time.perf_counter() - began


Record = Callable[[int, float | None], bool]
"""Note the mean return of an evaluation after so many steps, None where there was none; return if the time is over."""


def main() -> None:
    """Train for the given time, and write one file of rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("side", help="an agent of delayrl, sb3, sbx, or released")
    parser.add_argument("env")
    parser.add_argument("--delay", type=int, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--evaluate-every", type=int, default=5_000)
    parser.add_argument("--preset", default="matched", help="of our agents (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=100_000, help="after which our agents end (default: %(default)s)")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="options of our agents")
    parser.add_argument("--code", help="a checkout of VDPO's released code")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    own = [] if given.side in SIDES else [given.preset, *given.set]
    words = "-".join([given.side, *own, given.env, f"delay{given.delay}", f"seed{given.seed}"])
    out = given.out / f"{words}.jsonl"
    if out.exists():
        print(f"{out} is there already")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    config = {name: value for name, value in vars(given).items() if name not in ("out", "code")}
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    used = versions(PACKAGES) | {"commit": commit or None}
    lines: list[dict[str, Any]] = [{"config": config, "versions": used}]
    clock = Clock()

    def record(step: int, value: float | None) -> bool:
        lines.append({"step": step, "seconds": round(clock.seconds, 1), "return": value})
        shown = "" if value is None else f", {value:,.0f}"
        print(f"{words}: {step:,} steps, {clock.seconds:,.0f} s{shown}", flush=True)
        return clock.seconds > 60 * given.minutes

    SIDES.get(given.side, ours)(given, clock, record)
    draft = out.with_suffix(".draft")
    draft.write_text("".join(json.dumps(line) + "\n" for line in lines))
    draft.rename(out)


def ours(given: argparse.Namespace, clock: Clock, record: Record) -> None:
    """Train one of our agents."""
    os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "0"
    import jax

    import delayrl
    from delayrl.cli.console import name_and_value
    from delayrl.training.recorder import Recorder

    evaluate = Recorder.evaluate

    def timed(self: Recorder, *values: Any) -> str:
        jax.block_until_ready(jax.live_arrays())  # updates that were called and not waited for
        with clock.paused():
            return evaluate(self, *values)

    Recorder.evaluate = timed  # type: ignore[method-assign]

    def after(step: int, runs: list[delayrl.Run]) -> bool:
        rows = [row for row in runs[0].rows() if row["step"] == step and row["policy"] == "agent"]
        return record(step, float(np.mean([row["return"] for row in rows])))

    options = dict(map(name_and_value, given.set))
    with tempfile.TemporaryDirectory() as folder:
        delayrl.train(
            given.side,
            given.env,
            given.delay,
            preset=given.preset,
            seeds=[given.seed],
            out=Path(folder) / "run",
            progress=False,
            callback=after,
            **{"steps": given.steps, "evaluate_every": given.evaluate_every, "evaluation_episodes": EPISODES} | options,
        )


def library(given: argparse.Namespace, clock: Clock, record: Record) -> None:
    """Train the SAC of Stable-Baselines3 or SBX on the newest observation and the actions since, with its defaults."""
    import gymnasium

    from delayrl.wrappers import AugmentedObservation, Delayed

    def task() -> Any:
        return AugmentedObservation(Delayed(gymnasium.make(given.env), given.delay))

    if given.side == "sb3":
        from stable_baselines3 import SAC

        model = SAC("MlpPolicy", task(), seed=given.seed, device="cpu")
    else:
        from sbx import SAC

        model = SAC("MlpPolicy", task(), seed=given.seed)
    envs = [task() for _ in range(EPISODES)]
    for step in range(given.evaluate_every, NEVER, given.evaluate_every):
        model.learn(given.evaluate_every, reset_num_timesteps=False)
        with clock.paused():
            value = np.mean(play(model, envs, [reset_seed(given.seed, EVALUATION, step, i) for i in range(EPISODES)]))
        if record(step, float(value)):
            return


def released(given: argparse.Namespace, clock: Clock, record: Record) -> None:
    """Run the released trainer, unchanged, with its own sizes. It evaluates on one start state, that of its seed."""
    sys.path.insert(0, given.code)
    import torch
    import VDPO as code  # noqa: N811

    config = vars(code.parser.parse_args([])) | {
        "env": given.env,
        "delay": given.delay,
        "seed": given.seed,
        "device": torch.device("cpu"),
        "total_timesteps": NEVER,
        "eval_freq": given.evaluate_every,
        "eval_num": EPISODES,
    }
    code.config = config
    with tempfile.TemporaryDirectory() as folder:
        trainer = code.Trainer(config, folder)
        play, log = trainer.rollout_trans_decision, trainer.logging

        def timed() -> float:
            with clock.paused():
                return float(play())

        def noted() -> None:
            value = trainer.log_dict.get("eval/trans_decision")
            if value is not None or clock.seconds > 60 * given.minutes:
                over = record(trainer.global_step, None if value is None else float(value))
                if over:
                    raise TimeOverError
            log()

        trainer.rollout_trans_decision, trainer.logging = timed, noted
        try:
            trainer.train()
        except TimeOverError:
            return


class TimeOverError(Exception):
    """The given time is over."""


SIDES = {"sb3": library, "sbx": library, "released": released}
"""The sides that are not ours."""


if __name__ == "__main__":
    main()
