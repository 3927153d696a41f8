"""Roll-outs of one episode from one seed, and what differs in them after one action is changed."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.spaces.utils import flatten
from numpy.typing import NDArray

Env = gym.Env[Any, Any]
Array = NDArray[Any]


@dataclass(frozen=True)
class Rollout:
    """One roll-out of T steps. Row t is what was there after t steps."""

    obs: Array  # [T+1, C]
    state: Array  # [T+1, S]; S = 0 if the state is hidden
    rest: Array  # [T+1, 3]: reward, terminated, truncated
    state_from: str


@dataclass(frozen=True)
class Pushes:
    """The effects of all pushes in one episode. Push k changes the action of step k.

    At [k, t], `obs`, `state` and `rest` say whether step t differs after push k; -1 if a roll-out ended before.
    """

    obs: Array  # int8 [K, T+1]
    state: Array  # int8 [K, T+1]
    rest: Array  # int8 [K, T+1]
    components: Array  # int [K, C]: step of the first difference, or -1
    echo: Array  # bool [K, C]: whether the component repeats the action
    state_from: str

    def channel(self, name: str) -> Array:
        """Return the step of the first difference of each push in obs, state or rest, [K]; -1 if there is none."""
        return first(getattr(self, name))

    def delays(self, name: str) -> Array:
        """Return the steps from each push to the first difference, [K]; negative if there is none."""
        return self.channel(name) - 1 - np.arange(len(self.obs))


def push(
    env: Env, seed: int, scale: float, steps: int, count: int | None = None, base: Rollout | None = None
) -> Pushes:
    """Play an episode of at most `steps` steps, and again with each of its first `count` actions changed (None: all).

    `scale` is the size of a push relative to the range of the actions; `base` is the episode, if it has been played.
    """
    low, high = _bounds(env)
    chosen = actions(env, seed, steps, scale)
    base = base or play(env, seed, chosen)
    signs = np.random.default_rng([seed, 3]).choice([-1.0, 1.0], chosen.shape)  # towards a random corner of the box
    length = len(base.obs)
    count = min(count or steps, length - 1)
    effect = {name: np.full((count, length), -1, np.int8) for name in ("obs", "state", "rest")}
    components = np.full((count, base.obs.shape[1]), -1)
    echo, seen = np.zeros(components.shape, bool), []
    for k in range(count):
        pushed = chosen.copy()
        pushed[k] = ((low + high) / 2 + scale * signs[k] * (high - low) / 2).astype(chosen.dtype)
        roll = play(env, seed, pushed[: length - 1])
        played = min(length, len(roll.obs))
        different = differs(base.obs[:played], roll.obs[:played])
        components[k] = first(different.T.astype(np.int8))
        echo[k] = _echo(components[k], base.obs, roll.obs, chosen[k], pushed[k])
        seen.append(different)
        effect["state"][k, :played] = differs(base.state[:played], roll.state[:played]).any(1)
        effect["rest"][k, :played] = differs(base.rest[:played], roll.rest[:played]).any(1)
    repeats = repeating(echo)
    for k, different in enumerate(seen):
        effect["obs"][k, : len(different)] = (different & ~(repeats | echo[k])).any(1)
    return Pushes(**effect, components=np.where(repeats | echo, -1, components), echo=echo, state_from=base.state_from)


def repeating(echo: Array) -> Array:
    """Return which components repeat the actions of several pushes, [C], such as an error that is made from the action.

    A position that starts at 0 may be the first action by chance. If no component were left, none counts.
    """
    repeats = echo.sum(0) > 1
    return repeats & ~repeats.all()


def play(env: Env, seed: int, chosen: Array) -> Rollout:
    """Play actions, [T, A], from a seed, until they or the episode end."""
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
    return Rollout(np.array(observations), np.array(states), np.array(rest, float), state_from)


def actions(env: Env, seed: int, steps: int, scale: float) -> Array:
    """Sample small actions around the middle of the box, [T, A]: little happens, yet all actions differ."""
    low, high = _bounds(env)
    random = np.random.default_rng([seed, 2])
    spread = 0.1 * scale * random.uniform(-1, 1, (steps, *low.shape))
    return ((low + high) / 2 + spread * (high - low) / 2).astype(env.action_space.dtype)


def _flat(env: Env, obs: Any) -> Array:
    if isinstance(env.observation_space, Box):
        return np.array(obs).ravel()  # a copy, because an environment may reuse the array
    return np.array(flatten(env.observation_space, obs), float).ravel()


def _state(env: Env, info: dict[str, Any]) -> tuple[Array, str]:
    """Return the simulator's true state and where it was read; an empty array and "" if it is hidden."""
    data = getattr(env.unwrapped, "data", None)
    if hasattr(data, "qpos") and hasattr(data, "qvel"):
        return np.concatenate([np.ravel(data.qpos), np.ravel(data.qvel)]), "MuJoCo's qpos and qvel"  # type: ignore[union-attr]
    state = getattr(env.unwrapped, "state", None)
    for value, name in ((state, "env.unwrapped.state"), (info.get("truth"), 'info["truth"]')):
        if isinstance(value, np.ndarray | tuple | list):
            try:
                return np.array(value, float).ravel(), name
            except (TypeError, ValueError):
                continue
    return np.zeros(0), ""


def _echo(first: Array, base: Array, roll: Array, action: Array, pushed: Array) -> Array:
    """Return which components first differ by the action itself, [C]: the observation contains past actions."""
    column = np.arange(len(first))
    before, after = base[first, column][:, None], roll[first, column][:, None]
    near = np.isclose(before, action.ravel(), rtol=1e-6, atol=0) & np.isclose(after, pushed.ravel(), rtol=1e-6, atol=0)
    return (first > 0) & near.any(1)


def differs(a: Array, b: Array) -> Array:
    """Compare exactly, element by element; NaN equals NaN."""
    return (a != b) & ~((a != a) & (b != b))


def first(effect: Array) -> Array:
    """Return the index of the first 1 in each row, or -1."""
    return np.where((effect == 1).any(1), (effect == 1).argmax(1), -1)


def _bounds(env: Env) -> tuple[Array, Array]:
    """Return the bounds of the actions, [A] each; ±1 where one is missing, moved into the space."""
    space: Any = env.action_space
    low, high = space.low.astype(float), space.high.astype(float)
    has_low, has_high = np.abs(low) < 1e6, np.abs(high) < 1e6
    moved = np.maximum(np.minimum(np.where(has_high, high - 2, -1.0), -1.0), np.where(has_low, low, -np.inf))
    both = has_low & has_high
    return np.where(both, low, moved), np.where(both, high, moved + 2)
