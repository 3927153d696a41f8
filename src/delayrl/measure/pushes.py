"""Roll-outs of one episode from one seed, and what differs in them after one action is another."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.spaces.utils import flatten
from numpy.typing import NDArray

Env = gym.Env[Any, Any]
Array = NDArray[Any]

STATES = ("MuJoCo's qpos and qvel", "env.unwrapped.state", 'info["truth"]')


@dataclass(frozen=True)
class Roll:
    """One roll-out of T steps: row t is what was there after t steps; `state` may have no columns."""

    obs: Array  # [T+1, C]
    state: Array  # [T+1, S]
    rest: Array  # [T+1, 3] reward, terminated, truncated
    state_from: str


@dataclass(frozen=True)
class Pushes:
    """All pushes k of one episode: at [k, t] whether it differs after push k, and -1 where one had ended before."""

    obs: Array  # int8 [K, T+1]
    state: Array
    rest: Array
    components: Array  # int [K, C] first difference, or -1
    echo: Array  # bool [K, C]
    state_from: str

    def channel(self, name: str) -> Array:
        """First difference of each push in obs, state or rest, or -1."""
        return first(getattr(self, name))


def push(env: Env, seed: int, scale: float, steps: int, count: int | None = None, base: Roll | None = None) -> Pushes:
    """One episode of at most `steps` steps, and again for each of its first `count` actions (default: all)."""
    low, high = _bounds(env)
    chosen = actions(env, seed, steps, scale)
    base = base or play(env, seed, chosen)
    signs = np.random.default_rng([seed, 3]).choice([-1.0, 1.0], chosen.shape)  # towards a random corner of the box
    length = len(base.obs)
    count = min(count or steps, length - 1)
    seen = {name: np.full((count, length), -1, np.int8) for name in ("obs", "state", "rest")}
    components = np.full((count, base.obs.shape[1]), -1)
    echo = np.zeros(components.shape, bool)
    for k in range(count):
        pushed = chosen.copy()
        pushed[k] = ((low + high) / 2 + scale * signs[k] * (high - low) / 2).astype(chosen.dtype)
        roll = play(env, seed, pushed[: length - 1])
        known = min(length, len(roll.obs))
        apart = differs(base.obs[:known], roll.obs[:known])
        components[k] = first(apart.T.astype(np.int8))
        echo[k] = _echo(components[k], base.obs, roll.obs, chosen[k], pushed[k])
        seen["obs"][k, :known] = (apart & ~echo[k]).any(1)
        seen["state"][k, :known] = differs(base.state[:known], roll.state[:known]).any(1)
        seen["rest"][k, :known] = differs(base.rest[:known], roll.rest[:known]).any(1)
    return Pushes(seen["obs"], seen["state"], seen["rest"], np.where(echo, -1, components), echo, base.state_from)


def play(env: Env, seed: int, chosen: Array) -> Roll:
    """Play these actions from this seed, to their end or that of the episode."""
    obs, info = env.reset(seed=seed)
    state, state_from = _state(env, info)
    observations, states, rest = [_flat(env, obs)], [state], [(0.0, False, False)]
    for action in chosen:
        obs, reward, terminated, truncated, info = env.step(action.copy())
        observations.append(_flat(env, obs))
        states.append(_state(env, info)[0])
        rest.append((float(reward), terminated, truncated))
        if terminated or truncated:
            break
    return Roll(np.array(observations), np.array(states), np.array(rest, float), state_from)


def actions(env: Env, seed: int, steps: int, scale: float) -> Array:
    """Small random actions around the middle of the box: it keeps still, and yet no action equals another."""
    low, high = _bounds(env)
    random = np.random.default_rng([seed, 2])
    spread = 0.1 * scale * random.uniform(-1, 1, (steps, *low.shape))
    return ((low + high) / 2 + spread * (high - low) / 2).astype(env.action_space.dtype)


def _flat(env: Env, obs: Any) -> Array:
    if isinstance(env.observation_space, Box):
        return np.array(obs).ravel()  # a copy: an environment may go on writing into what it has returned
    return np.array(flatten(env.observation_space, obs), float).ravel()


def _state(env: Env, info: dict[str, Any]) -> tuple[Array, str]:
    """The simulator's true state where it can be seen, else nothing."""
    data = getattr(env.unwrapped, "data", None)
    if hasattr(data, "qpos") and hasattr(data, "qvel"):
        return np.concatenate([np.array(data.qpos).ravel(), np.array(data.qvel).ravel()]), STATES[0]  # type: ignore[union-attr]
    for value, name in ((getattr(env.unwrapped, "state", None), STATES[1]), (info.get("truth"), STATES[2])):
        if isinstance(value, np.ndarray | tuple | list):
            try:
                return np.array(value, float).ravel(), name
            except (TypeError, ValueError):
                continue
    return np.zeros(0), ""


def _echo(first: Array, base: Array, roll: Array, action: Array, pushed: Array) -> Array:
    """Components whose first difference is the action itself: an observation that contains past actions."""
    column = np.arange(len(first))
    before, after = base[first, column][:, None], roll[first, column][:, None]
    near = np.isclose(before, action.ravel(), rtol=1e-6, atol=0) & np.isclose(after, pushed.ravel(), rtol=1e-6, atol=0)
    return (first > 0) & near.any(1)


def differs(one: Array, two: Array) -> Array:
    """Elementwise, to the last bit."""
    return (one != two) & ~((one != one) & (two != two))  # NaN equals NaN


def first(seen: Array) -> Array:
    """Index of the first 1 in each row, or -1."""
    return np.where((seen == 1).any(1), (seen == 1).argmax(1), -1)


def _bounds(env: Env) -> tuple[Array, Array]:
    """Bounds of the actions; where there are none, ±1."""
    space = env.action_space
    assert isinstance(space, Box)
    low, high = space.low.astype(float), space.high.astype(float)
    bounded = (np.abs(low) < 1e6) & (np.abs(high) < 1e6)
    return np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
