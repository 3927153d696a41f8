"""What the delayed agents converge to on small MDPs: policies and values that their own updates leave alone.

The same letters for shapes as in tabular.py, and Z for the histories of a shorter, auxiliary delay. Every method
averages over what it does not see *in its data*, so each fixed point belongs to a behaviour.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import wrightomega
from tabular import (
    MDP,
    Array,
    Windows,
    augment,
    geometric_mean,
    log_sum_exp,
    mixture,
    occupancy,
    soft_optimal,
    softmax,
    state_given_history,
    window_process,
)

Data = Literal["reference", "delayed", "lower_q"]
"""Who acts: the reference on the true state, the delayed policy itself (as in DAgger), or, as in the released code of
VDPO and AD-SAC, whichever of their two sampled actions has the lower Q at the true state."""


def imitation_fixed_point(mdp: MDP, delay: int, temperature: float, *, data: Data, forward: bool) -> Array:
    """Imitate the soft-optimal delay-free policy on the data of a behaviour.

    Args:
        mdp: The MDP.
        delay: Steps.
        temperature: α of the reference.
        data: Who acts.
        forward: Minimise KL(π ‖ π_Δ), giving a mixture; otherwise KL(π_Δ ‖ π), giving a geometric mean.

    Returns:
        The delayed policy, shape (X, A).
    """
    q, reference = soft_optimal(mdp, temperature)
    belief = augment(mdp, delay).belief
    windows = window_process(mdp, delay)
    project = mixture if forward else geometric_mean
    policy = project(belief, reference)
    for _ in range(500):
        acting = behaviour(data, q[windows.state], reference[windows.state], policy[windows.augmented])
        updated = project(state_law_in_data(windows, acting, belief), reference)
        if np.abs(updated - policy).max() < 1e-10:
            return updated
        policy = 0.5 * (policy + updated)  # damped: the policy and its data change together
    raise RuntimeError("imitation did not settle")


def behaviour(data: Data, q: Array, free: Array, late: Array) -> Array:
    """Return who acts in each window, from the Q-values and the two policies there; all are (Y, A)."""
    if data != "lower_q":
        return free if data == "reference" else late
    both = free[:, :, None] * late[:, None, :]
    free_is_lower = q[:, :, None] < q[:, None, :]
    lower: Array = (both * free_is_lower).sum(axis=2) + (both * ~free_is_lower).sum(axis=1)
    return lower


def shorter_histories(mdp: MDP, delay: int, shorter: int) -> Array:
    """Return the law of the history under a shorter delay, given the history under the longer one.

    The belief is the case shorter = 0.

    Args:
        mdp: The MDP.
        delay: The longer delay, X histories.
        shorter: The shorter delay, Z histories.

    Returns:
        Shape (X, Z).
    """
    index = {history: i for i, history in enumerate(augment(mdp, shorter).histories)}
    histories = augment(mdp, delay).histories
    law = np.zeros((len(histories), len(index)))
    for row, (state, taken) in enumerate(histories):
        split = max(len(taken) - shorter, 0)
        between = state_given_history(mdp, [(state, taken[:split])])[0]
        for arrived, probability in enumerate(between):
            law[row, index[arrived, taken[split:]]] = probability
    return law


def state_law_in_data(windows: Windows, acting: Array, unmet: Array) -> Array:
    """Return p(x^τ_t | x_t), which is p(s_t | x_t) for τ = 0, in the data of a behaviour that may use the window.

    Args:
        windows: The window process, for the delays Δ and τ.
        acting: The behaviour, shape (Y, A).
        unmet: What to return for histories that the behaviour never meets, shape (X, Z).

    Returns:
        Shape (X, Z).
    """
    joint = np.zeros_like(unmet)
    np.add.at(joint, (windows.augmented, windows.shorter), occupancy(windows.mdp, acting))
    total = joint.sum(axis=1, keepdims=True)
    return np.where(total > 1e-200, joint / np.maximum(total, 1e-300), unmet)


class ActorCritic(NamedTuple):
    """Critic and delayed policy of a method that improves the policy with values of a shorter history.

    Attributes:
        q: Q(x^τ, a), shape (Z, A).
        policy: π_Δ(a | x), shape (X, A).
    """

    q: Array
    policy: Array


def bpql_fixed_point(mdp: MDP, delay: int, temperature: float) -> ActorCritic:
    """Return where BPQL settles: its critics see s_t, its target has the value of the delayed policy."""
    return actor_critic_fixed_point(mdp, delay, temperature, shorter=0, data="delayed", lower=False)


Distance = Literal["squares", "kl"]


def any_age_fixed_point(mdp: MDP, delay: int, temperature: float, weight: float, distance: Distance) -> ActorCritic:
    """Return where any-age settles while its pull towards age 0 has a constant weight.

    Its critics are BPQL's. Its late actor minimises ½ E_b[α log π_Δ - Q] + w E_b D(π_Δ, π_0), where the policy at age 0
    sees s_t and is soft-greedy for the same Q. `squares` are squared differences of probabilities, the table's
    counterpart of lifting's squared differences of moments.
    """

    def improve(belief: Array, q: Array) -> Array:
        free, averaged = softmax(q / temperature), belief @ q
        if distance == "kl":
            return pulled_by_kl(averaged, belief @ np.log(free), temperature, weight)
        return pulled_by_squares(averaged, belief @ free, temperature, weight)

    return actor_critic_fixed_point(mdp, delay, temperature, shorter=0, data="delayed", lower=False, improve=improve)


def pulled_by_kl(averaged: Array, log_free: Array, temperature: float, weight: float) -> Array:
    """Minimise ½(α log π - Q) + w KL(π ‖ π_j) on average, given E[Q | x] and E[log π_j | x], all of shape (X, A)."""
    return softmax((0.5 * averaged + weight * log_free) / (0.5 * temperature + weight))


def pulled_by_squares(averaged: Array, mean: Array, temperature: float, weight: float) -> Array:
    """Minimise ½(α log π - Q) + w ‖π - π_0‖² on average, given E[Q | x] and E[π_0 | x], all of shape (X, A).

    Where the derivative vanishes, ½α log π + 2wπ = ½Q + 2w E π_0 + λ; λ is such that π sums to 1.
    """
    if weight == 0:
        return softmax(averaged / temperature)
    side = 0.5 * averaged + 2 * weight * mean

    def policy(level: Array) -> Array:
        exponent = 2 * (side + level[:, None]) / temperature + np.log(4 * weight / temperature)
        solved: Array = temperature / (4 * weight) * wrightomega(exponent).real
        return solved

    low, high = np.full(len(side), -side.max() - 2 * weight - 50), np.full(len(side), -side.min() + 2 * weight + 50)
    for _ in range(80):
        level = (low + high) / 2
        above = policy(level).sum(axis=1) > 1
        low, high = np.where(above, low, level), np.where(above, level, high)
    return policy((low + high) / 2)


def adsac_fixed_point(
    mdp: MDP, delay: int, temperature: float, *, shorter: int = 0, data: Data = "delayed"
) -> ActorCritic:
    """Return where AD-SAC settles: its critics see x^τ_t, its target has the lower value of two actors.

    The released rule for acting, "lower_q", needs the true state, so only τ = 0 has it.
    """
    return actor_critic_fixed_point(mdp, delay, temperature, shorter=shorter, data=data, lower=True)


def actor_critic_fixed_point(
    mdp: MDP,
    delay: int,
    temperature: float,
    *,
    shorter: int,
    data: Data,
    lower: bool,
    improve: Callable[[Array, Array], Array] | None = None,
) -> ActorCritic:
    """Iterate critic, policy and data to their common fixed point.

    Both critics have one fixed point. Q(x^τ, a) is the average of the soft target over the windows in which x^τ and a
    occur in the data, and each policy is soft-greedy for the average of Q over its own data:

        Q(x^τ, a) = E[r + γ V(window')],  π_τ ∝ exp(Q(x^τ, a)/α),  π_Δ ∝ exp(E[Q(x^τ, a) | x]/α)

    Args:
        mdp: The MDP.
        delay: Steps Δ.
        temperature: α, of both actors.
        shorter: Auxiliary delay τ, in steps.
        data: Who acts, with π_τ for the reference.
        lower: Take for V the lower of both actors' values (`lower_value`), else that of π_Δ alone.
        improve: How π_Δ follows from p(x^τ | x), (X, Z), and Q, (Z, A), if it is not soft-greedy.

    Raises:
        RuntimeError: No fixed point was found. The behaviour "lower_q" jumps where two Q-values cross, so that for some
            MDPs none exists.
    """
    windows = window_process(mdp, delay, shorter)
    unmet = shorter_histories(mdp, delay, shorter)
    ends_in = np.eye(unmet.shape[1])[windows.shorter].T  # (Z, Y)
    q, _ = soft_optimal(augment(mdp, shorter).mdp, temperature)
    policy = softmax(unmet @ q / temperature)
    for attempt in range(1000):
        late, free = policy[windows.augmented], softmax(q / temperature)[windows.shorter]
        acting = behaviour(data, q[windows.shorter], free, late)
        met = ends_in * occupancy(windows.mdp, acting)
        joint = met[:, None, :] * acting.T  # the weight of each window for each pair (x^τ, a), (Z, A, Y)
        joint = joint / np.maximum(joint.sum(axis=2, keepdims=True), 1e-300)
        reward = np.einsum("zay,ya->za", joint, windows.mdp.reward)
        reached = np.stack([joint[:, a] @ windows.mdp.transition[:, a] for a in range(reward.shape[1])], axis=1)
        before = q
        for _ in range(40):  # policies and data change less than values, so these settle first
            values = q[windows.shorter] - temperature * np.log(np.maximum(late, 1e-300))
            if lower:
                values = lower_value(q[windows.shorter], values, temperature)
            q = reward + mdp.discount * reached @ (late * values).sum(axis=1)
        law = state_law_in_data(windows, acting, unmet)
        updated = improve(law, q) if improve else softmax(law @ q / temperature)
        if max(np.abs(q - before).max(), np.abs(updated - policy).max()) < 1e-11:
            return ActorCritic(q, updated)
        policy = policy + (updated - policy) * (0.5 if attempt < 100 else 0.05)  # undamped, data and policy can cycle
    raise RuntimeError("critic, policy and data did not settle")


def lower_value(q: Array, late: Array, temperature: float) -> Array:
    """Return AD-SAC's V for each sampled action of the delayed actor: the lower of both actors' soft values.

    The auxiliary actor is soft-greedy, so its Q - α log π_τ is α log Σ exp(Q/α) whatever action it samples.

    Args:
        q: Q(x^τ, a), shape (Y, A).
        late: Q(x^τ, a) - α log π_Δ(a | x), shape (Y, A).
        temperature: α.
    """
    return np.minimum(temperature * log_sum_exp(q / temperature)[:, None], late)
