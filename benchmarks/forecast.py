"""What a perfect forecast would bring: `python benchmarks/forecast.py RUN...` for runs of any-age with a forecast.

Plays each policy three ways, on the same start states: late, with its forecast; late, with the true state in place of
the forecast, which no plant can give; and without a delay. Writes benchmarks/results/forecast.jsonl.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import delayrl
from delayrl.core import networks
from delayrl.core.forecast import forecast, forecasting
from delayrl.core.networks import Params
from delayrl.core.views import network_input, seen_now
from delayrl.run.provenance import versions

OUT = Path(__file__).parent / "results" / "forecast.jsonl"
WAYS = ("forecast", "true state", "no delay")
EPISODES, FIRST_SEED = 20, 2_000_000_000  # start states that no run has seen
Outputs = Callable[[Params, Array, Array], Array]
"""The policy's outputs, from its parameters, x_t and s_t."""


def with_forecast(params: Params, x: Array, truth: Array) -> Array:
    """Return the outputs as they are."""
    del truth
    return forecasting(params, x)


def with_truth(params: Params, x: Array, truth: Array) -> Array:
    """Return the outputs for a forecast that is right."""
    del x
    return networks.mlp(params["policy"], truth)


def play(policy: Any, env_name: str, delay: int, outputs: Outputs) -> tuple[list[float], float]:
    """Return the returns of deterministic episodes, and the share of the states' variance that the forecast misses."""
    spec, params = policy.spec, policy.state.actor
    # one for all episodes, so that they can be stepped together
    act = jax.jit(lambda x, truth: jnp.tanh(jnp.split(outputs(params, x, truth), 2, -1)[0]))
    predict = jax.jit(lambda x: forecast(params, x))
    envs = [delayrl.make(env_name, delay, rescale=True, history=spec.delay) for _ in range(EPISODES)]
    late, infos = map(list, zip(*[env.reset(seed=FIRST_SEED + i) for i, env in enumerate(envs)], strict=True))
    returns, running = np.zeros(EPISODES), np.ones(EPISODES, bool)
    errors, states = [], []
    while running.any():
        seen = [seen_now(obs, info, spec.delay, privileged=True) for obs, info in zip(late, infos, strict=True)]
        x = np.stack([np.asarray(network_input(one._replace(truth=None), "augmented")) for one in seen])
        truth = np.stack([one.truth for one in seen])
        actions = np.asarray(act(x, truth))
        errors.append((np.asarray(predict(x)) - truth)[running])
        states.append(truth[running])
        for i in np.flatnonzero(running):
            late[i], reward, terminated, truncated, infos[i] = envs[i].step(actions[i])
            returns[i] += float(reward)
            running[i] = not (terminated or truncated)
    missed = (np.concatenate(errors) ** 2).mean(0) / np.concatenate(states).var(0)
    return returns.tolist(), float(missed.mean())


def main() -> None:
    """Play every run, and write a line for each way."""
    lines: list[dict[str, Any]] = [{"versions": versions(), "episodes": EPISODES}]
    for path in map(Path, sys.argv[1:]):
        config, policy = delayrl.Run(path).config, delayrl.load(path)
        own = policy.spec.delay
        for way, delay, outputs in zip(WAYS, (own, own, 0), (with_forecast, with_truth, with_forecast), strict=True):
            returns, missed = play(policy, config["env"], delay, outputs)
            run = {"env": config["env"], "delay": own, "seed": config["seed"], "steps": config["schedule"]["steps"]}
            lines.append(run | {"way": way, "returns": returns, "missed": round(missed, 4)})
            print(f"seed {config['seed']}, {way}: {np.mean(returns):,.0f}, missed {missed:.3f}", flush=True)
    OUT.write_text("".join(json.dumps(line) + "\n" for line in lines))


def section() -> str:
    """Return a Markdown table of the three ways by seed, with what made it."""
    head, *lines = [json.loads(line) for line in OUT.read_text().splitlines()]
    means = {(line["seed"], line["way"]): float(np.mean(line["returns"])) for line in lines}
    seeds = sorted({seed for seed, _ in means})
    titles = ["seed", "late, with its forecast", "late, with the true state instead", "no delay"]
    table = ["| " + " | ".join(titles) + " |", "|" + " --- |" * len(titles)]
    for seed in seeds:
        table.append(f"| {seed} | " + " | ".join(f"{means[seed, way]:,.0f}" for way in WAYS) + " |")
    mean = [np.mean([means[seed, way] for seed in seeds]) for way in WAYS]
    table.append("| mean | " + " | ".join(f"{value:,.0f}" for value in mean) + " |")
    what = (
        "The same policies with the true state in place of the forecast, which no plant can give, and without a delay:"
    )
    about = f"{lines[0]['env']}, Δ = {lines[0]['delay']}, policies of {lines[0]['steps']:,} steps, {head['episodes']}"
    return f"{what}\n\n" + "\n".join(table) + f"\n\n{about} episodes each. Rows: `benchmarks/results/{OUT.name}`."


if __name__ == "__main__":
    main()
