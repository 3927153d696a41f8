"""Episodes with drawn travel times: what `start`, `act`, `arrive` and `restart` do around the mechanics."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delayrl.batched import act, arrive, as_batched, per_episode, restart, start
from delayrl.batched.delay import BatchedDelay

ROBOTS, STEPS, LENGTH = 6, 40, 9


@jax.jit
def play(delay: BatchedDelay, length: int = LENGTH) -> Any:
    """Play robots whose observation is [t, the action that acted]; the action of step t is t + 1. All shown: [N, T]."""
    axes, idle = delay.axes(), jnp.zeros(1)

    def step(carry: Any, _: Any) -> Any:
        episodes, time = carry
        issued = jnp.broadcast_to(time + 1.0, (ROBOTS, 1))
        episodes, applied = jax.vmap(act, in_axes=(axes, 0, 0))(delay, episodes, issued)
        obs = jnp.stack([jnp.broadcast_to(time + 1.0, ROBOTS), applied[:, 0]], 1)
        end, no = jnp.broadcast_to(time + 1 == length, ROBOTS), jnp.zeros(ROBOTS, bool)
        episodes, now = jax.vmap(arrive, in_axes=(axes, 0, 0, 0, 0, 0))(delay, episodes, obs, obs[:, 0], end, no)
        again = jax.vmap(restart, in_axes=(axes, 0, 0, 0, 0))
        episodes, first = again(delay, episodes, now, now.terminated, jnp.zeros((ROBOTS, 2)))
        return (episodes, jnp.where(end[0], 0, time + 1)), (now, first)

    keys = jax.random.split(jax.random.key(0), ROBOTS)
    begin = jax.vmap(start, in_axes=(axes, 0, 0, None))
    episodes, first = begin(delay, keys, jnp.zeros((ROBOTS, 2)), idle)
    _, shown = jax.lax.scan(step, (episodes, 0), None, length=STEPS)
    return first, jax.tree.map(lambda array: array.swapaxes(0, 1), shown)


def test_ranges_per_robot_hold_for_an_episode() -> None:
    """Observations and actions of a robot are as late as its own range says, one delay in each episode."""
    low, high = np.array([0, 1, 2, 3, 0, 2]), np.array([0, 2, 4, 3, 1, 4])
    delay = BatchedDelay(per_episode(low, high), per_episode(low // 2, high // 2))
    first, (now, after) = jax.device_get(play(delay))
    time = np.tile(np.arange(1, LENGTH + 1), STEPS // LENGTH + 1)[:STEPS]
    seen = set()
    for robot in range(ROBOTS):
        for begins in range(0, STEPS - LENGTH, LENGTH):
            rows = slice(begins, begins + LENGTH)
            late = np.unique((now.observation_age)[robot, rows][4:])
            lag = np.unique((now.age - now.observation_age)[robot, rows])
            assert len(late) == len(lag) == 1
            assert low[robot] <= late[0] <= high[robot]
            assert low[robot] // 2 <= lag[0] <= high[robot] // 2
            acted = now.truth[robot, rows, 1]  # the action of step t is t + 1, and 0 before the first has arrived
            np.testing.assert_array_equal(acted, np.maximum(time[rows] - lag[0], 0))
            np.testing.assert_array_equal(now.obs[robot, rows, 0], np.maximum(time[rows] - late[0], 0))
            seen.add((robot, late[0]))
            told = first.age[robot] if begins == 0 else after.age[robot, begins - 1]
            assert told == lag[0], "the first observation of an episode has its delay of the actions already"
    assert len(seen) > ROBOTS, "the delay differs between episodes"
    assert after.terminated.sum() == ROBOTS * (STEPS // LENGTH), "what ended is told beside what begins"
    np.testing.assert_array_equal(after.terminated, now.terminated)
    np.testing.assert_array_equal(after.reward, now.reward)


def test_raw_ages_are_the_travel_times() -> None:
    """Under `raw` an observation's age is what was just drawn: neighbours and robots differ."""
    _, (now, _) = jax.device_get(play(as_batched("uniform:0:3@raw")))
    ages = now.observation_age.reshape(-1)
    assert set(ages.tolist()) == {0, 1, 2, 3}
    assert len({tuple(row) for row in now.observation_age.tolist()}) == ROBOTS


def test_a_termination_on_its_way() -> None:
    """The reward of step t is t, 3 steps late; the last ones arrive with the end, 3 steps after it."""
    delay = as_batched("reward=3")
    idle, no = jnp.zeros(1), jnp.zeros((), bool)
    episode, _ = start(delay, jax.random.key(0), jnp.zeros(1), idle)
    rewards, ends = [], []
    for t in range(1, 8):
        episode, _ = act(delay, episode, jnp.ones(1))
        given = (jnp.array([float(t)]), jnp.array(float(t)), jnp.array(t == 4), no)
        episode, shown = arrive(delay, episode, *given)
        rewards.append(float(shown.reward))
        ends.append(bool(shown.terminated))
    assert rewards == [0, 0, 0, 1, 2, 3, 4]
    assert ends == [False] * 6 + [True]
    assert float(shown.truth[0]) == 4, "what the simulator gives after the end does not count"


def test_numbers_larger_than_the_rings_are_cut() -> None:
    delay = as_batched("uniform:1:3")
    longer = replace(delay.observation, law=delay.observation.law._replace(steps=jnp.array([9, 9, 9])))
    _, (now, _) = jax.device_get(play(replace(delay, observation=longer)))
    assert now.observation_age.max() == 3
    np.testing.assert_array_equal(now.obs[..., 0], now.truth[..., 0] - now.observation_age)


@pytest.mark.parametrize("make", [jax.random.key, jax.random.PRNGKey])
def test_both_kinds_of_keys(make: Any) -> None:
    """The next episode goes on with the key, so it is another one."""
    delay, idle = as_batched("episode:0:50"), jnp.zeros(1)
    episode, shown = start(delay, make(0), jnp.zeros(2), idle)
    again, first = restart(delay, episode, shown, jnp.array(True), jnp.ones(2))
    kept, same = restart(delay, episode, shown, jnp.array(False), jnp.ones(2))
    assert first.obs.tolist() == [1, 1]
    assert same.obs.tolist() == [0, 0]
    data = [np.asarray(jax.random.key_data(e.key)).tolist() for e in (episode, kept, again)]
    assert data[0] == data[1] != data[2]
