"""Policies of other libraries in the controller and in bundles."""

import runpy
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import (
    Autoreset,
    ClipReward,
    FrameStackObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    RescaleAction,
    TimeLimit,
)

from delayrl.deploy import Controller, adapt, export_layers, load_bundle, stable_baselines_layers
from delayrl.deploy.hub import card
from delayrl.errors import DelayRLError
from delayrl.wrappers import AugmentedObservation, Delayed

Layers = list[tuple[np.ndarray, np.ndarray]]


def task(delay: Any, name: str = "Reacher-v5", history: int | None = None) -> gym.Env:
    return AugmentedObservation(Delayed(gym.make(name), delay, history))


def random_layers(env: gym.Env, seed: int = 0) -> Layers:
    """Layers 16 and 8 wide, for the vector of an environment."""
    random = np.random.default_rng(seed)
    sizes = [env.observation_space.shape[0], 16, 8, env.action_space.shape[0]]
    return [
        (random.normal(size=(a, b)).astype(np.float32) * 0.5, random.normal(size=b) * 0.1) for a, b in pairwise(sizes)
    ]


def mlp(layers: Layers, high: np.ndarray) -> Any:
    """The function that the layers stand for: ReLU between them, a tanh at the end, times the range."""

    def act(x: np.ndarray) -> np.ndarray:
        for w, b in layers[:-1]:
            x = np.maximum(x @ w + b, 0)
        return high * np.tanh(x @ layers[-1][0] + layers[-1][1])

    return act


