"""Small delayed MDPs, solved exactly.

Pure functions of arrays, with no sampling and no learning, so that what papers say of delayed control can be
checked to rounding error. Letters for shapes: S states, A actions, X augmented states, Y windows, T steps,
N items of any kind, D action dimensions.

Convention for the start of an episode: the first observation is s_0 with age 0, and the age at step t is
min(t, delay). No action is invented: an augmented state is one observed state and as many actions as its age.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
History = tuple[int, tuple[int, ...]]
"""An augmented state: the newest state that arrived, then the actions taken since, oldest first."""


@dataclass(frozen=True)
class MDP:
    """A finite discounted MDP.

    Attributes:
        transition: P(s' | s, a), shape (S, A, S).
        reward: R(s, a), shape (S, A).
        initial: Distribution of s_0, shape (S,).
        discount: In [0, 1).
    """

    transition: Array
    reward: Array
    initial: Array
    discount: float


@dataclass(frozen=True)
class DelayedMDP:
    """What the delayed agent faces: an ordinary MDP whose states are histories.

    Attributes:
        mdp: The augmented MDP, over X states.
        histories: What each augmented state stands for, X of them.
        belief: b(s_t | x_t), the current state's law given the history alone, shape (X, S).
    """

    mdp: MDP
    histories: tuple[History, ...]
    belief: Array


@dataclass(frozen=True)
class Windows:
    """The true process, remembered for as long as the delay: every state and action since the observed one.

    A window determines the true state and what the agent knows of it, so policies on either can be run on it.

    Attributes:
        mdp: MDP over Y windows (s_{t-age}, a_{t-age}, ..., a_{t-1}, s_t).
        augmented: Index of x_t for each window, shape (Y,).
        state: Index of s_t for each window, shape (Y,).
        shorter: Index of x^τ_t, the history under a shorter delay, for each window, shape (Y,).
    """

    mdp: MDP
    augmented: Indices
    state: Indices
    shorter: Indices


# ---- MDPs --------------------------------------------------------------------------------------------------


def random_mdp(
    rng: np.random.Generator,
    states: int = 4,
    actions: int = 3,
    *,
    deterministic: bool = False,
    discount: float = 0.9,
) -> MDP:
    """Return an MDP with standard normal rewards and Dirichlet(1/2), or deterministic, transitions."""
    if deterministic:
        transition = np.eye(states)[rng.integers(states, size=(states, actions))]
    else:
        transition = rng.dirichlet(np.full(states, 0.5), size=(states, actions))
    return MDP(transition, rng.normal(size=(states, actions)), rng.dirichlet(np.ones(states)), discount)


def guessing_game(wrong_cost: float, wait_cost: float = 0.02, discount: float = 0.9) -> MDP:
    """Return a game in which a hidden side must be guessed.

    States are start, left, right and end; actions left, right and wait. Each step that does not end the game
    draws the side anew, so a delayed agent never knows it. The right guess pays 1, the wrong one -wrong_cost,
    and either ends the game; waiting costs wait_cost.
    """
    draw_side = np.array([0.0, 0.5, 0.5, 0.0])
    end = np.array([0.0, 0.0, 0.0, 1.0])
    transition = np.stack([
        np.stack([draw_side, draw_side, draw_side]),
        np.stack([end, end, draw_side]),
        np.stack([end, end, draw_side]),
        np.stack([end, end, end]),
    ])  # fmt: skip
    reward = np.array([
        [0.0, 0.0, 0.0],
        [1.0, -wrong_cost, -wait_cost],
        [-wrong_cost, 1.0, -wait_cost],
        [0.0, 0.0, 0.0],
    ])  # fmt: skip
    return MDP(transition, reward, np.array([1.0, 0.0, 0.0, 0.0]), discount)


def tracking(stay: float = 0.9, discount: float = 0.95) -> MDP:
    """Return a two-state chain that keeps its state with probability `stay`; naming the state pays 1."""
    chain = np.array([[stay, 1 - stay], [1 - stay, stay]])
    return MDP(np.stack([chain, chain], axis=1), np.eye(2), np.array([0.5, 0.5]), discount)


# ---- Solving an MDP ----------------------------------------------------------------------------------------


def evaluate(mdp: MDP, policy: Array) -> Array:
    """Return the value of a policy.

    Args:
        mdp: The MDP.
        policy: π(a | s), shape (S, A).

    Returns:
        V, shape (S,).
    """
    chain = np.einsum("sa,sau->su", policy, mdp.transition)
    reward = (policy * mdp.reward).sum(axis=1)
    return np.linalg.solve(np.eye(len(reward)) - mdp.discount * chain, reward)


def policy_return(mdp: MDP, policy: Array) -> float:
    """Return J, the expected discounted return of a policy of shape (S, A) from the initial distribution."""
    return float(mdp.initial @ evaluate(mdp, policy))


def occupancy(mdp: MDP, policy: Array) -> Array:
    """Return the discounted share of time that a policy of shape (S, A) spends in each state, shape (S,).

    The matrix is diagonally dominant by columns with no positive entry off the diagonal, so elimination subtracts
    nothing of like size, and even shares far below rounding error come out right.
    """
    chain = np.einsum("sa,sau->su", policy, mdp.transition)
    return np.linalg.solve(np.eye(len(chain)) - mdp.discount * chain.T, (1 - mdp.discount) * mdp.initial)


def optimal_policy(mdp: MDP) -> Array:
    """Return an optimal deterministic policy by policy iteration, one-hot, shape (S, A)."""
    states, actions = mdp.reward.shape
    choice = np.zeros(states, dtype=np.int64)
    while True:
        value = evaluate(mdp, np.eye(actions)[choice])
        q = mdp.reward + mdp.discount * mdp.transition @ value
        better = q.max(axis=1) > q[np.arange(states), choice] + 1e-10  # ties keep the action, so this ends
        if not better.any():
            return np.eye(actions)[choice]
        choice = np.where(better, q.argmax(axis=1), choice)


def optimal_value(mdp: MDP) -> Array:
    """Return V*, shape (S,)."""
    return evaluate(mdp, optimal_policy(mdp))


def optimal_return(mdp: MDP) -> float:
    """Return J*, the best expected discounted return from the initial distribution."""
    return float(mdp.initial @ optimal_value(mdp))


def soft_optimal(mdp: MDP, temperature: float) -> tuple[Array, Array]:
    """Solve the entropy-regularised MDP by soft value iteration.

    Args:
        mdp: The MDP.
        temperature: α > 0, the weight of the entropy.

    Returns:
        Soft Q* and the policy softmax(Q*/α), both of shape (S, A).
    """
    value = np.zeros(len(mdp.reward))
    while True:
        q = mdp.reward + mdp.discount * mdp.transition @ value
        updated = temperature * log_sum_exp(q / temperature)
        if np.abs(updated - value).max() < 1e-12 * max(1.0, np.abs(value).max()):
            return q, softmax(q / temperature)
        value = updated


# ---- Delay -------------------------------------------------------------------------------------------------


def augment(mdp: MDP, delay: int) -> DelayedMDP:
    """Return the MDP over histories that an agent with a constant observation delay faces."""
    states, actions = mdp.reward.shape
    histories: list[History] = [
        (state, taken)
        for age in range(delay + 1)
        for state in range(states)
        for taken in product(range(actions), repeat=age)
    ]
    index = {history: i for i, history in enumerate(histories)}
    transition = np.zeros((len(histories), actions, len(histories)))
    for (state, taken), row in index.items():
        for action in range(actions):
            since = (*taken, action)
            if len(taken) < delay:  # nothing new arrives yet: the history only grows
                transition[row, action, index[state, since]] = 1.0
            else:
                for arrived, probability in enumerate(mdp.transition[state, since[0]]):
                    transition[row, action, index[arrived, since[1:]]] = probability
    initial = np.zeros(len(histories))
    initial[:states] = mdp.initial
    belief = state_given_history(mdp, histories)
    augmented = MDP(transition, belief @ mdp.reward, initial, mdp.discount)
    return DelayedMDP(augmented, tuple(histories), belief)


def state_given_history(
    mdp: MDP, histories: list[History] | tuple[History, ...], behaviour: Array | None = None
) -> Array:
    """Return the law of the current state given each history.

    Without `behaviour` this is the belief b(s_t | x_t): the actions are taken as given and say nothing about
    the states. With it, a policy that saw the true states chose the actions, so each one is evidence of the
    state that it was chosen in, and the result is the p_π(s_t | x_t) of that policy's data.

    Args:
        mdp: The MDP.
        histories: X of them.
        behaviour: π(a | s), positive, shape (S, A).

    Returns:
        Shape (X, S).
    """
    rows = []
    for state, taken in histories:
        weight = np.eye(len(mdp.initial))[state]
        for action in taken:
            seen = weight if behaviour is None else weight * behaviour[:, action]
            weight = seen @ mdp.transition[:, action]
        rows.append(weight / weight.sum())
    return np.stack(rows)


def window_process(mdp: MDP, delay: int, shorter: int = 0) -> Windows:
    """Return the true process as an MDP over windows, with the histories for two delays. It uses no belief."""
    states, actions = mdp.reward.shape
    index: dict[tuple[tuple[int, ...], tuple[int, ...]], int] = {}
    for age in range(delay + 1):
        for visited in product(range(states), repeat=age + 1):
            for taken in product(range(actions), repeat=age):
                index[visited, taken] = len(index)
    transition = np.zeros((len(index), actions, len(index)))
    for (visited, taken), row in index.items():
        drop = int(len(taken) == delay)
        for action in range(actions):
            for arrived in range(states):
                to = index[(*visited, arrived)[drop:], (*taken, action)[drop:]]
                transition[row, action, to] = mdp.transition[visited[-1], action, arrived]
    state = np.array([visited[-1] for visited, _ in index])
    initial = np.zeros(len(index))
    initial[:states] = mdp.initial
    process = MDP(transition, mdp.reward[state], initial, mdp.discount)
    return Windows(process, seen_late(mdp, index, delay), state, seen_late(mdp, index, shorter))


def seen_late(mdp: MDP, windows: Iterable[tuple[tuple[int, ...], tuple[int, ...]]], delay: int) -> Indices:
    """Return the index of the history that a delay leaves of each window of states and actions, shape (Y,)."""
    known = {history: i for i, history in enumerate(augment(mdp, delay).histories)}
    ages = [(visited, taken, min(len(taken), delay)) for visited, taken in windows]
    return np.array([known[visited[-1 - age], taken[len(taken) - age :]] for visited, taken, age in ages])


# ---- Policies from a belief --------------------------------------------------------------------------------


def log_sum_exp(logits: Array) -> Array:
    """Return log Σ exp over the last axis."""
    top = logits.max(axis=-1, keepdims=True)
    total: Array = top + np.log(np.exp(logits - top).sum(axis=-1, keepdims=True))
    return total[..., 0]


def softmax(logits: Array) -> Array:
    """Return exp(logits), normalised over the last axis."""
    return np.exp(logits - log_sum_exp(logits)[..., None])


def kl(p: Array, q: Array) -> Array:
    """Return KL(p ‖ q) over the last axis; a zero of p counts as zero."""
    ratio = np.log(np.where(p > 0, p, 1.0)) - np.log(np.where(p > 0, q, 1.0))
    divergence: Array = (p * ratio).sum(axis=-1)
    return divergence


def mixture(belief: Array, policy: Array) -> Array:
    """Return E_b[π(a | s)], the minimiser of the forward objective E_b KL(π(· | s) ‖ ·).

    Args:
        belief: Shape (X, S).
        policy: Shape (S, A).

    Returns:
        Shape (X, A).
    """
    return belief @ policy


def geometric_mean(belief: Array, policy: Array) -> Array:
    """Return ∝ exp(E_b[log π(a | s)]), the minimiser of the reverse objective E_b KL(· ‖ π(· | s)).

    Args:
        belief: Shape (X, S).
        policy: Positive, shape (S, A).

    Returns:
        Shape (X, A).
    """
    return softmax(belief @ np.log(policy))
