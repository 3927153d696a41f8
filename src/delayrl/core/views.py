"""Views: what a network sees, taken from a window of the undelayed trajectory or, when acting, from the wrapper."""

from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from delayrl.core.types import Seen, Spec, Window
from delayrl.errors import DelayRLError

Sees = Literal["current", "delayed", "augmented"]
"""The true state s_t; only the last observation that arrived, s_{t-d}; or x_t, which adds the actions since."""


def view(
    window: Window, ahead: int | Int[Array, ""] = 0, delay: int | None = None, age: Int[Array, ""] | None = None
) -> Seen:
    """Return what is visible at step t + `ahead` of the window.

    Args:
        window: one window, without a batch axis.
        ahead: steps after t.
        delay: longest age of the observation: None for the window's Δ (x_t as the actor saw it), 0 for the true state,
            a value between for AD-SAC's auxiliary state. Static, because it is the length of `actions`.
        age: age of the observation; None for the age that the wrapper showed.

    Returns:
        obs [S], age [], actions [delay, A] (oldest first, zeros after the first `age`).

    Raises:
        DelayRLError: a window that does not reach there.
    """
    reach, delay = window.obs.shape[0] - window.delay, window.delay if delay is None else delay
    if isinstance(ahead, int) and not 0 <= ahead < reach:
        raise DelayRLError(f"windows reach 0 to {reach - 1} steps after t (the agent's `ahead`); got ahead={ahead}")
    now = window.delay + jnp.asarray(ahead, jnp.int32)
    age = jnp.minimum(window.age[now] if age is None else age, delay)
    slots = jnp.arange(delay)
    actions = window.action[jnp.minimum(now - age + slots, now)]
    return Seen(window.obs[now - age], age, jnp.where((slots < age)[:, None], actions, 0.0))


def network_input(seen: Seen, sees: Sees) -> Float[Array, " input"]:
    """Return `seen` as one vector: the observation alone [S], or with actions and age / Δ [S + Δ·A + 1].

    The age distinguishes an empty slot at the start of an episode from a zero action. Without a delay, x_t is s_t.
    Under a delay `current` is the truth. Raises DelayRLError where it is not shown, and for a view that there is not.
    """
    if sees not in get_args(Sees):
        raise DelayRLError(f"a network sees {', '.join(get_args(Sees))}; got {sees!r}")
    delay = seen.actions.shape[-2]
    state = seen.truth if sees == "current" and delay > 0 else seen.obs
    if state is None:
        raise DelayRLError("the current state is not known under a delay: act on `augmented` or `delayed`")
    if sees != "augmented" or delay == 0:
        return state
    return jnp.concatenate([seen.obs, seen.actions.reshape(-1), (seen.age / delay)[None]])


def look(window: Window, sees: Sees, ahead: int | Int[Array, ""] = 0) -> Float[Array, " input"]:
    """Return the `network_input` at step t + `ahead` for a network that `sees` this view."""
    return network_input(view(window, ahead, 0 if sees == "current" else None), sees)


def input_size(spec: Spec, sees: Sees) -> int:
    """Return the length of `network_input`."""
    if sees != "augmented" or spec.delay == 0:
        return spec.obs_size
    return spec.obs_size + spec.delay * spec.action_size + 1


def seen_now(obs: NDArray[Any], info: dict[str, Any], delay: int, *, privileged: bool) -> Seen:
    """Convert what the wrapper shows (with actions scaled to [-1, 1]) to arrays of the shapes that `delay` gives."""
    actions = np.zeros((delay, *info["actions"].shape[1:]), np.float32)
    actions[: info["age"]] = info["actions"][: info["age"]]
    truth = np.asarray(info["truth"], np.float32) if privileged else None
    return Seen(np.asarray(obs, np.float32), np.int32(info["age"]), actions, truth)  # type: ignore[arg-type]
