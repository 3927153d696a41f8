"""The agents' own updates, run to convergence on a noisy chain, end where the theory says (docs/theory.md, 4 and 5).

The batch lists windows of the chain (tests/agents/chain.py) as often as they are likely, so that an update follows the
expected gradient, but for the actions that the policies sample. Networks are wide enough to be tables.
"""

from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from chain import (
    DISCOUNT,
    GRID,
    STATES,
    TEMPERATURE,
    Policy,
    Solution,
    act,
    adsac_value,
    bpql_value,
    clone,
    reference_value,
    reward,
    solve,
    transition,
)

from delayrl.agents.adsac import ADSAC
from delayrl.agents.any_age import AnyAge
from delayrl.agents.dida import DIDA
from delayrl.agents.sac import SAC
from delayrl.agents.vdpo import VDPO
from delayrl.core import networks
from delayrl.core.types import Spec, Window

pytestmark = pytest.mark.thorough  # all together, 40 seconds

ACTIONS = np.linspace(-1, 1, 9)
PAST = np.array([-1.0, 0.0, 1.0])  # past actions, in histories
SAC_OPTIONS: dict[str, Any] = {
    "hidden": (32,),
    "actor_learning_rate": 1e-2,
    "critic_learning_rate": 1e-2,
    "discount": DISCOUNT,
    "initial_temperature": TEMPERATURE,
    "temperature_learning_rate": 0.0,
    "n_steps": 1,
    "actor_every": 1,
    "actor_updates": 1,
    "target_rate": 0.1,
    "log_std_range": (-5.0, 2.0),
    "log_std_bounds": "clip",
}
AGENTS: dict[str, Any] = {
    "sac": SAC(**SAC_OPTIONS),
    "bpql": SAC(actor_sees="augmented", critic_sees="current", **SAC_OPTIONS),
    "ad-sac": ADSAC(SAC(actor_sees="augmented", critic_sees="augmented", **SAC_OPTIONS)),
}
VALUES = {"sac": reference_value, "bpql": bpql_value, "ad-sac": adsac_value}
Q_MARGIN, MEAN_MARGIN, DEVIATION_MARGIN = 0.2, 0.06, 0.06
AT_ACTIONS, AT_PAST = np.searchsorted(GRID, ACTIONS), np.searchsorted(GRID, PAST)


def outcomes(actions: np.ndarray) -> np.ndarray:
    """Sixteen next states for each state and action, each as often as it is likely: (3, N, 16)."""
    counts = np.round(16 * transition(actions)).astype(int)
    assert (counts.sum(-1) == 16).all()
    return np.array([[np.repeat(np.arange(STATES), row) for row in rows] for rows in counts])


@cache
def windows(delay: int) -> Window:
    """Windows of the chain for the delay 0 or 1, with every action at every state.

    Given what an actor sees, s_t is distributed as its belief is; given s_t and a_t, s_{t+1} as the chain says.
    """
    later, rows, met = outcomes(ACTIONS), [], [0] * STATES
    for (state, past, _), now in np.ndenumerate(outcomes(PAST)):
        rows += [(state, now, later[now, i, met[now] % 16], PAST[past], a) for i, a in enumerate(ACTIONS)]
        met[now] += 1
    assert (np.array(met) % 16 == 0).all()
    table = np.array(rows)
    states, actions = table[:, :3].astype(int), np.pad(table[:, 3:], ((0, 0), (0, 1)))  # the last action is not known
    earned = [reward(action)[state, np.arange(len(rows))] for state, action in zip(states.T, actions.T, strict=True)]
    kept, shape = slice(1 - delay, 3), (len(rows), 2 + delay)
    return Window(
        obs=jnp.eye(STATES)[states[:, kept]],
        age=jnp.full(shape, delay),
        action=jnp.asarray(actions[:, kept, None], jnp.float32),
        reward=jnp.asarray(np.stack(earned, -1)[:, kept], jnp.float32),
        terminated=jnp.zeros(shape, bool),
        valid=jnp.ones(shape, bool),
        lead=jnp.ones(len(rows), jnp.int32),
        n_step=jnp.ones(len(rows), jnp.int32),
        delay=delay,
    )


def run(update: Any, state: Any, batch: Window, updates: int, first: int = 0) -> Any:
    """Apply an agent's update many times to one batch, the first of them at a later step of the run if asked."""

    @jax.jit
    def loop(state: Any, batch: Window) -> Any:
        def step(state: Any, i: Any) -> tuple[Any, None]:
            return update(state, batch, jax.random.fold_in(jax.random.key(0), i), i)[0], None

        return jax.lax.scan(step, state, first + jnp.arange(updates))[0]

    return loop(state, batch)