class Spy:
    """A policy that keeps the history that it was shown last."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def __getattr__(self, name: str) -> Any:
        return getattr(self.policy, name)

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        self.shown = actions.copy()
        return self.policy(obs, actions, age)


@pytest.mark.parametrize("delay", ["0", "3", "uniform:0:4", "episode:1:3", "uniform:0:2+action=2"])
def test_the_function_sees_what_it_saw_in_training(delay: str) -> None:
    """The controller's calls hand it the environment's own vectors, number for number."""
    env = task(delay, "Pendulum-v1", history=6)
    seen = []

    def act(vector: np.ndarray) -> np.ndarray:
        seen.append(vector)
        return np.array([2 * np.sin(vector.sum())])

    controller = Controller(adapt(act, RecordEpisodeStatistics(env)))
    for seed in range(3):
        x, info = env.reset(seed=seed)
        controller.reset()
        truths = [info["truth"]]
        for step in range(30):
            made = step - info["age"] + controller.action_delay
            controller.observe(truths[made], made, step)
            action = controller.act(step)
            assert seen[-1].dtype == x.dtype
            np.testing.assert_array_equal(seen[-1], x)
            x, _, _, _, info = env.step(action)
            truths.append(info["truth"])


def test_a_function_of_the_three() -> None:
    """With `Delayed` alone it is given observation, actions and age."""
    env = Delayed(gym.make("Pendulum-v1"), 2)
    controller = Controller(adapt(lambda obs, actions, age: obs[:1] + actions[:age].sum() + age, env))
    controller.observe([0.25, 0, 0], 0)
    assert [float(controller.act()[0]) for _ in range(3)] == [0.25, 1.5, 2.0]  # 0.25, + 0.25 + 1, clipped
    assert (controller.policy.dt, controller.policy.max_age, controller.min_age) == (0.05, 2, 2)
    other = Delayed(gym.make("Pendulum-v1"), "200ms", step_seconds=0.1)
    assert (adapt(np.sin, other).dt, adapt(np.sin, other).max_age) == (0.1, 2)


@pytest.mark.parametrize(
    ("name", "delay"), [("Reacher-v5", "uniform:0:4"), ("Pendulum-v1", "1+action=2"), ("Pendulum-v1", 0)]
)
def test_layers_in_a_bundle(name: str, delay: Any, tmp_path: Path) -> None:
    """The bundle gives the function's actions at every age; Pendulum's range is -2 .. 2."""
    env = task(delay, name)
    layers = random_layers(env)
    act = mlp(layers, env.action_space.high)
    metadata = export_layers(layers, act, env, tmp_path / "bundle", agent="SAC")
    assert (metadata["env"], metadata["delay"]) == (name, delay)
    policy, random = adapt(act, env), np.random.default_rng(1)
    for backend in ("numpy", "onnx"):
        bundle = load_bundle(tmp_path / "bundle", backend)
        assert (bundle.max_age, bundle.action_delay, bundle.dt) == (policy.max_age, policy.action_delay, policy.dt)
        assert bundle.min_age == policy.min_age == env.get_wrapper_attr("delay").minimum
        for age in range(bundle.max_age + 1):
            obs = random.normal(size=bundle.obs_size).astype(np.float32)
            actions = np.zeros((bundle.max_age, bundle.action_size), np.float32)
            actions[:age] = random.uniform(bundle.low, bundle.high, (age, bundle.action_size))
            np.testing.assert_allclose(bundle(obs, actions, age), policy(obs, actions, age), rtol=0, atol=1e-5)
    assert f"SAC on {name}" in card(bundle.metadata, "me/arm")


def test_the_idle_action_comes_along(tmp_path: Path) -> None:
    """The controller's history begins as the environment's did; a later period without a command holds the last one."""
    idle = np.array([0.5, -9.0])  # is clipped to -1
    env = AugmentedObservation(Delayed(gym.make("Reacher-v5"), "1+action=2", idle=idle))
    layers = random_layers(env)
    act = mlp(layers, env.action_space.high)
    export_layers(layers, act, env, tmp_path / "bundle")
    _, info = env.reset(seed=0)
    for policy in (adapt(act, env), load_bundle(tmp_path / "bundle")):
        np.testing.assert_array_equal(policy.idle, info["actions"][0])
        for given, first in ((None, policy.idle), ([0.25, 0.25], [0.25, 0.25])):
            spy = Spy(policy)
            controller = Controller(spy, idle=given)
            controller.observe(info["truth"], 0)
            action = controller.act(0)
            np.testing.assert_array_equal(spy.shown, [first, first, [0, 0]])
            controller.observe(info["truth"], 1, now=2)
            controller.act(2)  # the command of step 1 was missed
            np.testing.assert_array_equal(spy.shown, [first, action, action if given is None else given])


def test_layers_that_are_not_the_policy(tmp_path: Path) -> None:
    env = task(2)
    layers, other = random_layers(env), random_layers(env, 1)
    act = mlp(layers, env.action_space.high)
    mixed = [layers[0], layers[1], other[2]]
    wide = [(w.astype(float), b) for w, b in random_layers(task(3))]
    for wrong, words in (
        (mixed, "do not compute the policy"),
        (wide, "must take the vector"),
        (layers[1:], "must take"),
    ):
        with pytest.raises(DelayRLError, match=words):
            export_layers(wrong, act, env, tmp_path / "bundle")
    with pytest.raises(DelayRLError, match="do not compute"):  # a tanh inside, as PPO has
        export_layers(layers, lambda x: np.tanh(np.tanh(x @ layers[0][0])[:2]), env, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_what_cannot_be_adapted(tmp_path: Path) -> None:
    def act(*_: Any) -> np.ndarray:
        return np.zeros(2)

    delayed = Delayed(gym.make("Reacher-v5"), 2)
    for env, words in (
        (gym.make("Reacher-v5"), "with its Delayed: got none"),
        (AugmentedObservation(NormalizeObservation(delayed)), "NormalizeObservation stands outside Delayed"),
        (NormalizeObservation(AugmentedObservation(delayed)), "NormalizeObservation stands outside Delayed"),
        (RescaleAction(AugmentedObservation(delayed), np.float32(-1), np.float32(1)), "RescaleAction stands outside"),
        (FrameStackObservation(delayed, 2), "FrameStackObservation stands outside"),
        (task("1+action=uniform:0:2"), "one delay of the actions"),
    ):
        with pytest.raises(DelayRLError, match=words) as error:
            adapt(act, env)
        assert "\n" not in str(error.value)
    with pytest.raises(DelayRLError, match="adapt takes a function of what the environment shows"):
        adapt(delayed, act)  # type: ignore[arg-type]
    with pytest.raises(DelayRLError, match="trained on AugmentedObservation"):
        export_layers([], act, delayed, tmp_path / "bundle")
    lopsided = RescaleAction(gym.make("Reacher-v5"), np.float32(0), np.float32(1))
    with pytest.raises(DelayRLError, match="range around 0"):
        export_layers([], act, AugmentedObservation(Delayed(lopsided, 2)), tmp_path / "bundle")


class Repeat(gym.Wrapper):
    """Repeats actions and looks like the environment inside it."""

    def step(self, action: np.ndarray) -> Any:
        self.env.step(action)
        return self.env.step(action)


class Scaled(gym.Wrapper):
    """Scales the first observation."""

    def reset(self, **options: Any) -> Any:
        obs, info = self.env.reset(**options)
        return 2 * obs, info


class Again(TimeLimit):
    """Is no longer what it inherits from."""

    step = Repeat.step


def test_wrappers_outside_delayed() -> None:
    delayed = Delayed(gym.make("Pendulum-v1"), 2)
    for kind in (Repeat, Scaled, lambda env: Again(env, 10)):
        for env in (kind(AugmentedObservation(delayed)), AugmentedObservation(kind(delayed)), kind(delayed)):
            with pytest.raises(DelayRLError, match="stands outside Delayed, where no controller runs it: put"):
                adapt(np.sin, env)
    monitor = type("Monitor", (Repeat,), {"step": Repeat.step, "reset": Scaled.reset})
    with pytest.raises(DelayRLError, match="Monitor stands outside"):
        adapt(np.sin, monitor(delayed))
    monitor.__module__ = "stable_baselines3.common.monitor"
    limited = lambda env: TimeLimit(ClipReward(env, -1), 10)  # noqa: E731
    for kind in (monitor, Autoreset, RecordEpisodeStatistics, NormalizeReward, limited):
        assert adapt(np.sin, kind(AugmentedObservation(kind(delayed)))).max_age == 2


class Tensor:
    """Stands for a tensor of PyTorch."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def detach(self) -> "Tensor":
        return self

    cpu = detach

    def numpy(self) -> np.ndarray:
        return self.values


