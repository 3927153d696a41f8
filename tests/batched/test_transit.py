"""Given the same travel times, the compiled functions show exactly what `Delayed` shows."""

from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st

from delayrl.batched import augmented
from delayrl.batched.delay import BatchedChannel, BatchedDelay
from delayrl.batched.transit import Shown, begin, issue, receive, renew, show
from delayrl.delays import (
    Channel,
    Choice,
    Constant,
    Delay,
    PerEpisode,
    Recorded,
    gamma,
    gilbert_elliott,
    poisson,
    random_walk,
    uniform,
)
from delayrl.delays.own import own_law
from delayrl.wrappers import AugmentedObservation, Delayed
from own_laws import Burst

STEPS = 36
"""Played in all, over several episodes."""
CHANNELS = [
    (("newest", 3), ("wait", 0), ("wait", 0)),
    (("fifo", 5), ("wait", 0), ("wait", 0)),
    (("raw", 3), ("fifo", 2), ("wait", 0)),
    (("wait", 0), ("newest", 3), ("newest", 4)),
    (("wait", 3), ("raw", 2), ("fifo", 4)),
    (("newest", 3), ("newest", 2), ("newest", 4)),
    (("fifo", 3), ("wait", 2), ("wait", 4)),
    (("raw", 3), ("fifo", 3), ("fifo", 4)),
    (("wait", 0), ("wait", 0), ("newest", 4)),
    (("wait", 0), ("wait", 0), ("wait", 0)),
]
"""Rules and longest delays of observations, actions and rewards: each is compiled once."""
CHANCE = st.floats(0.01, 0.99)


