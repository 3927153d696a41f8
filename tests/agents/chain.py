"""A noisy chain with continuous actions, on which the fixed points of the delayed methods can be told apart.

At home (state 0) the action a ∈ [-1, 1] costs `COST`·a and leads into the field with probability (1 + a)/2. There the
side is drawn anew at every step: on the left (1) the action earns -`PAY`·a, on the right (2) `PAY`·a. Each step leaves
the field with probability 1/4. Who sees the side earns much and should go; who sees it a step late can only guess.

With a delay of one step, x_t = (s_{t-1}, a_{t-1}) and everything that is averaged over is fixed by the dynamics: fixed
points do not depend on who collected the data. Policies are those of the agents, Gaussians before a tanh, so the best
one for a history is found numerically among them; a table over states and a grid of actions is a critic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gaussians import moment_match, precision_weighted
from jax.scipy.special import ndtri
from tabular import Array

COST, PAY, DISCOUNT, TEMPERATURE = 0.5, 3.0, 0.9, 0.5
STATES = 3
GRID = np.linspace(-1, 1, 17)
NOISE = ndtri((jnp.arange(64) + 0.5) / 64)  # quantiles of the normal distribution, equally likely


def transition(action: Array) -> Array:
    """Return P(s' | s, a) for actions of shape (N,), shape (3, N, 3)."""
    go = (1 + action) / 2
    home = np.stack([1 - go, go / 2, go / 2], axis=-1)
    field = np.broadcast_to([0.25, 0.375, 0.375], home.shape)
    return np.stack([home, field, field])


def reward(action: Array) -> Array:
    """Return R(s, a) for actions of shape (N,), shape (3, N)."""
    return np.stack([-COST * action, -PAY * action, PAY * action])


class Chain(gym.Env):
    """The chain, with the state as a one-hot observation."""

    observation_space = gym.spaces.Box(0, 1, (STATES,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self._state = int(self.np_random.integers(STATES))
        return self._obs(), {}

    def step(self, action: Any):
        taken = np.clip(np.asarray(action, np.float64), -1, 1)
        earned = float(reward(taken)[self._state, 0])
        self._state = int(self.np_random.choice(STATES, p=transition(taken)[self._state, 0]))
        return self._obs(), earned, False, False, {}

    def _obs(self) -> Any:
        return np.eye(STATES, dtype=np.float32)[self._state]


def register() -> None:
    if "delayrl/Chain-v0" not in gym.registry:
        gym.register("delayrl/Chain-v0", entry_point=Chain, max_episode_steps=50)


# ---- Exact solutions ---------------------------------------------------------------------------------------


class Policy(NamedTuple):
    """Gaussians before the tanh, for N histories or states: mean and log of the deviation, each (N,)."""

    mean: jax.Array
    log_std: jax.Array


def act(policy: Policy) -> tuple[jax.Array, jax.Array]:
    """Return equally likely actions of each Gaussian and their log-densities, (N, K)."""
    raw = policy.mean[:, None] + jnp.exp(policy.log_std)[:, None] * NOISE
    normal = -0.5 * NOISE**2 - policy.log_std[:, None] - 0.5 * jnp.log(2 * jnp.pi)
    return jnp.tanh(raw), normal - 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))


def soft_values(q: jax.Array, policy: Policy) -> jax.Array:
    """Return Q(a) - α log π(a) for equally likely actions, (N, K), with Q on the grid, (N, len(GRID))."""
    actions, log_prob = act(policy)
    return jax.vmap(lambda a, row: jnp.interp(a, GRID, row))(actions, q) - TEMPERATURE * log_prob


@jax.jit
def improve(q: jax.Array, policy: Policy) -> Policy:
    """Maximise the mean soft value of each row of Q by gradient steps from a policy."""
    adam = optax.adam(0.03)

    def step(carry: Any, _: None) -> Any:
        policy, opt_state = carry
        gradient = jax.grad(lambda policy: -soft_values(q, policy).mean(-1).sum())(policy)
        change, opt_state = adam.update(gradient, opt_state)
        return (optax.apply_updates(policy, change), opt_state), None

    (policy, _), _ = jax.lax.scan(step, (policy, adam.init(policy)), None, 100)
    return policy


def squashed(policy: Policy) -> tuple[jax.Array, jax.Array]:
    """Return mean and deviation of the actions of each Gaussian, (N,)."""
    actions, _ = act(policy)
    return actions.mean(-1), actions.std(-1)


def pulled(belief: jax.Array, weight: float, distance: str) -> Callable[[jax.Array, Policy, Policy], Policy]:
    """Return any-age's improvement of the late policy: half the soft value, and the pull to the policy on s_t.

    `moments` is lifting's distance, `kl` KL(late‖current); both averaged over the belief, (X, S).
    """

    def apart(late: Policy, current: Policy) -> jax.Array:
        if distance == "moments":
            pairs = zip(squashed(late), squashed(current), strict=True)
            return sum((one[:, None] - other) ** 2 for one, other in pairs)  # type: ignore[return-value]
        scale = jnp.exp(late.log_std)[:, None] / jnp.exp(current.log_std)
        shift = (late.mean[:, None] - current.mean) / jnp.exp(current.log_std)
        return -jnp.log(scale) + 0.5 * (scale**2 + shift**2 - 1)

    @jax.jit
    def improve_late(q: jax.Array, late: Policy, current: Policy) -> Policy:
        adam = optax.adam(0.03)

        def loss(late: Policy) -> jax.Array:
            pull = (belief * apart(late, current)).sum(-1)
            return (weight * pull - 0.5 * soft_values(belief @ q, late).mean(-1)).sum()

        def step(carry: Any, _: None) -> Any:
            late, opt_state = carry
            change, opt_state = adam.update(jax.grad(loss)(late), opt_state)
            return (optax.apply_updates(late, change), opt_state), None

        (late, _), _ = jax.lax.scan(step, (late, adam.init(late)), None, 100)
        return late

    return improve_late


@dataclass(frozen=True)
class Solution:
    """A fixed point.

    Attributes:
        q: Q(s, a) on the grid of actions, (3, len(GRID)).
        current: The policy on s_t, 3 Gaussians.
        late: The policy on x_t = (s_{t-1}, a_{t-1}), a_{t-1} on the grid; 3 · len(GRID) Gaussians.
    """

    q: jax.Array
    current: Policy
    late: Policy


Value = Callable[[jax.Array, jax.Array], jax.Array]
"""V from the soft values of the current and of the late policy, (3, K) and (3, N, 3, K), as (3, N, 3): at the state s'
that action n of state s leads to."""


def reference_value(current: jax.Array, late: jax.Array) -> jax.Array:
    """SAC without delay, VDPO's reference."""
    return jnp.broadcast_to(current.mean(-1), late.shape[:-1])


def bpql_value(current: jax.Array, late: jax.Array) -> jax.Array:
    """BPQL: the delayed policy's own value."""
    return late.mean(-1)


def adsac_value(current: jax.Array, late: jax.Array) -> jax.Array:
    """AD-SAC: the lower of a sample of each actor."""
    return jnp.minimum(current[..., None, :], late[..., :, None]).mean((-2, -1))


def solve(value: Value, sweeps: int = 60, pull: tuple[float, str] | None = None) -> Solution:
    """Iterate Q = R + γ E V and both policies' improvements until they settle, the late one's with a pull if given."""
    dynamics = jnp.asarray(transition(GRID))
    belief = dynamics.reshape(-1, STATES)  # of s_t given x_t
    improve_late = pulled(belief, *pull) if pull else lambda q, late, current: improve(belief @ q, late)
    size = len(GRID)
    q = jnp.asarray(reward(GRID))
    current, late = (Policy(jnp.zeros(n), jnp.zeros(n)) for n in (STATES, STATES * size))

    @jax.jit
    def sweep(q: jax.Array, current: Policy, late: Policy) -> tuple[jax.Array, Policy, Policy]:
        current = improve(q, current)
        late = improve_late(q, late, current)
        at = jax.vmap(lambda row: soft_values(jnp.broadcast_to(row, (STATES * size, size)), late))(q)  # (3, X, K)
        late_values = jnp.moveaxis(at, 0, 1).reshape(STATES, size, STATES, -1)
        v = value(soft_values(q, current), late_values)
        return reward(GRID) + DISCOUNT * (dynamics * v).sum(-1), current, late

    for _ in range(sweeps):
        q, current, late = sweep(q, current, late)
    return Solution(q, current, late)


def clone(reference: Policy, past: Array, forward: bool) -> tuple[Array, Array]:
    """Return mean and deviation of VDPO's policy at x = (s, a) for each state s and past action a, (3, len(past))."""
    project = moment_match if forward else precision_weighted
    mean, variance = np.asarray(reference.mean)[:, None], np.exp(2 * np.asarray(reference.log_std))[:, None]
    belief = transition(past).reshape(-1, STATES)
    found = [project(weight, mean, variance) for weight in belief]
    means, variances = (np.array(part).reshape(STATES, len(past)) for part in zip(*found, strict=True))
    return means, np.sqrt(variances)
