"""Both sides of VDPO's Proposition 3.3, by listing all trajectories of a small MDP; the letters of tabular.py."""

from dataclasses import dataclass

import numpy as np
from tabular import MDP, Array, DelayedMDP, Indices, augment, kl, mixture, state_given_history


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
