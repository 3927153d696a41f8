"""Small delayed MDPs, solved exactly.

Pure functions of arrays, with no sampling and no learning, so that what papers say of delayed control can be
checked to rounding error. Letters for shapes: S states, A actions, X augmented states, Y windows, T steps,
N items of any kind, D action dimensions.

Convention for the start of an episode: the first observation is s_0 with age 0, and the age at step t is
min(t, delay). No action is invented: an augmented state is one observed state and as many actions as its age.
"""

from dataclasses import dataclass
from itertools import product
from typing import Literal

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
    """

    mdp: MDP
    augmented: Indices
    state: Indices


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


def window_process(mdp: MDP, delay: int) -> Windows:
    """Return the true process as an MDP over windows; it makes no use of any belief."""
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
    known = {history: i for i, history in enumerate(augment(mdp, delay).histories)}
    augmented = np.array([known[visited[0], taken] for visited, taken in index])
    initial = np.zeros(len(index))
    initial[:states] = mdp.initial
    return Windows(MDP(transition, mdp.reward[state], initial, mdp.discount), augmented, state)


# ---- Trajectories ------------------------------------------------------------------------------------------


def all_trajectories(mdp: MDP, horizon: int) -> tuple[Indices, Indices]:
    """Return the states and the actions of every trajectory s_0, a_0, ..., s_{T-1}, a_{T-1}, each (N, T)."""
    states, actions = mdp.reward.shape
    table = np.indices((states, actions) * horizon).reshape(2 * horizon, -1).T
    return table[:, 0::2], table[:, 1::2]


def dynamics_probability(mdp: MDP, states: Indices, actions: Indices) -> Array:
    """Return ρ(s_0) ∏ P(s_{t+1} | s_t, a_t) of each trajectory, shape (N,), for states and actions (N, T)."""
    steps = mdp.transition[states[:, :-1], actions[:, :-1], states[:, 1:]]
    return mdp.initial[states[:, 0]] * steps.prod(axis=1)


def augmented_indices(delayed: DelayedMDP, delay: int, states: Indices, actions: Indices) -> Indices:
    """Return the index of x_t at each step of each trajectory; states, actions and result are (N, T)."""
    index = {history: i for i, history in enumerate(delayed.histories)}
    columns = []
    for step in range(states.shape[1]):
        first = max(step - delay, 0)
        rows = zip(states[:, first].tolist(), actions[:, first:step].tolist(), strict=True)
        columns.append([index[state, tuple(taken)] for state, taken in rows])
    return np.array(columns).T


@dataclass(frozen=True)
class TrajectoryKL:
    """What Proposition 3.3 of VDPO relates, over all trajectories of some length.

    Attributes:
        trajectory: KL(p_π(τ) ‖ p_πΔ(τ)), both laws of trajectories of the true process.
        joint: Σ_t E KL(π(· | s_t) ‖ π_Δ(· | x_t)) over (s_t, x_t) as π visits them.
        belief: The same, over x_t as π visits it and s_t drawn from b(· | x_t).
        independent: The same, over s_t and x_t as π visits each, drawn apart.
        minimiser_excess: Σ_t E KL(q(· | x_t) ‖ π_Δ(· | x_t)) for q the posterior mixture of π's data.
        mass: Total of p_πΔ(τ).
        printed_constant: The constant that the printed p_πΔ(τ), with its factors b(s_t | x_t), leaves over.
        printed_mass: Total of the printed p_πΔ(τ) over trajectories.
    """

    trajectory: float
    joint: float
    belief: float
    independent: float
    minimiser_excess: float
    mass: float
    printed_constant: float
    printed_mass: float


def trajectory_kl(mdp: MDP, delay: int, reference: Array, policy: Array, horizon: int = 4) -> TrajectoryKL:
    """Enumerate all trajectories under the true process.

    Args:
        mdp: The MDP.
        delay: Steps.
        reference: π(a | s), positive, shape (S, A).
        policy: π_Δ(a | x), positive, shape (X, A).
        horizon: Steps in a trajectory.

    Returns:
        Both sides of the proposition, and its other readings.
    """
    delayed = augment(mdp, delay)
    states, actions = all_trajectories(mdp, horizon)
    x = augmented_indices(delayed, delay, states, actions)
    dynamics = dynamics_probability(mdp, states, actions)
    reference_law = dynamics * reference[states, actions].prod(axis=1)
    chosen = policy[x, actions].prod(axis=1)
    by_belief = (delayed.belief * kl(reference, policy[:, None])).sum(axis=1)
    independent = 0.0
    for step in range(horizon):
        of_state = np.bincount(states[:, step], reference_law, minlength=len(reference))
        of_history = np.bincount(x[:, step], reference_law, minlength=len(policy))
        independent += float(of_history @ kl(reference, policy[:, None]) @ of_state)
    best = mixture(state_given_history(mdp, delayed.histories, reference), reference)
    printed = delayed.mdp.initial[x[:, 0]] * delayed.belief[x, states].prod(axis=1)
    printed = printed * delayed.mdp.transition[x[:, :-1], actions[:, :-1], x[:, 1:]].prod(axis=1)
    return TrajectoryKL(
        trajectory=float(kl(reference_law, dynamics * chosen)),
        joint=float(reference_law @ kl(reference[states], policy[x]).sum(axis=1)),
        belief=float(reference_law @ by_belief[x].sum(axis=1)),
        independent=independent,
        minimiser_excess=float(reference_law @ kl(best, policy)[x].sum(axis=1)),
        mass=float((dynamics * chosen).sum()),
        printed_constant=float(kl(reference_law, printed * reference[states, actions].prod(axis=1))),
        printed_mass=float((printed * chosen).sum()),
    )


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


Data = Literal["reference", "delayed", "lower_q"]


def imitation_fixed_point(mdp: MDP, delay: int, temperature: float, *, data: Data, forward: bool) -> Array:
    """Imitate the soft-optimal delay-free policy on data that a given behaviour collects.

    Imitation averages over p(s_t | x_t) in its data: the belief only if the behaviour saw no more than x_t.

    Args:
        mdp: The MDP.
        delay: Steps.
        temperature: α of the reference.
        data: Who acts: the reference on the true state, the delayed policy itself (as in DAgger), or, as in
            the released VDPO code, whichever of their two sampled actions has the lower Q at the true state.
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
        delayed, free = policy[windows.augmented], reference[windows.state]
        both = free[:, :, None] * delayed[:, None, :]
        free_is_lower = q[windows.state][:, :, None] < q[windows.state][:, None, :]
        lower = (both * free_is_lower).sum(axis=2) + (both * ~free_is_lower).sum(axis=1)
        acting = {"reference": free, "delayed": delayed, "lower_q": lower}[data]
        law = state_law_in_data(windows, acting, belief)
        updated = project(law, reference)
        if np.abs(updated - policy).max() < 1e-10:
            return updated
        policy = 0.5 * (policy + updated)  # damped: the policy and its data change together
    raise RuntimeError("imitation did not settle")