@cache
def expected(name: str) -> Solution:
    return solve(VALUES[name])


def with_options(agent: Any, **options: float) -> Any:
    """The same agent with other hyperparameters of its SAC."""
    if isinstance(agent, ADSAC):
        return replace(agent, learner=replace(agent.learner, **options))
    return replace(agent, **options)


@cache
def learned(name: str) -> Any:
    """An agent's state at its fixed point."""
    agent, batch = AGENTS[name], windows(0 if name == "sac" else 1)
    state = agent.init(Spec(STATES, 1, batch.delay), jax.random.key(1))
    for rate, updates in ((1e-2, 600), (1e-3, 300)):
        agent = with_options(agent, actor_learning_rate=rate, critic_learning_rate=rate)
        state = run(agent.phases()[0].update, state, batch, updates)
    return state


def learner(name: str) -> tuple[SAC, Any]:
    """The SAC that holds an agent's critics, and its state."""
    agent, state = AGENTS[name], learned(name)
    return (agent.learner, state.auxiliary) if name == "ad-sac" else (agent, state)


def q_table(critic: Any) -> Any:
    """Both critics at each state and action, (2, 3, 9)."""
    states, actions = (np.array(x) for x in zip(*product(range(STATES), ACTIONS), strict=True))
    q = networks.twin(critic, jnp.eye(STATES)[states], jnp.asarray(actions, jnp.float32)[:, None])
    return np.asarray(q).reshape(2, STATES, len(ACTIONS))


def histories() -> jax.Array:
    """x_t = (s_{t-1}, a_{t-1}, age 1) for each state and each of the three past actions."""
    rows = [[*np.eye(STATES)[s], a, 1.0] for s, a in product(range(STATES), PAST)]
    return jnp.asarray(rows, jnp.float32)


def assert_gaussians(found: networks.Gaussian, mean: Any, deviation: Any) -> None:
    np.testing.assert_allclose(np.tanh(found.mean[:, 0]), np.tanh(mean), atol=MEAN_MARGIN)
    np.testing.assert_allclose(np.exp(found.log_std[:, 0]), deviation, atol=DEVIATION_MARGIN)


