"""Policies of other libraries: any function in the `Controller`, and an MLP of the augmented state in a bundle.

A function is code, so it runs in the program that has it. A bundle is data, so it takes the weights of an MLP with
ReLU and a tanh at the end, the actor of most libraries' SAC and TD3.
"""

import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import (
    Autoreset,
    HumanRendering,
    NormalizeReward,
    OrderEnforcing,
    PassiveEnvChecker,
    RecordEpisodeStatistics,
    RecordVideo,
    RenderCollection,
    TimeLimit,
)
from numpy.typing import ArrayLike, NDArray

from delayrl.deploy.backends.network import Network
from delayrl.deploy.files import check_target, write_files
from delayrl.deploy.packing import check_same, pack, space_json
from delayrl.errors import DelayRLError
from delayrl.run.arrays import inner_range
from delayrl.wrappers import AugmentedObservation, Delayed
from delayrl.wrappers.layers import layers_of, name_of
from delayrl.wrappers.single import find_delayed

HARMLESS: tuple[Any, ...] = (
    gym.Wrapper,
    gym.RewardWrapper,
    AugmentedObservation,
    Autoreset,
    NormalizeReward,
    TimeLimit,
    OrderEnforcing,
    PassiveEnvChecker,
    RecordEpisodeStatistics,
    RecordVideo,
    RenderCollection,
    HumanRendering,
)
"""Classes whose `step` and `reset` pass observations and actions on as they are."""
MONITOR = "stable_baselines3.common.monitor.Monitor"
"""One more of them, by its name."""


@dataclass(frozen=True, eq=False)
class AdaptedPolicy:
    """A function as a `ControlPolicy`, with the sizes of the environment that it was made for."""

    function: Callable[..., ArrayLike]  # of the observation [S], the actions since [Δ, A] and the age
    obs_size: int  # S
    action_size: int  # A
    low: NDArray[Any]  # the range of the actions, [A]
    high: NDArray[Any]
    max_age: int  # Δ, in steps
    dt: float | None  # seconds a step; None if unknown
    action_delay: int  # the part of the ages that actions take to act
    idle: NDArray[Any]  # what acts before the first command, [A]
    min_age: int  # the shortest age that it learned, in steps, after the start of an episode

    def __call__(self, obs: NDArray[Any], actions: NDArray[np.float32], age: int) -> NDArray[np.float32]:
        """Return the function's action, [A]."""
        return np.asarray(self.function(obs, actions, age), np.float32)


def adapt(function: Callable[..., ArrayLike], env: gym.Env[Any, Any]) -> AdaptedPolicy:
    """Make a policy for the `Controller` of a function that was trained, or written, for an environment.

    Args:
        function: maps what `env` shows to an action [A] in its units. With an `AugmentedObservation` that is the
            vector, [S + Δ·A + 1]; with `Delayed` alone the observation [S], the actions since [Δ, A] and the age.
        env: the environment, with its `Delayed`; it is not played.

    Raises:
        DelayRLError: no `Delayed` in it, a wrapper outside of it that may change observations or actions, or a random
            delay of the actions.
    """
    if not callable(function):
        line = "adapt takes a function of what the environment shows, and the environment"
        raise DelayRLError(f"{line}; got {type(function).__name__}")
    delayed, augmented = _layers_of(env)
    history, delay = delayed.history, delayed.delay

    def of_vector(obs: NDArray[Any], actions: NDArray[np.float32], age: int) -> ArrayLike:
        assert augmented is not None
        vector = augmented.augment(obs, {"actions": actions, "age": age})
        return function(np.asarray(vector, augmented.observation_space.dtype))

    actions = delayed.action_space
    return AdaptedPolicy(
        function if augmented is None else of_vector,
        delayed.observation_space.shape[0],
        actions.shape[0],
        *inner_range(actions.low, actions.high),
        history,
        delayed.step_seconds,
        delay.action.maximum,
        delayed.idle,
        delay.minimum,
    )


def _layers_of(env: Any) -> tuple[Delayed, AugmentedObservation | None]:
    delayed, augmented = find_delayed(env), None
    if delayed is None:
        raise DelayRLError("adapt takes the environment that the policy was trained in, with its Delayed: got none")
    if not delayed.delay.action.constant:
        hint = "train with a constant one, or with @wait behind its law"
        raise DelayRLError(f"a controller has one delay of the actions; got {delayed.delay.action}: {hint}")
    for layer in takewhile(lambda layer: layer is not delayed, layers_of(env)):
        if isinstance(layer, AugmentedObservation):
            augmented = layer
        if not _keeps_all(layer):
            name = type(layer).__name__
            raise DelayRLError(f"{name} stands outside Delayed, where no controller runs it: put it inside")
    return delayed, augmented


def _keeps_all(layer: Any) -> bool:
    """Whether a wrapper is known to pass observations and actions on as they are."""
    owners = [next(kind for kind in type(layer).__mro__ if name in vars(kind)) for name in ("step", "reset")]
    known = (kind in HARMLESS or f"{kind.__module__}.{kind.__qualname__}" == MONITOR for kind in owners)
    return all(known)