def state_law_in_data(windows: Windows, behaviour: Array, unmet: Array) -> Array:
    """Return p(s_t | x_t) in the data of a behaviour that may use the whole window.

    Args:
        windows: The window process.
        behaviour: Shape (Y, A).
        unmet: What to return for histories that the behaviour never meets, shape (X, S).

    Returns:
        Shape (X, S).
    """
    joint = np.zeros_like(unmet)
    np.add.at(joint, (windows.augmented, windows.state), occupancy(windows.mdp, behaviour))
    total = joint.sum(axis=1, keepdims=True)
    return np.where(total > 1e-200, joint / np.maximum(total, 1e-300), unmet)


def bpql_fixed_point(mdp: MDP, delay: int, temperature: float) -> tuple[Array, Array]:
    """Iterate BPQL's two steps to their common fixed point, on the delayed policy's own data.

    The critic sees the true state and the actor the history. So Q(s, a) is the average of the soft target
    over the windows that end in s, weighted by how often the delayed policy meets them, and the policy is
    ∝ exp(E_b[Q(s, a)]/α).

    Args:
        mdp: The MDP.
        delay: Steps.
        temperature: α.

    Returns:
        Q, shape (S, A), and the delayed policy, shape (X, A).
    """
    states, actions = mdp.reward.shape
    belief = augment(mdp, delay).belief
    windows = window_process(mdp, delay)
    ends_in = np.eye(states)[windows.state]
    q, _ = soft_optimal(mdp, temperature)
    for _ in range(1000):
        policy = softmax(belief @ q / temperature)
        acting = policy[windows.augmented]
        share = ends_in.T * occupancy(windows.mdp, acting)  # (S, Y)
        total = np.maximum(share @ acting, 1e-300)
        reached = np.stack([(share * acting[:, a]) @ windows.mdp.transition[:, a] for a in range(actions)], axis=1)
        reached = reached / total[..., None]  # law of the next window after s and a, (S, A, Y)
        next_entropy = -temperature * (acting * np.log(np.maximum(acting, 1e-300))).sum(axis=1)
        chosen = (ends_in[:, :, None] * acting[:, None, :]).reshape(len(acting), -1)
        chain = (reached @ chosen).reshape(states * actions, -1)
        constant = mdp.reward + mdp.discount * reached @ next_entropy
        solved = np.linalg.solve(np.eye(len(chain)) - mdp.discount * chain, constant.ravel()).reshape(q.shape)
        if np.abs(solved - q).max() < 1e-11:
            return solved, softmax(belief @ solved / temperature)
        q = 0.5 * (q + solved)  # damped: the policy and its data change together
    raise RuntimeError("BPQL's two steps did not settle")


# ---- Gaussians ---------------------------------------------------------------------------------------------


def gaussian_kl(mean: Array, variance: Array, other_mean: Array, other_variance: Array) -> Array:
    """Return KL(N(mean, variance) ‖ N(other_mean, other_variance)), diagonal, summed over the last axis."""
    ratio = variance / other_variance
    return 0.5 * (ratio - 1 - np.log(ratio) + (mean - other_mean) ** 2 / other_variance).sum(axis=-1)


def moment_match(weight: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return the diagonal Gaussian q that minimises the forward objective E KL(N(μ_s, σ_s²) ‖ q).

    It has the mean and the variances of the mixture: E[μ_s] and E[σ_s² + μ_s²] - E[μ_s]².

    Args:
        weight: Belief over the N Gaussians, shape (N,).
        mean: μ_s, shape (N, D).
        variance: σ_s², shape (N, D).

    Returns:
        Mean and variance of q, both of shape (D,).
    """
    centre = weight @ mean
    return centre, weight @ (variance + (mean - centre) ** 2)


def precision_weighted(weight: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Return the diagonal Gaussian q that minimises the reverse objective E KL(q ‖ N(μ_s, σ_s²)).

    It is the normalised geometric mean of the Gaussians: 1/σ² = E[1/σ_s²] and μ = σ² E[μ_s/σ_s²].

    Args:
        weight: Belief over the N Gaussians, shape (N,).
        mean: μ_s, shape (N, D).
        variance: σ_s², shape (N, D).

    Returns:
        Mean and variance of q, both of shape (D,).
    """
    joint_variance = 1 / (weight @ (1 / variance))
    return joint_variance * (weight @ (mean / variance)), joint_variance