def late(solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Means and deviations of the delayed policy at `histories`."""
    mean, log_std = (np.asarray(x).reshape(STATES, -1)[:, AT_PAST].ravel() for x in solution.late)
    return mean, np.exp(log_std)


# ---- The exact solutions -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(AGENTS))
def test_solutions_are_settled(name: str) -> None:
    """Q is r + γ E V of the policies, and no other Gaussian has a higher soft value."""
    solution = expected(name)
    q, late = np.asarray(solution.q), solution.late
    free = soft_value(q, solution.current)
    for (s, i), found in np.ndenumerate(q):
        seen = Policy(*(x.reshape(STATES, -1)[s, i][None] for x in late))  # after the action i in state s
        values = [soft_value(q[[after]], seen)[0] for after in range(STATES)]
        if name == "sac":
            values = [own.mean() for own in free]
        elif name == "bpql":
            values = [own.mean() for own in values]
        else:
            values = [np.minimum.outer(one, other).mean() for one, other in zip(free, values, strict=True)]
        probability, earned = transition(GRID[[i]])[s, 0], reward(GRID[[i]])[s, 0]
        assert found == pytest.approx(earned + DISCOUNT * probability @ values, abs=0.02)
    averaged = transition(GRID).reshape(-1, STATES) @ q
    best = soft_value(averaged, late).mean(-1)
    for shift, widen in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.0, -0.1)):
        other = Policy(late.mean + shift, late.log_std + widen)
        assert (soft_value(averaged, other).mean(-1) < best).all()


def soft_value(q: np.ndarray, policy: Policy) -> np.ndarray:
    """Q - α log π at equally likely actions of each Gaussian, (N, 64)."""
    actions, log_prob = (np.asarray(x) for x in act(policy))
    return np.stack([np.interp(a, GRID, row) for a, row in zip(actions, q, strict=True)]) - TEMPERATURE * log_prob


def test_the_fixed_points_lie_apart() -> None:
    """By several times the margins within which learning must meet them."""
    q = {name: np.asarray(expected(name).q) for name in AGENTS}
    assert (q["sac"] - q["bpql"]).min() > 20 * Q_MARGIN
    assert (q["bpql"] - q["ad-sac"]).min() > 3.5 * Q_MARGIN
    home = 0  # x = (home, -1): at home for sure, where VDPO acts as its reference does
    vdpo, bpql = np.tanh(expected("sac").current.mean[0]), np.tanh(late(expected("bpql"))[0][home])
    assert vdpo - bpql > 10 * MEAN_MARGIN
    forward, reverse = (clone(expected("sac").current, PAST, forward)[1] for forward in (True, False))
    assert (forward - reverse)[1:].min() > 10 * DEVIATION_MARGIN


# ---- Critics and the actors that follow them ---------------------------------------------------------------


@pytest.mark.parametrize("name", list(AGENTS))
def test_critics_reach_their_fixed_point(name: str) -> None:
    _, state = learner(name)
    np.testing.assert_allclose(q_table(state.critic), [expected(name).q[:, AT_ACTIONS]] * 2, atol=Q_MARGIN)


def test_the_reference_is_soft_optimal() -> None:
    agent, state = learner("sac")
    mean, log_std = expected("sac").current
    assert_gaussians(agent.policy(state.actor, jnp.eye(STATES)), mean, np.exp(log_std))


@pytest.mark.parametrize("name", ["bpql", "ad-sac"])
def test_the_late_actor_maximises_the_average_of_q(name: str) -> None:
    agent, _ = learner(name)
    assert_gaussians(agent.policy(learned(name).actor, histories()), *late(expected(name)))


def test_the_auxiliary_actor_is_soft_greedy_for_the_shared_critics() -> None:
    agent, state = learner("ad-sac")
    mean, log_std = expected("ad-sac").current
    assert_gaussians(agent.policy(state.actor, jnp.eye(STATES)), mean, np.exp(log_std))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(AGENTS))
def test_critics_take_one_step_from_the_target_critics(name: str) -> None:
    """Targets that say 7 and 9 everywhere and never move: Q = r + γ V, V the least of what the agent compares."""
    agent, batch = AGENTS[name], windows(0 if name == "sac" else 1)
    state = agent.init(Spec(STATES, 1, batch.delay), jax.random.key(1))
    own = state.auxiliary if name == "ad-sac" else state
    target = [jax.tree.map(jnp.zeros_like, critic) for critic in own.target]
    for critic, value in zip(target, (7.0, 9.0), strict=True):
        critic[-1]["b"] += value
    own = own._replace(target=target, actor=jax.tree.map(jnp.zeros_like, own.actor))  # a Gaussian N(0, 1), everywhere
    late = jax.tree.map(jnp.zeros_like, state.actor)
    state = state._replace(auxiliary=own, actor=late) if name == "ad-sac" else own
    agent = with_options(agent, target_rate=0.0, actor_learning_rate=0.0)
    state = run(agent.phases()[0].update, state, batch, 400)
    own = state.auxiliary if name == "ad-sac" else state
    soft = np.asarray([7.0, 9.0])[:, None] - TEMPERATURE * np.asarray(act(Policy(jnp.zeros(1), jnp.zeros(1)))[1])
    value = np.minimum(soft[0][:, None], soft[1]).mean() if name == "ad-sac" else soft[0].mean()
    np.testing.assert_allclose(q_table(own.critic), [reward(ACTIONS) + DISCOUNT * value] * 2, atol=0.5)


# ---- any-age -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoder", "weight", "distance"),
    [
        pytest.param("mlp", 0.0, "moments", marks=pytest.mark.slow),
        ("mlp", 1.0, "moments"),
        pytest.param("mlp", 1.0, "kl", marks=pytest.mark.slow),
        ("forecast", 0.0, "moments"),
    ],
)
def test_any_age_ends_where_its_pull_leaves_it(encoder: Any, weight: float, distance: Any) -> None:
    """Without a pull at BPQL's policy. Gaussians cannot be the geometric mean, so that KL moves them too, but less.

    A forecast of one-hot states is their distribution, so that a policy on it loses nothing.
    """
    solution = solve(bpql_value, pull=(weight, distance))
    narrower = (late(expected("bpql"))[1] - late(solution)[1]).max()
    assert narrower == pytest.approx(0.0 if weight == 0 else {"moments": 0.364, "kl": 0.246}[distance], abs=0.01)
    bpql = AGENTS["bpql"]
    constant = {"pull_hold": 1.0, "pull_end": 1.0, "run_steps": 10**6, "second_age": "zero"}
    agent = AnyAge(bpql, pull_weight=weight, pull=distance, encoder=encoder, **constant)
    state = agent.init(Spec(STATES, 1, 1), jax.random.key(1))
    for rate, updates in ((1e-2, 1200), (1e-3, 300)):
        state = run(learning_at(rate, agent).update, state, windows(1), updates)
    np.testing.assert_allclose(q_table(state.critic), [solution.q[:, AT_ACTIONS]] * 2, atol=Q_MARGIN)
    bpql = agent.learner
    assert_gaussians(bpql.policy(state.actor, histories()), *late(solution))
    fresh = jnp.concatenate([jnp.eye(STATES), jnp.zeros((STATES, 2))], -1)  # x_t of age 0
    assert_gaussians(bpql.policy(state.actor, fresh), solution.current.mean, np.exp(solution.current.log_std))


def learning_at(rate: float, agent: AnyAge) -> AnyAge:
    return replace(agent, bpql=with_options(agent.bpql, actor_learning_rate=rate, critic_learning_rate=rate))


@pytest.mark.slow
def test_an_annealed_pull_leaves_no_bias() -> None:
    """Its weight holds for 800 updates, in which the policy narrows, and is 0 from 1,200 on: it ends at BPQL's."""
    solution, bpql = expected("bpql"), AGENTS["bpql"]
    annealed = {"pull_weight": 1.0, "pull_hold": 0.5, "pull_end": 0.75, "run_steps": 1600, "second_age": "zero"}
    agent = AnyAge(bpql, encoder="mlp", **annealed)
    state = agent.init(Spec(STATES, 1, 1), jax.random.key(1))
    state = run(learning_at(1e-2, agent).update, state, windows(1), 800)
    held = bpql.policy(state.actor, histories()).log_std
    assert (late(solution)[1] - np.exp(held)).max() > 0.3
    state = run(learning_at(1e-2, agent).update, state, windows(1), 800, first=800)
    state = run(learning_at(1e-3, agent).update, state, windows(1), 300, first=1600)
    np.testing.assert_allclose(q_table(state.critic), [solution.q[:, AT_ACTIONS]] * 2, atol=Q_MARGIN)
    assert_gaussians(agent.learner.policy(state.actor, histories()), *late(solution))


# ---- Imitation ---------------------------------------------------------------------------------------------


def table_of(mean: Any, deviation: Any) -> Any:
    """An actor that is a table over one-hot states: one linear layer."""
    return [{"w": jnp.stack([jnp.asarray(mean), jnp.log(jnp.asarray(deviation))], -1), "b": jnp.zeros(2)}]


def with_reference(agent: Any, mean: Any, deviation: Any) -> Any:
    """An agent's fresh state, with a table for its reference."""
    state = agent.init(Spec(STATES, 1, 1), jax.random.key(1))
    return state._replace(reference=state.reference._replace(actor=table_of(mean, deviation)))


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_vdpo_clones_to_the_closed_form_of_its_direction(direction: Any) -> None:
    """Forward: the moments of the mixture. Reverse: means weighted by precision."""
    mean, deviation = np.array([0.4, -1.2, 1.6]), np.array([0.9, 0.4, 0.7])
    options = {"representation": "mlp", "width": 32, "direction": direction}
    agent = VDPO(AGENTS["sac"], **options)
    state = with_reference(agent, mean, deviation)
    head = networks.mlp_init(jax.random.key(2), (STATES + 2, 32, 2))  # its own starts so small that it learns slowly
    state = state._replace(head=head, clone_opt_state=optax.adam(1e-2).init({"head": head}))
    for rate in (1e-2, 1e-3):
        state = run(replace(agent, learning_rate=rate).clone, state, windows(1), 500)
    at = histories().reshape(STATES, len(PAST), -1)
    found = agent.policy(state, at[..., :STATES], at[..., None, STATES : STATES + 1])
    means, deviations = clone(Policy(jnp.asarray(mean), jnp.log(jnp.asarray(deviation))), PAST, direction == "forward")
    np.testing.assert_allclose(found.mean[..., 0, 0], means, atol=0.02)
    np.testing.assert_allclose(np.exp(found.log_std[..., 0, 0]), deviations, atol=0.02)


def test_dida_takes_the_median_of_the_experts_actions() -> None:
    """The belief's mean of them is another action: 0.125 at (home, 0), 0.088 in the field."""
    mode = np.array([0.2, -0.8, 0.9])
    agent = DIDA(AGENTS["sac"], student_hidden=(32,), student_optimiser="adam", student_learning_rate=1e-3)
    state = with_reference(agent, np.arctanh(mode), np.ones(STATES))
    state = run(lambda *given: agent.imitate(*given[:3], given[3] + 10**8), state, windows(1), 1500)
    action = np.asarray(agent.policy(state.student, histories()))[:, 0]
    certain = np.arange(STATES * len(PAST)) != 2  # at (home, 1) left and right are equally likely, with two medians
    np.testing.assert_allclose(action[certain], mode[0], atol=0.03)
