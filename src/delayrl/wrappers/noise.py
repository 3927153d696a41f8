"""The wrapper that executes random actions now and then, which makes the transitions of any task random."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from delayrl.errors import DelayRLError
from delayrl.wrappers.layers import check_spaces, layers_of, name_of
from delayrl.wrappers.single import Info, find_delayed


class NoisyActions(gym.Wrapper[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], RecordConstructorArgs):
    """Execute a uniformly random action instead of the agent's with a given probability.

    This is how AD-SAC's paper makes its tasks stochastic (Wu et al., ICML 2024; probability 0.1). The reward is that
    of the action that is executed, which the wrapper adds to `info`:
      executed  (float [A])  the action that the environment took, in the wrapper's own units

    The wrapper goes around the task and inside `Delayed`, which then shows the agent's own actions in its history. So
    does the replay, because an agent does not know which of its actions were replaced.

    Args:
        env: any Gymnasium environment with flat Box observations and actions.
        probability: of a random action at each step, from 0 to 1.

    Raises:
        DelayRLError: a probability outside [0, 1], an environment that is delayed or noisy already, unsuitable spaces.
    """

    def __init__(self, env: gym.Env[NDArray[Any], NDArray[Any]], probability: float) -> None:
        if not isinstance(probability, int | float | np.number) or not 0 <= probability <= 1:
            raise DelayRLError(f"the probability of a random action must be from 0 to 1; got {probability!r}")
        if find_delayed(env):
            raise DelayRLError("NoisyActions goes inside Delayed: Delayed(NoisyActions(task, 0.1), delay)")
        if any(isinstance(layer, NoisyActions) for layer in layers_of(env)):  # both would draw the same random numbers
            raise DelayRLError(f"{name_of(env)} executes random actions already: give it one NoisyActions")
        check_spaces(name_of(env), env.observation_space, env.action_space)
        assert isinstance(env.action_space, Box)
        RecordConstructorArgs.__init__(self, probability=probability)
        gym.Wrapper.__init__(self, env)
        self.probability, self._box = probability, env.action_space
        self._random = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[NDArray[Any], Info]:
        """Start an episode. The seed fixes its random actions too."""
        if seed is not None:
            self.draw_from(seed)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: NDArray[Any]) -> tuple[NDArray[Any], SupportsFloat, bool, bool, Info]:
        """Step with the action, or with a random one."""
        if self._random.random() < self.probability:
            action = self._random.uniform(self._box.low, self._box.high).astype(self._box.dtype)
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "executed": np.array(action)}

    def draw_from(self, seed: int) -> None:
        """Take the random actions of the current episode from another seed than the task's. Call it after `reset`."""
        self._random = np.random.default_rng([seed, 2])  # travel times are drawn from [seed, 1]
