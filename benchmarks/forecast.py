"""What a perfect forecast would bring: `python benchmarks/forecast.py RUN...` for runs of any-age with a forecast.

Plays each policy on the same start states: late, with its forecast; late, with the true state in place of the forecast,
which no plant can give; and without a delay. The first two also with actions sampled as in training. Writes
benchmarks/results/forecast.jsonl.
"""

import argparse
import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jsonl
import numpy as np
from jaxtyping import Array

import delayrl
from delayrl.core import networks
from delayrl.core.forecast import forecast, forecasting
from delayrl.core.networks import Params
from delayrl.core.views import network_input, seen_now
from delayrl.play.policy import Policy
from delayrl.report.markup import markdown_table
from delayrl.run.provenance import versions

OUT = Path(__file__).parent / "results" / "forecast.jsonl"
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


WAYS: dict[str, tuple[Outputs, bool, bool]] = {
    "forecast": (with_forecast, True, False),
    "true state": (with_truth, True, False),
    "no delay": (with_forecast, False, False),
    "forecast, sampled": (with_forecast, True, True),
    "true state, sampled": (with_truth, True, True),
}
"""What the policy reads, whether it is late, and whether its actions are sampled as in training."""


def play(policy: Policy, env_name: str, delay: int, outputs: Outputs, *, sampled: bool) -> tuple[list[float], float]:
    """Return the returns of episodes, and the share of the states' variance that the forecast misses."""
    spec, params, learner = policy.spec, policy.state.actor, policy.agent.learner

    @jax.jit  # one call for all episodes, so that they can be stepped together
    def act(x: Array, truth: Array, key: Array) -> Array:
        network = functools.partial(outputs, truth=truth)
        chosen = replace(learner, actor_network=network).policy(params, x)
        return networks.sample(chosen, key)[0] if sampled else networks.mode(chosen)

    predict = jax.jit(lambda x: forecast(params, x))
    envs = [delayrl.make(env_name, delay, rescale=True, history=spec.delay) for _ in range(EPISODES)]
    late, infos = map(list, zip(*[env.reset(seed=FIRST_SEED + i) for i, env in enumerate(envs)], strict=True))
    returns, running = np.zeros(EPISODES), np.ones(EPISODES, bool)
    errors, states, key = [], [], jax.random.key(0)
    while running.any():
        key, now = jax.random.split(key)
        seen = [seen_now(obs, info, spec.delay, privileged=True) for obs, info in zip(late, infos, strict=True)]
        x = np.stack([np.asarray(network_input(one._replace(truth=None), "augmented")) for one in seen])
        truth = np.stack([one.truth for one in seen])
        actions = np.asarray(act(x, truth, now))
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="+", help="a run folder")
    lines: list[dict[str, Any]] = [{"versions": versions(), "episodes": EPISODES}]
    for path in parser.parse_args().run:
        config, policy = delayrl.Run(path).config, delayrl.load(path)
        own = policy.spec.delay
        for way, (outputs, late, sampled) in WAYS.items():
            returns, missed = play(policy, config["env"], own * late, outputs, sampled=sampled)
            run = {"env": config["env"], "delay": own, "seed": config["seed"], "steps": config["schedule"]["steps"]}
            lines.append(run | {"way": way, "returns": returns, "missed": round(missed, 4)})
            print(f"seed {config['seed']}, {way}: {np.mean(returns):,.0f}, missed {missed:.3f}", flush=True)
    jsonl.write(OUT, lines)


def section() -> str:
    """Return a Markdown table of the ways by seed, with what made it."""
    head, *lines = jsonl.read(OUT)
    returns = {(line["seed"], line["way"]): line["returns"] for line in lines}
    seeds = sorted({seed for seed, _ in returns})
    titles = ["seed", "late, with its forecast", "late, with the true state instead", "no delay"]
    titles += ["sampled as in training, with its forecast", "sampled, with the true state instead"]
    values = {seed: [returns[seed, way] for way in WAYS] for seed in seeds}
    body = [[str(seed), *(f"{np.mean(x):,.0f} ({min(x):,.0f})" for x in own)] for seed, own in values.items()]
    body.append(["mean", *(f"{np.mean(ways):,.0f}" for ways in zip(*values.values(), strict=True))])
    what = (
        "The same policies with the true state in place of the forecast, which no plant can give, and without a delay: "
        "mean returns, and in brackets the lowest of the episodes."
    )
    about = f"{lines[0]['env']}, Δ = {lines[0]['delay']}, policies of {lines[0]['steps']:,} steps, {head['episodes']}"
    about += f" episodes each. Rows: `benchmarks/results/{OUT.name}`."
    return f"{what}\n\n{markdown_table(titles, body)}\n\n{about}"


if __name__ == "__main__":
    main()
