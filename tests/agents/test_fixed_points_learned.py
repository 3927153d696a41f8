"""Agents trained on the noisy chain through the whole library reach the policies that the theory predicts.

Slow: four runs of three seeds. Policies and critics are read off the trained networks and compared, seed by seed, with
the exact solutions of tests/agents/chain.py. Where two methods differ, they do so by at least twice the margin.
"""

from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from chain import (
    DISCOUNT,
    GRID,
    STATES,
    TEMPERATURE,
    Solution,
    adsac_value,
    bpql_value,
    clone,
    reference_value,
    register,
    solve,
)

import delayrl
from delayrl.core import networks

RUNS = ("vdpo-forward", "vdpo-reverse", "ad-sac", "bpql")
SEEDS = 3
PAST = np.array([-1.0, 1.0])
HOME, FIELD = 0, 1  # rows of `Found`: x = (home, -1) is at home for sure, x = (home, 1) in the field for sure
HOME_MARGIN, MEAN_MARGIN, DEVIATION_MARGIN, Q_MARGIN = 0.2, 0.4, 0.2, 0.4
SHORT: dict[str, Any] = {
    "steps": 12_000,
    "random_steps": 1000,
    "replay_capacity": 20_000,
    "evaluate_every": 12_000,
    "evaluation_episodes": 1,
    "hidden": [32, 32],
    "batch_size": 128,
    "discount": DISCOUNT,
    "initial_temperature": TEMPERATURE,
    "temperature_learning_rate": 0.0,  # the theory is for a given temperature
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "target_rate": 0.02,
    "n_steps": 1,
    "actor_every": 1,
    "actor_updates": 1,
}
OWN: dict[str, dict[str, Any]] = {
    "vdpo": {"width": 32, "layers": 1, "dropout": 0.0, "clone_every": 500, "clone_updates": 500},
    "bpql": {"update_every": 1, "updates": 1},
}


class Found(NamedTuple):
    """What a run learned, or should have.

    Attributes:
        action: tanh of the delayed policy's mean at (s, -1) and (s, 1) for each state s, (..., 6).
        deviation: Of the Gaussian before the tanh, (..., 6).
        q: Q(s, a) on the grid of actions, averaged over both critics, (..., 3, len(GRID)).
    """

    action: np.ndarray
    deviation: np.ndarray
    q: np.ndarray


@cache
def predicted(name: str) -> Found:
    value = {"bpql": bpql_value, "ad-sac": adsac_value}.get(name, reference_value)
    solution: Solution = solve(value)
    if name.startswith("vdpo"):
        mean, deviation = clone(solution.current, PAST, name == "vdpo-forward")
    else:
        mean, log_std = (np.asarray(x).reshape(STATES, -1)[:, [0, -1]] for x in solution.late)
        deviation = np.exp(log_std)
    return Found(np.tanh(mean).ravel(), deviation.ravel(), np.asarray(solution.q))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    """What each run learned, with a leading axis for seeds."""
    register()
    found = {}
    for name in RUNS:
        agent, _, direction = name.partition("-") if name.startswith("vdpo") else (name, "", "")
        options = SHORT | OWN.get(agent, {}) | ({"direction": direction} if direction else {})
        out = tmp_path_factory.mktemp("runs") / name
        runs = delayrl.train(
            agent, "delayrl/Chain-v0", 1, preset="small", seeds=SEEDS, out=out, progress=False, **options
        )
        found[name] = Found(*(np.stack(x) for x in zip(*(read(run.path) for run in runs), strict=True)))
    return found


def read(run: Path) -> Found:
    """Return the delayed policy and the critics of a run."""
    policy = delayrl.load(run)
    agent, state = policy.agent, policy.state
    states, actions = jnp.repeat(jnp.eye(STATES), len(PAST), 0), jnp.tile(jnp.asarray(PAST, jnp.float32), STATES)
    if hasattr(agent, "clone"):
        gaussian = agent.policy(state, states, actions[:, None, None])
        mean, log_std = gaussian.mean[:, 0, 0], gaussian.log_std[:, 0, 0]
        critic = state.reference.critic
    else:
        shared = hasattr(agent, "learner")  # AD-SAC's actors share the critics of the auxiliary learner
        learner, critic = (agent.learner, state.auxiliary.critic) if shared else (agent, state.critic)
        x = jnp.concatenate([states, actions[:, None], jnp.ones((len(states), 1))], 1)
        mean, log_std = (part[:, 0] for part in learner.policy(state.actor, x))
    pairs = jnp.repeat(jnp.eye(STATES), len(GRID), 0), jnp.tile(jnp.asarray(GRID, jnp.float32), STATES)[:, None]
    q = networks.twin(critic, *pairs).mean(0).reshape(STATES, -1)
    return Found(np.tanh(mean), np.exp(log_std), np.asarray(q))


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_every_seed_reaches_its_prediction(name: str, trained: dict[str, Found]) -> None:
    found, expected = trained[name], predicted(name)
    for seed in range(SEEDS):
        print(name, seed, found.action[seed].round(3), found.deviation[seed].round(3), found.q[seed].mean().round(3))
    print(name, "predicted", expected.action.round(3), expected.deviation.round(3), expected.q.mean().round(3))
    np.testing.assert_allclose(found.action[:, HOME], expected.action[HOME], atol=HOME_MARGIN)
    # elsewhere the average of Q is nearly flat and leaves the mean to chance, but not the deviation
    np.testing.assert_allclose(found.action, np.tile(expected.action, (SEEDS, 1)), atol=MEAN_MARGIN)
    np.testing.assert_allclose(found.deviation, np.tile(expected.deviation, (SEEDS, 1)), atol=DEVIATION_MARGIN)
    levels = found.q.mean((-2, -1))
    scale = 1 if name in ("ad-sac", "bpql") else 3  # values of the reference are four times as large
    np.testing.assert_allclose(levels, expected.q.mean(), atol=scale * Q_MARGIN)


@pytest.mark.slow
def test_fixed_points_are_seen_apart(trained: dict[str, Found]) -> None:
    """In every seed: who goes into the field, how wide the policies are there, and whose critic is more cautious."""
    for vdpo in ("vdpo-forward", "vdpo-reverse"):
        assert trained[vdpo].action[:, HOME].min() > 0.1
    for actor_critic in ("ad-sac", "bpql"):
        assert trained[actor_critic].action[:, HOME].max() < -0.3
    widths = [trained[name].deviation[:, FIELD] for name in ("vdpo-forward", "bpql", "vdpo-reverse")]
    assert widths[0].min() > widths[1].max() + 0.2
    assert widths[1].min() > widths[2].max() + 0.05
    levels = {name: trained[name].q.mean((-2, -1)) for name in RUNS}
    assert levels["bpql"].min() > levels["ad-sac"].max() + 0.2
    assert levels["vdpo-reverse"].min() > levels["bpql"].max() + 5


@pytest.mark.slow
def test_predictions_differ_by_more_than_the_margins() -> None:
    """Else the first test could pass for the wrong method."""
    home = {name: predicted(name).action[HOME] for name in RUNS}
    width = {name: predicted(name).deviation[FIELD] for name in RUNS}
    level = {name: predicted(name).q.mean() for name in RUNS}
    assert min(home["vdpo-forward"], home["vdpo-reverse"]) - max(home["ad-sac"], home["bpql"]) > 4 * HOME_MARGIN
    assert width["vdpo-forward"] - max(width[name] for name in RUNS[1:]) > 2 * DEVIATION_MARGIN
    assert level["bpql"] - level["ad-sac"] > 2 * Q_MARGIN