def test_the_actor_of_stable_baselines(tmp_path: Path) -> None:
    """Names as in its SAC; examples/stable_baselines_robot.py does it with the real one, in CI."""
    env = task("uniform:1:3")
    layers = random_layers(env)
    names = ["latent_pi.0", "latent_pi.2", "mu"]
    state = {f"{n}.weight": Tensor(w.T) for n, (w, _) in zip(names, layers, strict=True)}
    state |= {f"{n}.bias": Tensor(b) for n, (_, b) in zip(names, layers, strict=True)}
    state |= {"log_std.weight": Tensor(np.zeros((2, 8))), "log_std.bias": Tensor(np.zeros(2))}
    model = SimpleNamespace(policy=SimpleNamespace(actor=SimpleNamespace(state_dict=lambda: state)))
    found = stable_baselines_layers(model)
    export_layers(found, mlp(layers, env.action_space.high), env, tmp_path / "bundle")
    for (w, b), (wanted_w, wanted_b) in zip(found, layers, strict=True):
        np.testing.assert_array_equal(w, wanted_w)
        np.testing.assert_array_equal(b, wanted_b)
    model.get_vec_normalize_env = lambda: SimpleNamespace(norm_obs=False)
    assert len(stable_baselines_layers(model)) == len(layers)
    model.get_vec_normalize_env = lambda: SimpleNamespace(norm_obs=True)
    with pytest.raises(DelayRLError, match="VecNormalize normalises"):
        stable_baselines_layers(model)
    with pytest.raises(DelayRLError, match="has no actor"):
        stable_baselines_layers(SimpleNamespace(policy=SimpleNamespace(mlp_extractor=None)))


def test_the_example_with_delayed_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """examples/stable_baselines_robot.py on a stand-in for SAC."""
    example = Path(__file__).parents[2] / "examples" / "stable_baselines_robot.py"

    class Sac:
        def __init__(self, policy: str, env: gym.Env, **_: Any) -> None:
            self.layers, self.high = random_layers(env), env.action_space.high
            names = ["latent_pi.0", "latent_pi.2", "mu"]
            state = {f"{n}.weight": Tensor(w.T) for n, (w, _) in zip(names, self.layers, strict=True)}
            state |= {f"{n}.bias": Tensor(b) for n, (_, b) in zip(names, self.layers, strict=True)}
            self.policy = SimpleNamespace(actor=SimpleNamespace(state_dict=lambda: state))

        def learn(self, steps: int) -> None:
            pass

        def predict(self, vector: np.ndarray, deterministic: bool) -> tuple[np.ndarray, None]:
            return mlp(self.layers, self.high)(vector), None

    monkeypatch.setitem(sys.modules, "stable_baselines3", SimpleNamespace(SAC=Sac))
    words = ["--delay", "1+action=2", "--out", str(tmp_path / "bundle")]
    monkeypatch.setattr(sys, "argv", [str(example), *words])
    runpy.run_path(str(example), run_name="__main__")
    bundle = load_bundle(tmp_path / "bundle")
    assert [bundle.metadata[name] for name in ("agent", "env", "delay")] == ["SAC", "Pendulum-v1", "1+action=2"]
    assert (bundle.min_age, bundle.max_age, bundle.action_delay) == (3, 3, 2)
