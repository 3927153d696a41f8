"""DC/AC: which steps count, what the target is, where the gradients flow."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from conftest import record, replay_of, sample
from delayrl.agents.base import reference_of
from delayrl.agents.dcac import DCAC, Roll, values
from delayrl.agents.registry import AGENTS
from delayrl.core import networks
from delayrl.core.types import Seen, Spec, Window
from delayrl.core.views import network_input, view
from delayrl.errors import DelayRLError
from delayrl.training.checks import check_agent

AGENT = DCAC(hidden=(16, 16), batch_size=16)
DELAY = 4
COUNTER = Spec(2, 1, DELAY)


@functools.cache
def counter(kind: str) -> Window:
    """Windows of an environment that counts: observation [t, T], reward t + 1, terminates after T = 4..10 steps."""
    transitions, _ = record("delayrl/Counter-v0", DELAY, 150)
    if kind == "truncated":
        transitions = [t._replace(terminated=np.bool_(False)) for t in transitions]
    if kind == "random":  # ages such as a random delay from 1..4 makes them, late observations ignored
        transitions = [t._replace(age=age_at(t.obs), next_age=age_at(t.next_obs)) for t in transitions]
    return sample(replay_of(transitions, COUNTER, 300), jax.random.key(0), 600, DELAY, DELAY, jnp.int32(2))


def age_at(obs: np.ndarray) -> np.int32:
    """A deterministic pattern in which an observation arrives for two steps, then none for two."""
    time, length = (int(x) for x in obs)
    newest = max([0, *(s for s in range(time) if s + 1 + (7 * s + length) % DELAY <= time)])
    return np.int32(time - newest)


@functools.cache
def rolled(kind: str) -> tuple[Roll, DCAC, networks.Params]:
    state = AGENT.init(COUNTER, jax.random.key(1))
    return jax.jit(AGENT.roll)(state.actor, counter(kind), jax.random.key(2)), AGENT, state.actor


def worth(x: np.ndarray, endless: bool) -> float:
    """The exact value of an augmented state of the counter: all rewards from its observation on, as they arrive."""
    seen_time, length, age = x[0], x[1], round(float(x[-1]) * DELAY)
    j = np.arange(seen_time, 4000 if endless else length)
    return float((0.99 ** (j + DELAY - (seen_time + age)) * (j + 1)).sum())  # r_j arrives on the way to j + 1 + Δ


def soft_returns(rolls: Roll, value: np.ndarray, agent: DCAC = AGENT) -> np.ndarray:
    both = jnp.stack([value, value + 1.0])
    return np.asarray(agent.soft_return(rolls, agent.reward_scale, agent.entropy_scale, both))


@pytest.mark.parametrize("kind", ["terminated", "truncated"])
def test_exact_values_are_the_fixed_point(kind: str) -> None:
    """With the true V for its target networks, the target of every sample is the true V: starts, ends, hidden rows."""
    rolls, _, _ = rolled(kind)
    agent = dataclasses.replace(AGENT, reward_scale=1.0, entropy_scale=0.0)
    value = np.array([worth(x, kind == "truncated") for x in np.asarray(rolls.x)])
    last = np.array([worth(x, kind == "truncated") for x in np.asarray(rolls.x_last)], np.float32)
    np.testing.assert_allclose(soft_returns(rolls, jnp.asarray(last), agent), value, rtol=1e-4, atol=1e-3)
    assert len(np.unique(rolls.steps)) > 2  # mixed lengths
    assert bool(rolls.ended.any()) == (kind == "terminated")
    assert (np.asarray(rolls.x[:, -1]) < 1).any()  # starts of episodes: age below Δ


def brute_force(window: Window, roll: Roll, value: float) -> tuple[int, float]:
    """The number of steps and the target of one sample that starts at t, with plain loops."""
    now, ages, rewards = DELAY, [int(a) for a in window.age], [float(r) for r in window.reward]
    lead = int(window.lead)
    if window.terminated.any():
        ages[now + lead + 1 :] = [min(ages[now + lead] + i, DELAY) for i in range(1, DELAY - lead + 1)]
        lead = DELAY
    steps = 0
    while steps < lead and ages[now + steps + 1] >= steps + 1:
        steps += 1
    total = 0.0
    for i in range(steps):
        arrives = sum(rewards[now + i - ages[now + i] : now + i + 1 - ages[now + i + 1]])
        total += 0.99**i * (5.0 * arrives - float(roll.log_prob[i]))
    return steps, total + 0.99**steps * value


@pytest.mark.parametrize("kind", ["terminated", "truncated", "random"])
def test_target_by_brute_force(kind: str) -> None:
    rolls, _, _ = rolled(kind)
    value = np.random.default_rng(0).normal(size=600).astype(np.float32)
    y = soft_returns(rolls, jnp.asarray(value))
    windows, rolls = jax.device_get((counter(kind), rolls))
    lengths = set()
    for i in np.flatnonzero(~rolls.ended):
        window, roll = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (windows, rolls))
        steps, target = brute_force(window, roll, float(value[i]))
        assert steps == roll.steps
        np.testing.assert_allclose(y[i], target, rtol=1e-4, atol=1e-4)
        lengths.add(steps)
    assert len(lengths) > 2 or kind == "terminated"


def test_released_formula_by_hand() -> None:
    """y = 5 r_0 - log π_0 + γ (5 r_1 - log π_1) + γ² min V at a constant delay of 2; and its actor's loss."""
    roll = Roll(
        x=jnp.zeros((2, 1)),
        x_last=jnp.zeros((2, 1)),
        reward=jnp.array([[1.0, 2.0], [1.0, 2.0]]),
        log_prob=jnp.array([[0.5, -1.0], [0.5, -1.0]]),
        steps=jnp.array([2, 1], jnp.int32),
        ended=jnp.array([False, True]),
    )
    value = jnp.array([[10.0, 10.0], [9.0, 9.0]])
    # 4.5 + .99 · 11 + .9801 · 9; and of one step, at whose end the terminal state shows: 4.5, and nothing of step 2
    np.testing.assert_allclose(AGENT.soft_return(roll, 5.0, 1.0, value), [24.2109, 4.5], rtol=1e-6)
    np.testing.assert_allclose(AGENT.soft_return(roll, 0.0, 1.0, value), [-0.5 + 0.99 + 8.8209, -0.5], rtol=1e-6)


