"""SAC on two views: SAC, memoryless SAC, A-SAC, BPQL."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learning import ACT, ENV, OBS, counted, same, seen, trained

from conftest import TINY, TINY_SAC, record
from delayrl.agents.vdpo import VDPO
from delayrl.core import replay as ring
from delayrl.core.types import Spec
from delayrl.errors import DelayRLError


def test_zero_delay_is_one_algorithm() -> None:
    """Without a delay SAC, A-SAC and BPQL end with bitwise equal parameters."""
    agents = [TINY_SAC, TINY["a-sac"], TINY["bpql"], TINY["sac-memoryless"]]
    states = [trained(agent, 0, 20)[0].agent for agent in agents]
    for state in states[1:]:
        assert same(states[0], state)


def test_views_are_what_the_table_says() -> None:
    """Actor and critic of each agent see s_t, s_{t-d} or x_t, and nothing else."""
    _, windows = counted(3, 60, batch=50, ahead=1)
    true, late = windows.obs[:, 3, 0], windows.obs[:, 3, 0] - windows.age[:, 3]
    for name, actor_time, critic_time, sizes in (
        ("sac-memoryless", late, late, (2, 2)),
        ("a-sac", late, late, (6, 6)),
        ("bpql", late, true, (6, 2)),
    ):
        actor, critic = TINY[name]._inputs(windows, 0)
        assert (actor.shape[1], critic.shape[1]) == sizes
        np.testing.assert_array_equal(actor[:, 0], actor_time)
        np.testing.assert_array_equal(critic[:, 0], critic_time)


def test_memoryless_sees_no_actions(rng: np.random.Generator) -> None:
    learner, _, _ = trained(TINY["sac-memoryless"], 3)
    state = jax.tree.map(lambda x: x[0], learner.agent)
    one = seen(3, 3, rng)
    two = one._replace(actions=-one.actions)
    act = TINY["sac-memoryless"].act
    np.testing.assert_array_equal(
        act(state, one, jax.random.key(0), explore=False), act(state, two, jax.random.key(0), explore=False)
    )


def test_bpql_is_aligned() -> None:
    """On a counter: critics at (s_t, a_t) with t the true step, the actor at s_{t-d} with the actions since."""
    transitions, windows = counted(2, 80, batch=500, ahead=1)
    actor, critic = TINY["bpql"]._inputs(windows, 0)
    actor_next, critic_next = TINY["bpql"]._inputs(windows, windows.n_step)
    by_action = {float(t.action[0]): i for i, t in enumerate(transitions)}
    for i in range(500):
        step = by_action[float(windows.action[i, 2, 0])]
        now, length = transitions[step].obs
        age = min(int(now), 2)
        np.testing.assert_array_equal(critic[i], [now, length])
        np.testing.assert_array_equal(critic_next[i], [now + 1, length])
        since = [transitions[step - age + j].action[0] if j < age else 0 for j in range(2)]
        np.testing.assert_allclose(actor[i], [now - age, length, *since, age / 2])
        age = min(int(now) + 1, 2)
        since = [transitions[step + 1 - age + j].action[0] if j < age else 0 for j in range(2)]
        np.testing.assert_allclose(actor_next[i], [now + 1 - age, length, *since, age / 2])


def test_sac_needs_the_current_state() -> None:
    with pytest.raises(DelayRLError, match="delay-free reference"):
        TINY_SAC.init(Spec(OBS, ACT, 5), jax.random.key(0))
    with pytest.raises(DelayRLError, match="at least 1 step"):
        VDPO().init(Spec(OBS, ACT, 0), jax.random.key(0))


def test_actor_and_temperature_move_every_second_time() -> None:
    """Twice on the odd counts, not at all on the even ones; critics and targets always."""
    transitions, _ = record(ENV, 0, 40)
    replay = ring.init(Spec(OBS, ACT, 0), 100)
    for transition in transitions:
        replay = jax.jit(ring.append)(replay, transition)
    windows = ring.sample(replay, jax.random.key(0), 16, 0, 3, jnp.int32(0))
    state = TINY_SAC.init(Spec(OBS, ACT, 0), jax.random.key(0))
    even, _ = TINY_SAC.update(state, windows, jax.random.key(1), jnp.int32(4))
    odd, _ = TINY_SAC.update(state, windows, jax.random.key(1), jnp.int32(5))
    assert same(even.actor, state.actor)
    assert same(even.log_temperature, state.log_temperature)
    assert not same(even.critic, state.critic)
    assert same(even.critic, odd.critic)
    assert int(odd.actor_opt_state[0].count) == int(odd.temperature_opt_state[0].count) == 2
    expected = jax.tree.map(lambda t, c: 0.995 * t + 0.005 * c, state.target, even.critic)
    for a, b in zip(jax.tree.leaves(even.target), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)
