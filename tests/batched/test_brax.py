"""The wrapper for brax shows what `Delayed` shows, under brax's own wrappers for training."""

import importlib
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from delayrl import DelayRLError
from delayrl.batched import as_batched, per_episode
from delayrl.wrappers import AugmentedObservation, Delayed


def test_without_brax_it_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "brax", None)
    monkeypatch.setitem(sys.modules, "brax.envs.base", None)  # where it has been imported before
    monkeypatch.delitem(sys.modules, "delayrl.batched.brax", raising=False)
    with pytest.raises(DelayRLError, match=r"^this needs brax: pip install 'delayrl\[brax\]'$"):
        importlib.import_module("delayrl.batched.brax")


try:
    from brax.envs.base import Env, State
    from brax.envs.wrappers import training

    from delayrl.batched.brax import DelayWrapper, wrap
except ModuleNotFoundError:
    Env = object
needs_brax = pytest.mark.skipif(Env is object, reason="brax is not installed")
ROBOTS, STEPS = 3, 18


class Journal(Env):
    """Observation [t, the action that acted, gain · place], with a random place. It ends after `length` steps."""

    def __init__(self, length: int = 7, named: bool = False):
        self.length, self.named, self.sys = length, named, jnp.array(1.0)
        self.dt = 0.04

    def reset(self, rng: jax.Array) -> Any:
        place = jax.random.uniform(rng)
        return State({"time": jnp.zeros(()), "place": place}, self._obs(0.0, 0.0, place), jnp.zeros(()), jnp.zeros(()))

    def step(self, state: Any, action: jax.Array) -> Any:
        time, place = state.pipeline_state["time"] + 1, state.pipeline_state["place"]
        obs = self._obs(time, action[0], place)
        done = (time >= self.length).astype(jnp.float32)
        return state.replace(pipeline_state={"time": time, "place": place}, obs=obs, reward=time, done=done)

    def _obs(self, time: Any, acted: Any, place: Any) -> Any:
        obs = jnp.stack([jnp.asarray(time, jnp.float32), jnp.asarray(acted, jnp.float32), self.sys * place])
        return {"time": obs[:1], "joints": obs[1:], "map": jnp.ones((2, 2)) * time} if self.named else obs

    observation_size, action_size, backend = 3, 1, "none"