def test_stretch_is_the_past_with_new_actions() -> None:
    """x_t is as recorded; x_{t+Δ} shows s_t with Δ new actions, drawn from the policy at the states between."""
    rolls, agent, actor = rolled("truncated")
    inputs = jax.jit(jax.vmap(lambda window: network_input(view(window), "augmented")))(counter("truncated"))
    rolls, recorded, windows = jax.device_get((rolls, inputs, counter("truncated")))  # single entries are slow in JAX
    policy = jax.jit(agent.policy)
    whole = np.flatnonzero(np.asarray(rolls.steps) == DELAY)
    assert len(whole) > 50
    for i in whole[:40]:
        window = jax.tree.map(lambda x, i=i: x[i], windows)
        np.testing.assert_array_equal(rolls.x[i], recorded[i])
        x_last = np.asarray(rolls.x_last[i])
        np.testing.assert_array_equal(x_last[:2], window.obs[DELAY])
        new = x_last[2:-1]
        history = np.concatenate([window.action[:DELAY, 0], new])
        for step in range(DELAY):
            age = int(window.age[DELAY + step])
            seen = np.zeros((DELAY, 1), np.float32)
            seen[:age, 0] = history[DELAY + step - age : DELAY + step]
            x = Seen(jnp.asarray(window.obs[DELAY + step - age]), jnp.int32(age), jnp.asarray(seen))
            mean, log_std = policy(actor, network_input(x, "augmented"))
            raw = np.arctanh(np.float64(new[step]))
            normal = -0.5 * ((raw - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
            expected = float((normal - np.log(1 - np.tanh(raw) ** 2))[0])
            np.testing.assert_allclose(rolls.log_prob[i, step], expected, rtol=1e-3, atol=2e-3)


def test_the_delay_holds_the_terminal_state_back() -> None:
    """Some values are learned after T, where x still shows a state before it; only those targets end in 0."""
    windows = counter("terminated")
    recorded = jax.jit(jax.vmap(lambda window: network_input(view(window), "augmented")))(windows)
    rolls, windows = jax.device_get((rolled("terminated")[0], windows))  # reading single entries is slow in JAX
    ended, over = rolls.ended, windows.terminated.any(1)
    assert not (ended & ~over).any()
    assert 0.35 < ended[over].mean() < 0.65
    np.testing.assert_array_equal(rolls.x[ended, 0], windows.obs[ended, DELAY, 0])  # s_t arrives at t + Δ
    np.testing.assert_array_equal(rolls.x_last[ended, 0], rolls.x_last[ended, 1])  # the last shows t = T
    np.testing.assert_array_equal(rolls.steps[ended], windows.lead[ended])
    np.testing.assert_allclose(rolls.reward[ended, 0], rolls.x[ended, 0] + 1)
    # of the new actions that the last state shows, the first `steps` were taken from x on: their densities count
    _, agent, actor = rolled("terminated")
    policy = jax.jit(agent.policy)
    for i in np.flatnonzero(ended)[:20]:
        action = rolls.x_last[i, 2 + DELAY - int(rolls.steps[i])]
        mean, log_std = (x[0] for x in policy(actor, rolls.x[i]))
        normal = stats.norm.logpdf(np.arctanh(np.float64(action)), mean, np.exp(np.float64(log_std)))
        np.testing.assert_allclose(
            rolls.log_prob[i, 0], normal - np.log(1 - np.float64(action) ** 2), rtol=1e-3, atol=1e-3
        )
    np.testing.assert_array_equal(rolls.x[~ended], np.asarray(recorded)[~ended])


@functools.cache
def parts():
    transitions, _ = record("Reacher-v5", 3, 60)
    spec = Spec(10, 2, 3)
    windows = sample(replay_of(transitions, spec, 300), jax.random.key(0), 16, 3, 3, 0)
    return AGENT.init(spec, jax.random.key(0)), windows


def test_gradients() -> None:
    """The critics learn from their error alone; the actor from the new actions inside x, through frozen critics."""
    state, windows = parts()
    zero = jax.tree.map(jnp.zeros_like, state.critic)

    def gradient(agent: DCAC, critic):
        batch = state.target, windows, jax.random.key(5), agent.entropy_scale
        return jax.jit(jax.grad(lambda params: agent.loss(params, *batch)[0]))((state.actor, critic))

    def size(tree) -> float:
        return float(sum(jnp.abs(x).sum() for x in jax.tree.leaves(tree)))

    only_actor = dataclasses.replace(AGENT, actor_share=1.0, entropy_scale=0.0)
    of_actor, of_critic = gradient(only_actor, state.critic)
    assert size(of_actor) > 1e-4  # without entropy: through V(x_n), whose only new part is its actions
    assert size(of_critic) == 0
    assert size(gradient(only_actor, zero)[0]) == 0
    of_actor, of_critic = gradient(dataclasses.replace(AGENT, actor_share=0.0), state.critic)
    assert size(of_actor) == 0
    assert size(of_critic) > 0


def test_critics_do_not_move_the_actor_at_ends() -> None:
    """A stretch that starts at an episode's end starts with new actions; its error is the critics' alone."""
    state, windows = AGENT.init(COUNTER, jax.random.key(1)), jax.tree.map(lambda x: x[:64], counter("terminated"))
    agent = dataclasses.replace(AGENT, actor_share=0.0)
    batch = state.target, windows, jax.random.key(5), 1.0
    of_actor, _ = jax.jit(jax.grad(lambda params: agent.loss(params, *batch)[0]))((state.actor, state.critic))
    assert all((x == 0).all() for x in jax.tree.leaves(of_actor))


def test_the_target_is_of_the_target_critics() -> None:
    """Of all critic weights, those of the target networks alone reach the target; and every window has its noise."""
    state, windows = parts()
    twice = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), windows)
    actor = state.actor
    loss = jax.jit(lambda critic, target: AGENT.loss((actor, critic), target, twice, jax.random.key(5), 1.0)[1])
    rolls = AGENT.roll(actor, twice, jax.random.key(5))
    assert not np.array_equal(rolls.log_prob[0], rolls.log_prob[1])
    other = AGENT.init(Spec(10, 2, 3), jax.random.key(9)).target
    for target in (state.target, other):
        y = AGENT.soft_return(rolls, 5.0, 1.0, values(target, rolls.x_last))
        error = ((values(state.critic, rolls.x) - y) ** 2).mean(-1).sum()
        metrics = loss(state.critic, target)
        np.testing.assert_allclose(metrics["critic_loss"], error, rtol=1e-4)
        gain = AGENT.soft_return(rolls, 0.0, 1.0, values(state.critic, rolls.x_last)).mean()
        np.testing.assert_allclose(metrics["actor_loss"], -gain, rtol=1e-4)


