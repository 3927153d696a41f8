"""The policies of the demonstration: a trained one, one that ignores the delay, and a model that needs no training."""

from pathlib import Path
from typing import Any

import numpy as np

from delayrl.deploy import ControlPolicy
from delayrl.errors import DelayRLError


class RunPolicy:
    """The policy of a run folder, computed by JAX.

    Raises:
        DelayRLError: not a run folder, or no good checkpoint.
    """

    def __init__(self, path: Path) -> None:
        import delayrl
        from delayrl import Run
        from delayrl.envs.making import make
        from delayrl.wrappers.layers import seconds_of

        self._policy = delayrl.load(path)
        spec = self._policy.spec
        self.obs_size, self.action_size, self.max_age = spec.obs_size, spec.action_size, spec.delay
        self.low, self.high = self._policy.low, self._policy.high
        self.min_age = self._policy.min_age
        env = make(Run(path).config["env"])
        self.dt = seconds_of(env)
        env.close()

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        """Return the action in the task's units."""
        return self._policy.act(obs, {"age": age, "actions": actions}).astype(np.float32)


class Predictor:
    """Predict the present state with a linear model and the actions since, and apply an optimal gain (LQR).

    The model is linearised from the simulator around the upright pole. The pole stands only if age and history are
    right.
    """

    def __init__(self, env: str = "InvertedPendulum-v5", max_age: int = 5) -> None:
        import gymnasium as gym

        task = gym.make(env, disable_env_checker=True)
        plant: Any = task.unwrapped
        task.reset(seed=0)
        self.obs_size, self.action_size = task.observation_space.shape[0], task.action_space.shape[0]
        self.low, self.high, self.dt, self.max_age = task.action_space.low, task.action_space.high, plant.dt, max_age

        def step(state: np.ndarray, action: np.ndarray) -> np.ndarray:
            plant.set_state(state[: plant.model.nq], state[plant.model.nq :])
            return np.asarray(plant.step(action)[0], float)

        size, small = self.obs_size, 1e-5
        rest, still = np.zeros(size), np.zeros(self.action_size)
        nudges = [(small * unit, still) for unit in np.eye(size)]
        nudges += [(rest, small * unit) for unit in np.eye(self.action_size)]
        columns = [(step(rest + s, a) - step(rest - s, -a)) / (2 * small) for s, a in nudges]
        self._A, self._B = np.array(columns[:size]).T, np.array(columns[size:]).T
        task.close()
        P = np.eye(size)
        for _ in range(2000):  # iterate the Riccati equation
            gain = np.linalg.solve(0.1 * np.eye(self.action_size) + self._B.T @ P @ self._B, self._B.T @ P @ self._A)
            P = np.eye(size) + self._A.T @ P @ (self._A - self._B @ gain)
        self._gain = gain

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        """Predict the present state, then act."""
        for action in actions[:age]:
            obs = self._A @ obs + self._B @ action
        return np.clip(-self._gain @ obs, self.low, self.high).astype(np.float32)


class Blind:
    """A policy that takes every observation for the current one. Of VDPO, this is the reference policy."""

    def __init__(self, policy: ControlPolicy) -> None:
        self._policy = policy
        self.obs_size, self.action_size, self.dt = policy.obs_size, policy.action_size, policy.dt
        self.low, self.high, self.max_age = policy.low, policy.high, 64
        self._nothing = np.zeros((policy.max_age, policy.action_size), np.float32)

    def __call__(self, obs: np.ndarray, actions: np.ndarray, age: int) -> np.ndarray:
        """Act as if the age were 0."""
        return self._policy(obs, self._nothing, 0)


def load(source: str, blind: bool = False) -> ControlPolicy:
    """Load a policy from a run folder or a bundle (`delayrl export`), or make the "predictor".

    Raises:
        DelayRLError: the source is none of these.
    """
    policy: ControlPolicy
    if source == "predictor":
        policy = Predictor()
    elif (Path(source) / "checkpoints").is_dir():
        policy = RunPolicy(Path(source))
    else:
        try:
            from delayrl.deploy import load_bundle
        except ImportError:
            raise DelayRLError(f"{source} is not a run folder: train one with `delayrl train vdpo …`") from None
        policy = load_bundle(source)
    return Blind(policy) if blind else policy