class Journal(gym.Env):
    """Observation [t, the action that acted]; the reward of step t is 2**t, so that each sum shows its parts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    spec = None

    def __init__(self, ends: list[tuple[int, bool]]):
        self.ends, self.episode, self.time = ends, -1, 0

    def reset(self, *, seed: int | None = None, options: Any = None):
        super().reset(seed=seed)
        self.time, self.episode = 0, self.episode + 1
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.time += 1
        length, truncates = self.ends[self.episode]
        assert self.time <= length, "stepped after its end"
        end = self.time == length
        obs = np.array([self.time, action[0]], np.float32)
        return obs, 2.0 ** (self.time - 1), end and not truncates, end and truncates, {}


class Recorder:
    """A law that keeps what it drew last."""

    def __init__(self, law: Any):
        self.law, self.last = law, law.maximum

    def draw(self, state: int, random: np.random.Generator) -> tuple[int, int]:
        self.last, state = self.law.draw(state, random)
        return self.last, state


@st.composite
def laws(draw: st.DrawFn, longest: int) -> Any:
    """Laws of every kind with this maximum."""
    if not longest:
        return Constant(0)
    weights = np.array([*draw(st.lists(st.integers(0, 9), min_size=longest, max_size=longest)), 1])
    choice = Choice(tuple(range(longest + 1)), tuple((weights / weights.sum()).tolist()))
    times = draw(st.lists(st.integers(0, longest), max_size=20))
    kinds = (
        choice,
        uniform(draw(st.integers(0, longest)), longest),
        poisson(draw(st.floats(0.2, 5)), longest),
        gamma(draw(st.floats(0.5, 4)), draw(st.floats(0.2, 3)), longest),
        gilbert_elliott(draw(st.integers(0, longest)), longest, draw(CHANCE), draw(CHANCE)),
        random_walk(longest, draw(CHANCE)),
        Recorded((*times, longest)),
        PerEpisode(choice),
        own_law(Burst(draw(CHANCE), longest, draw(st.integers(1, 3)))),
    )
    return draw(st.sampled_from(kinds))


@st.composite
def delays(draw: st.DrawFn) -> tuple[Delay, BatchedDelay]:
    """A delay, and its rules and sizes alone."""
    shapes = draw(st.sampled_from(CHANNELS))
    delay = Delay(*(Channel(draw(laws(longest)), rule) for rule, longest in shapes))
    return delay, BatchedDelay(*(BatchedChannel(None, rule, longest) for rule, longest in shapes))


def shown(obs: Any, info: dict, reward: float = 0.0, terminated: bool = False, truncated: bool = False) -> dict:
    names = ("age", "actions", "mask", "truth", "observation_age", "applied")
    own = {name: np.array(info[name]) for name in names if name in info}
    return {"obs": obs, "reward": reward, "terminated": terminated, "truncated": truncated, **own}


def play(delay: Delay, ends: list, limit: int, actions: np.ndarray, seed: int) -> tuple[list, list, list, list]:
    """Play `Delayed`. Returns what it shows at each step, at each start, the travel times, and the lags."""
    env = Delayed(TimeLimit(Journal(ends), limit), delay)
    transit = env._transit
    queues = (transit._observations, transit._actions, transit._rewards)
    for queue in queues:
        queue._law = Recorder(queue._law)
    steps, travel = [], []
    starts = [shown(*env.reset(seed=seed))]
    lags = [transit.lag]
    for action in actions:
        obs, reward, terminated, truncated, info = env.step(action)
        steps.append(shown(obs, info, reward, terminated, truncated))
        travel.append([queue._law.last for queue in queues])
        if terminated or truncated:
            starts.append(shown(*env.reset()))
            lags.append(transit.lag)
    return steps, starts, travel, lags


@jax.jit
def play_batched(delay: BatchedDelay, lengths, truncates, limit, actions, travel, lags) -> Any:
    """Play the same in one program. Returns what is shown at each step, and after the reset at its end."""
    idle, no = jnp.zeros(actions.shape[1]), jnp.array(False)

    def fresh(episode: Any) -> Any:
        return begin(delay, jnp.zeros(2), idle, lags[episode])

    def step(carry: Any, given: Any) -> Any:
        transit, episode, time = carry
        action, times = given
        travel, action_travel, reward_travel = times
        transit, applied = issue(delay, transit, action, action_travel)
        obs, reward = jnp.stack([time + 1.0, applied[0]]), 2.0**time
        end = time + 1 == lengths[episode]
        truncated = (end & truncates[episode]) | (time + 1 >= limit)
        transit, now = receive(delay, transit, obs, reward, end & ~truncates[episode], truncated, travel, reward_travel)
        done = now.terminated | now.truncated
        transit = renew(transit, fresh(episode + done), done)
        first = show(delay, transit, jnp.zeros(()), no, no)
        return (transit, episode + done, jnp.where(done, 0, time + 1)), (now, first)

    start = fresh(0)
    return show(delay, start, jnp.zeros(()), no, no), jax.lax.scan(step, (start, 0, 0), (actions, travel))[1]


def assert_same(ours: Any, theirs: dict, *, without: tuple[str, ...] = ()) -> None:
    for name in theirs.keys() - set(without):
        np.testing.assert_array_equal(np.asarray(getattr(ours, name)), theirs[name], err_msg=name)


@settings(max_examples=300, deadline=None)
@given(
    delays(),
    st.lists(st.tuples(st.integers(1, 14), st.booleans()), min_size=STEPS, max_size=STEPS),
    st.integers(8, 14),
    st.integers(0, 99),
)
def test_shows_what_delayed_shows(both: tuple[Delay, BatchedDelay], ends: list, limit: int, seed: int) -> None:
    """Everything at every step and at every start, over laws, rules, channels and ends of episodes."""
    delay, batched = both
    actions = np.random.default_rng(seed).uniform(-1, 1, (STEPS, 1)).astype(np.float32)
    steps, starts, travel, lags = play(delay, ends, limit, actions, seed)
    first, (now, after) = play_batched(
        batched,
        np.array([length for length, _ in ends]),
        np.array([truncates for _, truncates in ends]),
        limit,
        actions,
        tuple(np.array(travel, np.int32).T),
        np.array([*lags, *[0] * (STEPS + 1 - len(lags))], np.int32),
    )
    now, after = (jax.tree.map(np.asarray, shown) for shown in (now, after))
    assert_same(first, starts[0])
    rest = iter(starts[1:])
    for t, theirs in enumerate(steps):
        assert_same(jax.tree.map(lambda array, t=t: array[t], now), theirs)
        if theirs["terminated"] or theirs["truncated"]:
            assert_same(jax.tree.map(lambda array, t=t: array[t], after), next(rest))


@pytest.mark.parametrize("text", ["0", "3", "2+action=1", "3+action=uniform:0:2"])
def test_the_vector_of_augmented_observation(text: str) -> None:
    """The same layout and scaling, from what `Delayed` showed."""
    delayed = Delayed(TimeLimit(Journal([(9, False)]), 9), text)
    env = AugmentedObservation(delayed)
    channels = (delayed.delay.observation, delayed.delay.action)
    batched = BatchedDelay(*(BatchedChannel(None, "wait" if c.constant else c.rule, c.maximum) for c in channels))
    vector, info = env.reset(seed=3)
    for action in np.float32([[0.5], [-0.25], [1], [0.125], [0.75]]):
        late = {"observation_age": info["age"], "applied": 0} | info
        names = ("age", "actions", "mask", "truth", "observation_age", "applied")
        seen = Shown(jnp.array(vector[:2]), *(jnp.array(late[name]) for name in names), *[jnp.zeros(())] * 3)
        np.testing.assert_allclose(augmented(batched, seen), vector, rtol=1e-7)
        vector, *_, info = env.step(action)
