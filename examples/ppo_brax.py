"""PPO of brax under a delay: without knowledge of it, with the augmented state, and with a value of the true state.

    pip install -e '.[brax]' matplotlib
    python examples/ppo_brax.py --task inverted_pendulum --delay 4 --seeds 0 1 2 --out ppo

`blind` sees the late observation alone, `augmented` also the actions since, and `privileged` gives its value function
the true state. Writes a row for each evaluation to OUT/rows.jsonl, and the curves of all rows there to OUT/curves.png.
"""

import argparse
import json
import time
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from delayrl.errors import needs_extra

try:
    import jax
    import jax.numpy as jnp
    import matplotlib
    from brax import envs
    from brax.training.agents.ppo import networks, train

    from delayrl.batched.brax import wrap
    from delayrl.run.provenance import versions

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
except ModuleNotFoundError as error:
    raise SystemExit(needs_extra(error) or error) from error

VIEWS = {
    "blind": {"augment": False, "value": "state"},
    "augmented": {"augment": True, "value": "state"},
    "privileged": {"augment": True, "value": "privileged_state"},
}
OURS = ("backend", "hidden")  # options that are not PPO's: physics, and the widths of the policy's and value's layers
PPO = {"num_timesteps": 1_000_000, "discounting": 0.97, "learning_rate": 3e-4, "normalize_observations": True}
TASKS: dict[str, dict[str, Any]] = {
    "inverted_pendulum": {  # of brax's notebook, with fewer robots and smaller batches
        **PPO,
        "backend": "positional",  # "spring" is faster, but PPO does not learn this task there, delayed or not
        "hidden": ((32,) * 4, (256,) * 5),
        "num_envs": 512,
        "unroll_length": 5,
        "batch_size": 256,
        "num_minibatches": 32,
        "num_updates_per_batch": 4,
        "entropy_cost": 1e-2,
        "reward_scaling": 10,
    },
    "halfcheetah": {  # few robots and many updates: a million steps are enough
        **PPO,
        "backend": "spring",
        "hidden": ((128, 128), (128, 128)),
        "num_envs": 64,
        "unroll_length": 16,
        "batch_size": 8,
        "num_minibatches": 16,
        "num_updates_per_batch": 8,
        "entropy_cost": 1e-3,
        "reward_scaling": 1,
    },
}

if not hasattr(jax, "device_put_replicated"):  # brax 0.14 calls what JAX 0.10 has removed

    def device_put_replicated(tree: Any, devices: list[Any]) -> Any:
        return jax.tree.map(lambda array: jnp.stack([array] * len(devices)), tree)

    jax.device_put_replicated = device_put_replicated


def learn(given: argparse.Namespace, view: str, seed: int) -> list[dict[str, Any]]:
    """Train one policy. Returns a row for each evaluation, the mean of 128 episodes."""
    rows: list[dict[str, Any]] = []
    began = time.perf_counter()
    options = TASKS[given.task] | {"seed": seed, "episode_length": given.episode_length}
    options |= {"num_timesteps": given.steps} if given.steps else {}
    what = {"task": given.task, "delay": given.delay, "view": view, "seed": seed}
    what |= {"options": options, "versions": versions() | {"brax": version("brax")}}

    def evaluated(step: int, metrics: dict[str, Any]) -> None:
        row = {**what, "step": int(step), "return": float(metrics["eval/episode_reward"])}
        rows.append({**row, "seconds": round(time.perf_counter() - began, 1)})
        print(f"{given.task} {view}, seed {seed}: {step:,} steps, return {row['return']:.0f}", flush=True)

    train.train(
        envs.get_environment(given.task, backend=options["backend"]),
        num_evals=given.evaluations,
        network_factory=partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=options["hidden"][0],
            value_hidden_layer_sizes=options["hidden"][1],
            value_obs_key=VIEWS[view]["value"],
        ),
        wrap_env_fn=partial(wrap, delay=given.delay, augment=VIEWS[view]["augment"]),
        deterministic_eval=True,
        progress_fn=evaluated,
        **{name: value for name, value in options.items() if name not in OURS},
    )
    jax.clear_caches()  # or the programs of ten runs exhaust the process's memory maps
    return rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw each seed's returns thinly, and the mean of a view where all its seeds were evaluated; grey: no delay."""
    tasks = sorted({(row["task"], row["delay"]) for row in rows if row["delay"] != "0"}) or [(rows[0]["task"], "0")]
    figure, axes = plt.subplots(1, len(tasks), figsize=(5 * len(tasks), 4), squeeze=False)
    for axis, (task, delay) in zip(axes[0], tasks, strict=True):
        axis.set(title=f"{task}, delay {delay}", xlabel="million steps", ylabel="return")
        lines = [(delay, view, f"C{number}", view) for number, view in enumerate(VIEWS)]
        for late, view, colour, label in [*lines, ("0", "augmented", "grey", "no delay")]:
            curves: dict[int, dict[int, float]] = {}
            for row in rows:
                if (row["task"], row["delay"], row["view"]) == (task, late, view):
                    curves.setdefault(row["seed"], {})[row["step"] / 1e6] = row["return"]
            for curve in curves.values():
                axis.plot(curve.keys(), curve.values(), color=colour, alpha=0.3, linewidth=0.8)
            if curves:
                steps = sorted(set.intersection(*map(set, curves.values())))
                means = [np.mean([curve[step] for curve in curves.values()]) for step in steps]
                axis.plot(steps, means, color=colour, label=f"{label} ({len(curves)} seeds)")
        axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=2, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=TASKS, default="inverted_pendulum")
    parser.add_argument("--delay", default="4", help="in the text form of delayrl.delays (default: %(default)s)")
    parser.add_argument("--views", nargs="+", choices=VIEWS, default=list(VIEWS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, help="environment steps of a run (default: the task's)")
    parser.add_argument("--episode-length", type=int, default=1000)
    parser.add_argument("--evaluations", type=int, default=11)
    parser.add_argument("--out", type=Path, default=Path("ppo"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / "rows.jsonl"
    for seed in given.seeds:
        for view in given.views:
            rows = learn(given, view, seed)
            with file.open("a", encoding="utf-8") as lines:
                lines.writelines(json.dumps(row) + "\n" for row in rows)
            draw([json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()], given.out / "curves.png")


if __name__ == "__main__":
    main()