def export_layers(
    layers: Sequence[tuple[ArrayLike, ArrayLike]],
    function: Callable[..., ArrayLike],
    env: gym.Env[Any, Any],
    out: str | Path,
    *,
    agent: str = "mlp",
    force: bool = False,
) -> dict[str, Any]:
    """Write an MLP that was trained on `AugmentedObservation` as a bundle; return the bundle's metadata.

    Args:
        layers: the weights [inputs, outputs] and biases of each layer. The MLP has ReLU between them and a tanh at the
            end, and -1 .. 1 is the range of the actions.
        function: the policy, as for `adapt`. The layers are compared with it on 200 random inputs, of ages 0 to Δ.
        env: the environment that it was trained in, with an `AugmentedObservation`.
        out: a new or empty folder.
        agent: the name that the bundle gives.
        force: replace a bundle in `out`.

    Raises:
        DelayRLError: as `adapt`; a range of actions that is not symmetric; layers that do not compute the function; a
            folder that holds something else.
    """
    check_target(Path(out), force=force)
    policy, (delayed, augmented) = adapt(function, env), _layers_of(env)
    if augmented is None:
        raise DelayRLError("a bundle takes a policy that was trained on AugmentedObservation")
    if not np.allclose(policy.low, -policy.high, rtol=1e-6):
        raise DelayRLError("a bundle takes actions with a range around 0: train with RescaleAction inside Delayed")
    pairs = _numbers(layers)
    first, size, delta = pairs[0][0], policy.obs_size, policy.max_age
    (shown,) = augmented.observation_space.shape
    if len(first) != shown:
        raise DelayRLError(f"the first layer must take the vector of size {shown}; its weights are {first.shape}")
    scaled = first[size : size + delta * policy.action_size]
    scaled *= np.tile(policy.high, delta)[:, None]  # a bundle's network reads actions in -1 .. 1
    arrays = {
        f"head.{i}.{name}": np.ascontiguousarray(array, np.float32)
        for i, pair in enumerate(pairs)
        for name, array in zip("wb", pair, strict=True)
    }
    hidden = tuple(len(b) for _, b in pairs[:-1])
    low, high = tuple(policy.low.tolist()), tuple(policy.high.tolist())
    kind = "augmented" if delta else "observation"
    network = Network(size, policy.action_size, delta, low, high, kind, hidden)
    network.check(arrays)
    what = "with ReLU between them and a tanh at the end"
    check_same(network, arrays, policy, f"the layers, {what}, do not compute the policy")
    metadata = {
        "agent": agent,
        "env": name_of(env),
        "delay": delayed.delay.acted().label(),
        "ages": [policy.min_age, delta],
        "action_delay": policy.action_delay,
        "idle": [float(x) for x in policy.idle],
        "dt": policy.dt,
        "observation": space_json(delayed.observation_space),
        "action": space_json(delayed.action_space),
        "exported_with": {"python": platform.python_version(), "numpy": np.__version__, "gymnasium": gym.__version__},
    }
    write_files(Path(out), pack(network, arrays, metadata), force=force)
    return metadata


def _numbers(layers: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return copies of weights and biases as arrays. Raises DelayRLError if there are none, or they are of no layer."""
    try:
        pairs = [(np.array(w, np.float64), np.array(b, np.float64)) for w, b in layers]
    except (TypeError, ValueError):
        pairs = []
    if not pairs or any((w.ndim, b.ndim) != (2, 1) for w, b in pairs):
        raise DelayRLError("layers are pairs of numbers: weights [inputs, outputs] and biases [outputs], first to last")
    return pairs


def stable_baselines_layers(model: Any) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return the layers of the actor of a SAC, TD3 or DDPG of Stable-Baselines3, for `export_layers`.

    Raises:
        DelayRLError: a model without an actor of its own, such as PPO, whose policy no bundle can hold; one whose
            observations VecNormalize normalises.
    """
    normalising = getattr(model, "get_vec_normalize_env", lambda: None)()
    if normalising is not None and normalising.norm_obs:  # the comparison with `predict` cannot see it
        ways = "train with VecNormalize(norm_obs=False), or give adapt a function that calls its normalize_obs"
        raise DelayRLError(f"VecNormalize normalises this model's observations, which no bundle does: {ways}")
    actor = getattr(getattr(model, "policy", None), "actor", None)
    if actor is None:
        name = type(model).__name__
        raise DelayRLError(f"{name} has no actor that a bundle can hold; SAC, TD3 and DDPG do. Use adapt in Python")
    state = {name: tensor.detach().cpu().numpy() for name, tensor in actor.state_dict().items()}
    names = [name.removesuffix(".weight") for name in state if name.endswith(".weight")]
    return [(state[f"{n}.weight"].T, state[f"{n}.bias"]) for n in names if not n.startswith("log_std")]