def test_the_entropy_is_of_the_actions_that_count() -> None:
    """Those of a stretch that a time limit or a random delay cuts do not enter a target, nor move the temperature."""
    state, windows = parts()
    cut = dataclasses.replace(windows, age=windows.age.at[:, 4:].set(1))  # the first step alone hides its action
    rolls = AGENT.roll(state.actor, cut, jax.random.key(5))
    steps, log_prob = np.asarray(rolls.steps), np.asarray(rolls.log_prob)
    assert steps.max() < 3
    expected = -np.mean([x for own, n in zip(log_prob, steps, strict=True) for x in own[:n]])
    _, metrics = AGENT.loss((state.actor, state.critic), state.target, cut, jax.random.key(5), 1.0)
    np.testing.assert_allclose(metrics["entropy"], expected, rtol=1e-5)


def test_gradient_reaches_the_first_action() -> None:
    """Each of the Δ new actions is one that the value at the end of the stretch can blame."""
    state, windows = parts()
    window = jax.tree.map(lambda x: x[:1], windows)

    def last_value(actor):
        return values(state.critic, AGENT.roll(actor, window, jax.random.key(0)).x_last).min()

    slopes = jax.grad(lambda x: values(state.critic, x).min())(
        AGENT.roll(state.actor, window, jax.random.key(0)).x_last
    )
    assert (jnp.abs(slopes[0, 10:16]) > 0).all()
    change = jax.grad(last_value)(state.actor)
    assert all((jnp.abs(x) > 0).any() for x in jax.tree.leaves(change))


