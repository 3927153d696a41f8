"""What a network sees: the one function that makes it from a window of the true trajectory, and its twin for acting."""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from delayrl.core.types import Seen, Spec, Window

Sees = Literal["current", "delayed", "augmented"]
"""The true state s_t; the last observation that arrived, s_{t-d}, alone; or x_t, with the actions since."""


def view(
    window: Window,
    ahead: int | Int[Array, ""] = 0,
    delay: int | None = None,
    age: Int[Array, ""] | None = None,
) -> Seen:
    """What was known at step t + `ahead` of the window.

    Args:
        window: one window, without batch axis.
        ahead: steps after t.
        delay: observations are at most so old: None for the window's own Δ (x_t as the actor saw it), 0 for the true
            state, a number between for AD-SAC's auxiliary state. Static: the length of `actions`.
        age: of the observation to look at; None for the age that the wrapper showed.

    Returns:
        obs [S], age [], actions [delay, A] (oldest first, zeros after the first `age`).
    """
    delay = window.delay if delay is None else delay
    now = window.delay + jnp.asarray(ahead, jnp.int32)
    age = jnp.minimum(window.age[now] if age is None else age, delay)
    slots = jnp.arange(delay)
    actions = window.action[jnp.minimum(now - age + slots, now)]
    return Seen(window.obs[now - age], age, jnp.where((slots < age)[:, None], actions, 0.0))


def network_input(seen: Seen, sees: Sees) -> Float[Array, " input"]:
    """What is seen as one vector: the observation alone, or with the actions and age / Δ: [S] or [S + Δ·A + 1].

    The age tells an empty slot at the start of an episode from an action of zero. Without a delay x_t is s_t.
    """
    delay = seen.actions.shape[-2]
    if sees != "augmented" or delay == 0:
        return seen.obs
    return jnp.concatenate([seen.obs, seen.actions.reshape(-1), (seen.age / delay)[None]])


def look(window: Window, sees: Sees, ahead: int | Int[Array, ""] = 0) -> Float[Array, " input"]:
    """`network_input` of the `view` that someone has who `sees` so, at step t + `ahead`."""
    return network_input(view(window, ahead, 0 if sees == "current" else None), sees)


def input_size(spec: Spec, sees: Sees) -> int:
    """The length of `network_input`."""
    if sees != "augmented" or spec.delay == 0:
        return spec.obs_size
    return spec.obs_size + spec.delay * spec.action_size + 1


def seen_now(obs: NDArray[Any], info: dict[str, Any], delay: int, *, privileged: bool) -> Seen:
    """What the wrapper shows (with actions scaled to [-1, 1]), as arrays of the shapes that `delay` gives."""
    actions = np.zeros((delay, *info["actions"].shape[1:]), np.float32)
    actions[: info["age"]] = info["actions"][: info["age"]]
    truth = np.asarray(info["truth"], np.float32) if privileged else None
    return Seen(np.asarray(obs, np.float32), np.int32(info["age"]), actions, truth)  # type: ignore[arg-type]