class Same(gym.Env):
    """The same task for `Delayed`."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, length: int, place: float):
        self.length, self.place, self.time = length, place, 0

    def reset(self, *, seed: int | None = None, options: Any = None):
        super().reset(seed=seed)
        self.time = 0
        return np.array([0, 0, self.place], np.float32), {}

    def step(self, action):
        self.time += 1
        return np.array([self.time, action[0], self.place], np.float32), self.time, self.time >= self.length, False, {}


def play(env: Any, steps: int = STEPS) -> tuple[Any, Any, np.ndarray]:
    """Reset and play in one program. Returns the first state, all others [T, N], and the actions."""
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, ROBOTS, 1)).astype(np.float32)

    def step(state: Any, action: jax.Array) -> Any:
        state = env.step(state, action)
        return state, state

    def program(keys: jax.Array) -> Any:
        first = env.reset(keys)
        return first, jax.lax.scan(step, first, actions)[1]

    first, states = jax.jit(program)(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    return jax.device_get(first), jax.device_get(states), actions


@needs_brax
@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("2+action=1", 9),
        ("3", 5),
        ("action=2", 9),
        ("0", 9),
        ("uniform:2:2@fifo+action=episode:1:1", 9),
        ("episode:3:3@raw+action=uniform:2:2", 9),
        ("choice:3=1+action=recorded:1,1,@raw", 5),
    ],
)
def test_equals_delayed_over_several_episodes(text: str, limit: int) -> None:
    """Observation, vector, truth, reward and end, with episodes that end (7) and that are cut (5).

    The random laws here draw the same travel time every time.
    """
    first, states, actions = play(wrap(Journal(), text, episode_length=limit))
    for robot in range(ROBOTS):
        place = float(first.obs["privileged_state"][robot, 2])
        env = AugmentedObservation(Delayed(TimeLimit(Same(7, place), limit), text))
        vector, _ = env.reset(seed=0)
        np.testing.assert_array_equal(first.obs["state"][robot], vector)
        for t in range(STEPS):
            vector, reward, terminated, truncated, info = env.step(actions[t, robot])
            assert bool(states.done[t, robot]) == (terminated or truncated)
            assert bool(states.info["truncation"][t, robot]) == truncated, "PPO bootstraps there"
            assert states.reward[t, robot] == reward
            if terminated or truncated:
                vector, info = env.reset()
            np.testing.assert_array_equal(states.obs["state"][t, robot], vector)
            np.testing.assert_array_equal(states.obs["privileged_state"][t, robot], info["truth"])


@needs_brax
def test_the_task_has_the_random_numbers_it_has_without_a_delay() -> None:
    ours, states, actions = play(wrap(Journal(), "uniform:0:3", episode_length=9))
    plain, without, same = play(training.wrap(Journal(), episode_length=9))
    np.testing.assert_array_equal(actions, same)
    np.testing.assert_array_equal(ours.obs["privileged_state"], plain.obs)
    np.testing.assert_array_equal(states.obs["privileged_state"], without.obs)
    np.testing.assert_array_equal(states.done, without.done)
    late = states.obs["privileged_state"][..., 0] - states.obs["state"][..., 0]
    assert set(np.unique(late)) == {0, 1, 2, 3}
    assert len({tuple(row) for row in late.T}) == ROBOTS, "robots draw their own delays"


@needs_brax
def test_ranges_per_robot_and_randomised_dynamics() -> None:
    """Each robot's delay is in its own range; brax's domain randomisation reaches the task inside."""
    gains = jnp.array([1.0, 2.0, 3.0])
    delay = replace(as_batched("0"), observation=per_episode([0, 1, 3], [0, 2, 3]))
    env = wrap(Journal(), delay, episode_length=6, randomization_fn=lambda sys: (gains, 0))
    assert env.observation_size == {"state": (3 + 3 * 1 + 1,), "privileged_state": (3,)}
    first, states, _ = play(env, 60)
    late = states.obs["privileged_state"][..., 0] - states.obs["state"][..., 0]
    ages = np.rint(states.obs["state"][..., -1] * 3)
    np.testing.assert_array_equal(late, ages)
    assert [int(row.max()) for row in late.T] == [0, 2, 3]
    full = late.reshape(10, 6, ROBOTS)[:, 2:5]  # by episode: once every robot's delay has passed
    np.testing.assert_array_equal(full.min(1), full.max(1))
    assert [sorted(set(row.tolist())) for row in full[:, 0].T] == [[0], [1, 2], [2, 3][1:]]
    plain = jax.vmap(lambda key: Journal().reset(key).obs[2])(jax.random.split(jax.random.PRNGKey(0), ROBOTS))
    np.testing.assert_allclose(first.obs["privileged_state"][:, 2], plain * gains, rtol=1e-6)


@needs_brax
def test_named_entries_are_delayed_and_others_are_not() -> None:
    env = wrap(Journal(named=True), "2", episode_length=9, keys=("joints", "time"))
    first, states, actions = play(env, 5)
    assert {name: entry.shape for name, entry in first.obs.items()} == {
        "privileged_state": (ROBOTS, 3),
        "time": (ROBOTS, 1),
        "joints": (ROBOTS, 2 + 2 * 1 + 1),
        "map": (ROBOTS, 2, 2),
    }
    assert env.observation_size == {name: entry.shape[1:] for name, entry in first.obs.items()}
    np.testing.assert_array_equal(states.obs["map"][:, 0, 0, 0], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(states.obs["time"][:, 0, 0], [0, 0, 1, 2, 3])
    np.testing.assert_array_equal(states.obs["joints"][2:, 0, 0], actions[:3, 0, 0])
    np.testing.assert_array_equal(states.obs["joints"][2:, 0, 2], actions[1:4, 0, 0])
    np.testing.assert_array_equal(states.obs["joints"][2:, 0, 3], actions[2:5, 0, 0])
    np.testing.assert_array_equal(states.obs["joints"][:, 0, 4], [0.5, 1, 1, 1, 1])


@needs_brax
def test_a_blind_agent_sees_the_observation_alone() -> None:
    first, states, _ = play(wrap(Journal(), "2+action=1", episode_length=9, augment=False), 4)
    assert first.obs["state"].shape == (ROBOTS, 3)
    assert wrap(Journal(), "2", augment=False).observation_size == {"state": (3,), "privileged_state": (3,)}
    np.testing.assert_array_equal(states.obs["state"][:, 0, 0], [0, 0, 1, 2])


@needs_brax
def test_action_repeat_counts_decisions() -> None:
    """Two steps of the task for each decision: 80 ms of 40 ms steps are one decision."""
    env = wrap(Journal(), "80ms", episode_length=20, action_repeat=2)
    assert env.delay.maximum == 1
    assert wrap(Journal(), "80ms", step_seconds=0.02).delay.maximum == 4
    assert DelayWrapper(training.wrap(Journal(), 9), "80ms", step_seconds=0.04).delay.maximum == 2
    _, states, _ = play(env, 3)
    np.testing.assert_array_equal(states.obs["state"][:, 0, 0], [0, 2, 4])
    np.testing.assert_array_equal(states.obs["privileged_state"][:, 0, 0], [2, 4, 6])


@needs_brax
def test_bad_input() -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), ROBOTS)
    named = partial(wrap, Journal(named=True), "1")
    for make, words in (
        (lambda: training.wrap(wrap(Journal(), "1"), 9).reset(keys), "around the wrapper for training, not inside"),
        (lambda: wrap(Journal(), "1").reset(keys[0]), "around the wrapper for training, not inside"),
        (lambda: DelayWrapper(training.VmapWrapper(Journal()), "1").reset(keys), "that reset themselves"),
        (lambda: DelayWrapper(Journal(), "1").reset(keys), "around the wrapper for training"),
        (lambda: wrap(training.wrap(Journal(), 9), "1"), "not wrapped for training, .*; got EpisodeWrapper"),
        (lambda: wrap(wrap(Journal(), "1"), "1"), "not wrapped for training, .*; got DelayWrapper"),
        (
            lambda: DelayWrapper(wrap(Journal(named=True), "1", keys=("time",)), "1", keys=("joints",)).reset(keys),
            "already",
        ),
        (lambda: DelayWrapper(training.wrap(Journal(), 9), "80ms"), "the wrappers take step_seconds"),
        (lambda: wrap(Journal(), "1", keys=("time", "time")), "keys are different entries"),
        (lambda: wrap(Journal(), "1", keys=("privileged_state",)), "not privileged_state, which is the truth"),
        (lambda: named(keys="legs").reset(keys), r"got keys=\('legs',\)"),
        (lambda: wrap(Journal(), "9", episode_length=8), r"9 steps is longer than an episode \(8 decisions\)"),
        (lambda: wrap(Journal(), "5", episode_length=8, action_repeat=2), "longer than an episode .4 decisions"),
        (lambda: wrap(Journal(), "6", episode_length=9, action_repeat=2), "longer than an episode .5 decisions"),
        (lambda: wrap(Journal(), "1+reward=2"), "cannot wait for one: delay observations and actions"),
        (lambda: wrap(gym.make("Pendulum-v1"), "1"), "brax's interface .*; got"),
        (lambda: named().reset(keys), r"a dict of joints, map, time; got keys=\(\)"),
        (lambda: named(keys=("legs",)).reset(keys), r"a dict of joints, map, time; got keys=\('legs',\)"),
        (lambda: named(keys=("map",)).reset(keys), r"flat vectors; map has the shape \(2, 2\)"),
        (lambda: wrap(Journal(), "1", keys=("time",)).reset(keys), "here it is one array"),
        (
            lambda: wrap(Journal(), replace(as_batched("0"), observation=per_episode([1, 2], [2, 2]))).reset(keys),
            "laws for 2 environments; there are 3",
        ),
    ):
        with pytest.raises(DelayRLError, match=words):
            make()


@needs_brax
@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_ppo_of_brax_trains_with_a_privileged_value(monkeypatch) -> None:
    from brax.training.agents.ppo import networks, train

    def replicated(tree: Any, devices: list) -> Any:  # brax 0.14 calls what JAX 0.10 has removed
        return jax.tree.map(lambda array: jnp.stack([array] * len(devices)), tree)

    monkeypatch.setattr(jax, "device_put_replicated", replicated, raising=False)
    factory = partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=(8,),
        value_hidden_layer_sizes=(8,),
        value_obs_key="privileged_state",
    )
    _, (_, policy, value), metrics = train.train(
        Journal(),
        num_timesteps=64,
        episode_length=8,
        num_envs=4,
        batch_size=4,
        num_minibatches=1,
        unroll_length=4,
        num_eval_envs=4,
        num_evals=2,
        network_factory=factory,
        wrap_env_fn=partial(wrap, delay="episode:1:2+action=1"),
        normalize_observations=True,
    )
    assert policy["params"]["hidden_0"]["kernel"].shape == (3 + 3 * 1 + 1, 8)
    assert value["params"]["hidden_0"]["kernel"].shape == (3, 8)
    assert metrics["eval/episode_reward"] == sum(range(1, 8)), "the task pays t at step t, for 7 steps"


@needs_brax
@pytest.mark.filterwarnings("ignore")
def test_a_task_of_mujoco_playground() -> None:
    """Its own wrapper for training goes inside, and its truth is what it shows without a delay."""
    registry = pytest.importorskip("mujoco_playground").registry
    task = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    env = wrap(task, "2+action=1", episode_length=4)
    first, states, _ = play(env, 6)
    assert first.obs["state"].shape == (ROBOTS, 5 + 3 + 1)
    assert env.observation_size == {"state": (5 + 3 + 1,), "privileged_state": (5,)}
    np.testing.assert_array_equal(states.obs["state"][2:3, :, :5], states.obs["privileged_state"][:1])
    assert states.done[:, 0].tolist() == [0, 0, 0, 1, 0, 0]
    np.testing.assert_array_equal(states.obs["state"][3:, :, :5], states.obs["privileged_state"][[3, 3, 3]])
    np.testing.assert_allclose(states.obs["state"][3, :, 5:], [[0, 0, 0, 1 / 3]] * ROBOTS, rtol=1e-6)


@needs_brax
def test_a_task_built_on_mujoco_playground_gets_its_wrapper() -> None:
    """Wherever the class of the task itself stands."""
    from delayrl.batched.brax import _training_wrap

    playground = pytest.importorskip("mujoco_playground")
    cartpole = type(playground.registry.load("CartpoleBalance", config_overrides={"impl": "jax"}))
    mine = object.__new__(type("Mine", (cartpole,), {"__module__": "mine"}))
    assert _training_wrap(mine) is playground.wrapper.wrap_for_brax_training
    assert _training_wrap(Journal()) is training.wrap