def test_update() -> None:
    """Everything moves, the targets by τ; the same key gives the same; no metric is missing."""
    state, windows = parts()
    update = jax.jit(AGENT.update)
    once, metrics = update(state, windows, jax.random.key(1), jnp.int32(0))
    again, _ = update(state, windows, jax.random.key(1), jnp.int32(7))
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert set(metrics) == {"critic_loss", "actor_loss", "value", "entropy", "target_steps"}
    for old, new in ((state.actor, once.actor), (state.critic, once.critic)):
        assert not all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True))
    expected = jax.tree.map(lambda t, c: 0.995 * t + 0.005 * c, state.target, once.critic)
    for a, b in zip(jax.tree.leaves(once.target), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_act() -> None:
    state, _ = parts()
    seen = Seen(jnp.ones(10), jnp.int32(2), jnp.zeros((3, 2)).at[:2].set(0.3))
    mode = AGENT.act(state, seen, jax.random.key(0), explore=False)
    np.testing.assert_array_equal(mode, AGENT.act(state, seen, jax.random.key(1), explore=False))
    drawn = AGENT.act(state, seen, jax.random.key(0), explore=True)
    assert not np.array_equal(drawn, AGENT.act(state, seen, jax.random.key(1), explore=True))
    other = AGENT.act(state, seen._replace(actions=-seen.actions), jax.random.key(0), explore=False)
    assert not np.array_equal(mode, other)
    assert not AGENT.privileged
    assert reference_of(AGENT, state) is None
    with pytest.raises(DelayRLError, match="at least 1 step"):
        AGENT.init(Spec(10, 2, 0), jax.random.key(0))


@pytest.mark.parametrize("delay", ["uniform:1:4", "uniform:1:4@raw", "gilbert:1:4:0.3:0.3@fifo"])
def test_a_stretch_counts_what_arrived_in_it(delay: str) -> None:
    """Rewards from the first look's state to the last one's, each once, also where a look goes back in time."""
    replay = replay_of(record("delayrl/Counter-v0", delay, 200)[0], COUNTER, 300)
    windows = sample(replay, jax.random.key(0), 512, DELAY, DELAY, jnp.int32(0))
    actor = AGENT.init(COUNTER, jax.random.key(0)).actor
    rolls, windows = jax.device_get((jax.jit(AGENT.roll)(actor, windows, jax.random.key(1)), windows))
    earned = np.cumsum(np.arange(60))  # of the first c steps of an episode: 1 + 2 + … + c
    moment = np.asarray(windows.obs[:, DELAY, 0]).astype(int)
    checked = 0
    for i in np.flatnonzero(~np.asarray(windows.terminated.any(1))):
        count = int(rolls.steps[i])
        first, last = (moment[i] + k - int(windows.age[i, DELAY + k]) for k in (0, count))
        assert float(rolls.reward[i, :count].sum()) == earned[last] - earned[first]
        checked += count > 1
    assert checked > 50


def test_the_preset_matched_is_traced_as_a_run_begins() -> None:
    """With the checks of types and shapes, which are the tests' own; its temperature is learned."""
    agent, spec = AGENTS["dcac"].presets["matched"].agent, Spec(10, 2, 3)
    check_agent(agent, spec)


def test_a_batch_without_a_step_leaves_a_learned_temperature() -> None:
    """Under delays that can be 0 a window may have no step to sum, and then it shows no entropy."""
    agent = dataclasses.replace(AGENT, temperature="learned")
    windows = counter("truncated")
    fresh = dataclasses.replace(windows, age=jnp.zeros_like(windows.age))
    state = agent.init(COUNTER, jax.random.key(1))
    for batch, moves in ((windows, True), (fresh, False)):
        before = state.log_temperature, state.temperature_opt_state
        state, metrics = jax.jit(agent.update)(state, batch, jax.random.key(2), jnp.int32(0))
        assert (metrics["target_steps"] > 0) == moves
        after = state.log_temperature, state.temperature_opt_state
        pairs = zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
        assert [bool((a != b).all()) for a, b in pairs] == [moves] * len(jax.tree.leaves(before))
