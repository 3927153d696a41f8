"""The augmented state as one vector, so that any library can train on a delayed task.

The vector has the size S + H·A + 1. It holds the shown observation, the actions of the history (oldest first, zeros
where there are none yet) and the age divided by the history's length H. A random delay of the actions adds one number:
the age of the action that led to the observation, divided by the longest delay. Without a delay the observation stays
as it is.
"""

from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from delayrl.delays import Delay
from delayrl.errors import DelayRLError
from delayrl.wrappers.layers import check_spaces, layers_of, name_of
from delayrl.wrappers.single import Info, find_delayed
from delayrl.wrappers.vector import DelayedVector


def _augmented_space(observations: Any, actions: Any, history: int, delay: Delay) -> Box:
    if not history:
        return observations
    # a slot without an action holds zeros, which the action's own bounds need not contain
    low, high = np.minimum(actions.low, 0), np.maximum(actions.high, 0)
    numbers = 1 if delay.action.constant else 2
    # integer observations become float, because integers would truncate actions and age
    dtype = np.promote_types(observations.dtype, np.float32)
    return Box(
        np.concatenate([observations.low, np.tile(low, history), np.zeros(numbers)]).astype(dtype),
        np.concatenate([observations.high, np.tile(high, history), np.ones(numbers)]).astype(dtype),
        dtype=dtype.type,
    )


def _augment(obs: NDArray[Any], info: Info, history: int, delay: Delay, dtype: Any) -> NDArray[Any]:
    """Join observation, actions and ages to vectors, with or without a leading axis for environments."""
    if not history:
        return obs
    size, actions = obs.shape[-1], info["actions"]
    end = size + history * actions.shape[-1]
    vector = np.empty((*obs.shape[:-1], end + (1 if delay.action.constant else 2)), dtype)
    vector[..., :size] = obs
    vector[..., size:end] = actions.reshape(*obs.shape[:-1], -1)
    vector[..., end] = info["age"] / history
    if not delay.action.constant:
        vector[..., end + 1] = info["applied"] / delay.action.maximum
    return vector


class AugmentedObservation(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Show the augmented state of an environment wrapped by `Delayed` as one vector, [S + H·A + 1].

    Other wrappers may stand between the two (`NormalizeObservation`, `TimeLimit`). Their observations are shown; the
    actions of the history are those that reached `Delayed`, in its units. If rewards are delayed, `TimeLimit` goes
    inside `Delayed`.

    Attributes:
        augment: makes the vector of an observation of `Delayed` and its `info`.

    Args:
        env: an environment with a `Delayed` in it. Its observations are still flat vectors, and its `info` is that of
            `Delayed`.

    Raises:
        DelayRLError: no `Delayed` in it, another `AugmentedObservation`, observations that are not flat, or a
            `TimeLimit` around delayed rewards, which it would lose.
    """

    if TYPE_CHECKING:  # as checked below
        observation_space: Box  # type: ignore[override]
        action_space: Box  # type: ignore[override]

    def __init__(self, env: gym.Env[NDArray[Any], NDArray[Any]]) -> None:
        delayed = find_delayed(env)
        if delayed is None:
            raise DelayRLError("AugmentedObservation goes around Delayed: wrap the task in Delayed first")
        for layer in takewhile(lambda layer: layer is not delayed, layers_of(env)):
            if isinstance(layer, AugmentedObservation):
                raise DelayRLError("the observations are augmented already: use one AugmentedObservation")
            if isinstance(layer, TimeLimit) and delayed.delay.reward.maximum:
                line = "TimeLimit around Delayed loses the rewards and the termination on their way"
                raise DelayRLError(f"{line}: put TimeLimit inside Delayed, Delayed(TimeLimit(task, 100), delay)")
        check_spaces(name_of(env), env.observation_space, delayed.action_space)
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        history, delay = delayed.history, delayed.delay
        self.observation_space = _augmented_space(env.observation_space, delayed.action_space, history, delay)
        self.augment = partial(_augment, history=history, delay=delay, dtype=self.observation_space.dtype)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self.augment(obs, info), info

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Issue an action. Returns the augmented state of the next step."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self.augment(obs, info), reward, terminated, truncated, info


class AugmentedVectorObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """Show the augmented states of N environments wrapped by `DelayedVector`, [N, S + H·A + 1].

    A row is laid out as `AugmentedObservation` does it. `final_obs` in the infos holds augmented states too.

    Args:
        env: the `DelayedVector`.

    Raises:
        DelayRLError: it is another environment.
    """

    def __init__(self, env: DelayedVector) -> None:
        if not isinstance(env, DelayedVector):
            raise DelayRLError("AugmentedVectorObservation goes around DelayedVector: wrap the tasks in it first")
        super().__init__(env)
        single = _augmented_space(env.single_observation_space, env.single_action_space, env.history, env.delay)
        self.single_observation_space = single
        self.observation_space = batch_space(single, env.num_envs)
        self._augment = partial(_augment, history=env.history, delay=env.delay, dtype=single.dtype)

    def reset(self, *, seed: Any = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start all episodes."""
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._augment(obs, infos), infos

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """Issue an action in every environment."""
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        last = infos.get("final_info", {})
        if ended := list(np.flatnonzero(last.get("_age", []))):
            final_obs = np.full(self.num_envs, None, object)
            for i in ended:
                own = {name: last[name][i] for name in ("age", "actions", "applied") if name in last}
                final_obs[i] = self._augment(infos["final_obs"][i], own)
            infos["final_obs"] = final_obs
        return self._augment(obs, infos), rewards, terminated, truncated, infos
