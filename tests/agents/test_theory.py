"""The theory of delayed imitation, checked exactly on small MDPs; docs/theory.md (sections 1 to 3) explains each test.

Numbers of equations and propositions are those of VDPO (Wu et al., NeurIPS 2024).
"""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from fixed_points import state_law_in_data
from scipy.optimize import minimize
from tabular import (
    MDP,
    Array,
    augment,
    evaluate,
    geometric_mean,
    kl,
    mixture,
    occupancy,
    optimal_policy,
    optimal_return,
    optimal_value,
    policy_return,
    random_mdp,
    soft_optimal,
    softmax,
    state_given_history,
    tracking,
    window_process,
)
from trajectories import trajectory_kl

seeds = pytest.mark.parametrize("seed", range(4))
delays = pytest.mark.parametrize("delay", range(4))


def random_policy(rng: np.random.Generator, like: Array) -> Array:
    return rng.dirichlet(np.ones(like.shape[-1]), size=like.shape[0])


def best_distribution(objective: Callable[[Array], float], actions: int) -> Array:
    """Minimise over all distributions numerically, by their logits."""
    found = minimize(lambda logits: objective(softmax(logits)), np.zeros(actions), tol=1e-12)
    return softmax(found.x)


# ---- The tools themselves ----------------------------------------------------------------------------------


@seeds
@delays
def test_augmented_mdp_is_the_true_process_seen_late(seed: int, delay: int) -> None:
    """A delayed policy returns the same on the augmented MDP and on the process that generates the data."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    delayed, windows = augment(mdp, delay), window_process(mdp, delay)
    policy = random_policy(rng, delayed.mdp.reward)
    acting = policy[windows.augmented]
    assert policy_return(delayed.mdp, policy) == pytest.approx(policy_return(windows.mdp, acting), abs=1e-10)
    data = state_law_in_data(windows, acting, np.full_like(delayed.belief, np.nan))
    np.testing.assert_allclose(data, delayed.belief, atol=1e-10)


def test_optimal_policy_is_the_best_of_all_deterministic_ones() -> None:
    mdp = augment(random_mdp(np.random.default_rng(0), states=2, actions=2), 1).mdp
    returns = [policy_return(mdp, np.eye(2)[list(choice)]) for choice in product(range(2), repeat=len(mdp.reward))]
    assert optimal_return(mdp) == pytest.approx(max(returns), abs=1e-12)


@seeds
def test_soft_optimal_policy_is_greedy_for_its_own_value(seed: int) -> None:
    """At the optimum the soft value is that of an MDP whose reward includes the entropy of the policy."""
    mdp, temperature = random_mdp(np.random.default_rng(seed)), 0.3
    q, policy = soft_optimal(mdp, temperature)
    entropy = -(policy * np.log(policy)).sum(axis=1, keepdims=True)
    value = evaluate(MDP(mdp.transition, mdp.reward + temperature * entropy, mdp.initial, mdp.discount), policy)
    np.testing.assert_allclose(mdp.reward + mdp.discount * mdp.transition @ value, q, atol=1e-9)


def test_occupancy_is_a_distribution() -> None:
    mdp = random_mdp(np.random.default_rng(0))
    _, policy = soft_optimal(mdp, 0.3)
    share = occupancy(mdp, policy)
    assert share.sum() == pytest.approx(1)
    reward = (policy * mdp.reward).sum(axis=1)
    assert share @ reward == pytest.approx((1 - mdp.discount) * policy_return(mdp, policy))


# ---- 1. What delay costs (Lemma 3.1) -----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_optimal_value_never_rises_with_delay(seed: int) -> None:
    """From every start state, not only on average."""
    mdp = random_mdp(np.random.default_rng(seed))
    values = np.stack([optimal_value(augment(mdp, delay).mdp)[:4] for delay in range(4)])
    assert (np.diff(values, axis=0) <= 1e-9).all()
    assert mdp.initial @ values[1] < mdp.initial @ values[0] - 1e-3


@delays
def test_optimal_return_falls_strictly_when_fresh_states_are_worth_having(delay: int) -> None:
    """Naming the state of a two-state chain: right with probability (1 + (2·stay - 1)^age)/2."""
    mdp = tracking(stay=0.9)
    ages = np.minimum(np.arange(2000), delay)
    expected = (mdp.discount ** np.arange(2000) * (1 + 0.8**ages) / 2).sum()
    assert optimal_return(augment(mdp, delay).mdp) == pytest.approx(expected, abs=1e-9)
    assert optimal_return(augment(mdp, delay + 1).mdp) < expected - 0.1


@seeds
def test_stochastic_mdp_with_one_best_action_everywhere_loses_nothing(seed: int) -> None:
    """Stochastic transitions are not enough for a loss: the missing state must matter for the decision."""
    mdp = random_mdp(np.random.default_rng(seed))
    reward = mdp.reward.copy()
    reward[:, 0] = reward.max() + 1
    shared = MDP(np.repeat(mdp.transition[:, :1], 3, axis=1), reward, mdp.initial, mdp.discount)
    returns = [optimal_return(augment(shared, delay).mdp) for delay in range(4)]
    np.testing.assert_allclose(returns, returns[0], atol=1e-9)


@seeds
def test_loss_is_the_expected_regret_under_the_belief(seed: int) -> None:
    """J*_0 - J(π_Δ) = Σ_t γ^t E[V*(s_t) - Q*(s_t, a_t)] with s_t ~ b(· | x_t)."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng)
    value = optimal_value(mdp)
    regret = value[:, None] - (mdp.reward + mdp.discount * mdp.transition @ value)
    delayed = augment(mdp, 2)
    for policy in (optimal_policy(delayed.mdp), random_policy(rng, delayed.mdp.reward)):
        per_history = (policy * (delayed.belief @ regret)).sum(axis=1)
        lost = occupancy(delayed.mdp, policy) @ per_history / (1 - mdp.discount)
        assert optimal_return(mdp) - policy_return(delayed.mdp, policy) == pytest.approx(lost, abs=1e-9)


@seeds
@delays
def test_deterministic_transitions_lose_nothing(seed: int, delay: int) -> None:
    """For any law of s_0: the first observation is s_0, so every history determines the current state."""
    mdp = random_mdp(np.random.default_rng(seed), deterministic=True)
    delayed = augment(mdp, delay)
    assert set(np.unique(delayed.belief)) == {0.0, 1.0}
    np.testing.assert_allclose(optimal_value(delayed.mdp), delayed.belief @ optimal_value(mdp), atol=1e-9)


def test_deterministic_transitions_lose_when_the_start_is_not_seen() -> None:
    """If nothing is seen before step Δ, a random s_0 costs even a deterministic MDP; a known s_0 does not."""
    mdp, delay = random_mdp(np.random.default_rng(1), deterministic=True), 2
    known = MDP(mdp.transition, mdp.reward, np.eye(4)[0], mdp.discount)
    assert optimal_return(mdp) == pytest.approx(4.724, abs=1e-3)
    assert blind_start_return(mdp, delay) == pytest.approx(4.335, abs=1e-3)
    assert blind_start_return(known, delay) == pytest.approx(optimal_return(known), abs=1e-9)


def blind_start_return(mdp: MDP, delay: int) -> float:
    """Best return when the first observation, s_0, arrives at step `delay`."""
    delayed = augment(mdp, delay)
    value = dict(zip(delayed.histories, optimal_value(delayed.mdp), strict=True))
    returns = []
    for taken in product(range(mdp.reward.shape[1]), repeat=delay):
        law, total = mdp.initial, 0.0
        for step, action in enumerate(taken):
            total += mdp.discount**step * float(law @ mdp.reward[:, action])
            law = law @ mdp.transition[:, action]
        later = sum(p * value[state, taken] for state, p in enumerate(mdp.initial))
        returns.append(total + mdp.discount**delay * later)
    return float(max(returns))


def test_invented_first_actions_can_make_delay_pay() -> None:
    """Under the paper's ρ_Δ an episode starts after Δ given actions; if they lead uphill, J* rises with Δ."""
    climb = np.zeros((3, 2, 3))
    climb[:, 0] = np.eye(3)[[1, 2, 2]]
    climb[:, 1] = np.eye(3)
    mdp = MDP(climb, np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), np.array([1.0, 0.0, 0.0]), 0.9)
    returns = []
    for delay in range(4):
        delayed = augment(mdp, delay)
        returns.append(optimal_value(delayed.mdp)[delayed.histories.index((0, (0,) * delay))])
    np.testing.assert_allclose(returns, [8.1, 9.0, 10.0, 10.0], atol=1e-9)
    np.testing.assert_allclose([optimal_return(augment(mdp, delay).mdp) for delay in range(4)], 8.1, atol=1e-9)


# ---- 2. Trajectory-level and state-level KL (Proposition 3.3) ----------------------------------------------


@seeds
@delays
def test_trajectory_kl_is_the_state_level_sum_with_constant_zero(seed: int, delay: int) -> None:
    """Under the joint law of (s_t, x_t) that π induces. The dynamics cancel, so no constant is left."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    policy = random_policy(rng, augment(mdp, delay).mdp.reward)
    found = trajectory_kl(mdp, delay, random_policy(rng, mdp.reward), policy)
    assert found.mass == pytest.approx(1, abs=1e-12)
    assert found.trajectory == pytest.approx(found.joint, abs=1e-12)
    assert found.trajectory > 0.1


@seeds
def test_other_readings_of_the_state_level_sum_fail(seed: int) -> None:
    """d^π(s_t) says nothing of x_t: s_t from b(· | x_t) is right for Δ ≤ 1 only, s_t drawn apart never."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    reference = random_policy(rng, mdp.reward)
    for delay in range(4):
        policy = random_policy(rng, augment(mdp, delay).mdp.reward)
        found = trajectory_kl(mdp, delay, reference, policy)
        assert abs(found.independent - found.trajectory) > 1e-3
        gap = abs(found.belief - found.trajectory)
        assert gap < 1e-12 if delay <= 1 else gap > 1e-4


@seeds
@pytest.mark.parametrize("deterministic", [False, True])
def test_printed_constant_belongs_to_another_distribution(seed: int, deterministic: bool) -> None:
    """The printed p_πΔ(τ) draws each s_t afresh from b(· | x_t): no law of trajectories in a stochastic MDP.

    Its constant does not depend on π_Δ, as claimed, but is not zero; the KL of real trajectories has none.
    """
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, states=3, actions=2, deterministic=deterministic)
    reference = random_policy(rng, mdp.reward)
    policies = [random_policy(rng, augment(mdp, 2).mdp.reward) for _ in range(3)]
    found = [trajectory_kl(mdp, 2, reference, policy) for policy in policies]
    constants = [one.printed_constant for one in found]
    np.testing.assert_allclose(constants, constants[0], atol=1e-12)
    if deterministic:
        assert constants[0] == pytest.approx(0, abs=1e-12)
        assert found[0].printed_mass == pytest.approx(1, abs=1e-12)
    else:
        assert constants[0] > 0.1
        assert found[0].printed_mass < 0.9


def test_infinite_horizon_sum_diverges() -> None:
    """Prop. 3.3 sums to t = ∞ without discount: every step adds as much again, even for the best π_Δ."""
    mdp = tracking()
    _, reference = soft_optimal(mdp, 0.1)
    windows = window_process(mdp, 1)
    best = mixture(augment(mdp, 1).belief, reference)
    per_window = kl(reference[windows.state], best[windows.augmented])
    chain = np.einsum("ya,yaz->yz", reference[windows.state], windows.mdp.transition)
    law, steps = windows.mdp.initial, []
    for _ in range(200):
        steps.append(float(law @ per_window))
        law = law @ chain
    assert steps[0] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(steps[1:], steps[1], atol=1e-12)
    assert steps[1] > 0.3


@seeds
@pytest.mark.parametrize("delay", [1, 2, 3])
def test_trajectory_kl_is_minimised_by_the_posterior_mixture(seed: int, delay: int) -> None:
    """Not by Eq. (7), the belief mixture, once Δ ≥ 2: π's past actions are evidence of the unseen states."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    reference = random_policy(rng, mdp.reward)
    delayed, windows = augment(mdp, delay), window_process(mdp, delay)
    posterior = state_given_history(mdp, delayed.histories, reference)
    in_data = state_law_in_data(windows, reference[windows.state], posterior)
    np.testing.assert_allclose(posterior, in_data, atol=1e-10)

    best, by_belief = mixture(posterior, reference), mixture(delayed.belief, reference)
    lowest = trajectory_kl(mdp, delay, reference, best).trajectory
    for policy in (by_belief, random_policy(rng, best)):  # the excess of any policy, exactly: so best is best
        found = trajectory_kl(mdp, delay, reference, policy)
        assert found.trajectory - lowest == pytest.approx(found.minimiser_excess, abs=1e-12)
    gap = trajectory_kl(mdp, delay, reference, by_belief).trajectory - lowest
    assert gap == pytest.approx(0, abs=1e-12) if delay == 1 else gap > 1e-5


# ---- 3. Forward and reverse (Eqs. 6, 7 and 11) -------------------------------------------------------------


@seeds
def test_forward_objective_is_minimised_by_the_mixture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief, policy = rng.dirichlet(np.ones(4)), rng.dirichlet(np.ones(3), size=4)
    best = mixture(belief, policy)
    found = best_distribution(lambda q: float(belief @ kl(policy, q)), 3)
    np.testing.assert_allclose(found, best, atol=1e-5)
    other = rng.dirichlet(np.ones(3))  # the excess of any other policy is exactly KL(mixture ‖ other)
    assert belief @ kl(policy, other) - belief @ kl(policy, best) == pytest.approx(kl(best, other), abs=1e-12)


@seeds
def test_reverse_objective_is_minimised_by_the_geometric_mean(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief, policy = rng.dirichlet(np.ones(4)), rng.dirichlet(np.ones(3), size=4)
    best = geometric_mean(belief, policy)
    found = best_distribution(lambda q: float(belief @ kl(q, policy)), 3)
    np.testing.assert_allclose(found, best, atol=1e-5)
    other = rng.dirichlet(np.ones(3))  # the excess of any other policy is exactly KL(other ‖ geometric mean)
    assert belief @ kl(other, policy) - belief @ kl(best, policy) == pytest.approx(kl(other, best), abs=1e-12)
    assert np.abs(best - mixture(belief, policy)).max() > 0.003


def test_one_possible_state_can_veto_an_action_only_in_reverse() -> None:
    """Two equally likely states whose policies disagree, and a third action that both find passable."""
    belief = np.array([0.5, 0.5])
    policy = np.array([[0.899, 0.001, 0.100], [0.001, 0.899, 0.100]])
    np.testing.assert_allclose(mixture(belief, policy), [0.45, 0.45, 0.10], atol=1e-12)
    np.testing.assert_allclose(geometric_mean(belief, policy), [0.1874, 0.1874, 0.6251], atol=1e-4)


@seeds
def test_critic_based_improvement_is_a_geometric_mean_for_any_critic(seed: int) -> None:
    """BPQL's and AD-SAC's step is exp(E_b[Q]/α); Q = α log softmax(Q/α) + V, and V has no action in it."""
    rng = np.random.default_rng(seed)
    belief, q, temperature = rng.dirichlet(np.ones(4), size=5), rng.normal(size=(4, 3)), 0.3
    improved = softmax(belief @ q / temperature)
    np.testing.assert_allclose(improved, geometric_mean(belief, softmax(q / temperature)), atol=1e-12)
    assert np.abs(improved - mixture(belief, softmax(q / temperature))).max() > 0.05


@seeds
def test_cold_limits(seed: int) -> None:
    """α → 0: the geometric mean maximises E_b[Q*]; the mixture draws an action as often as it is optimal."""
    mdp, temperature = random_mdp(np.random.default_rng(seed)), 0.003
    belief = augment(mdp, 2).belief
    q, _ = soft_optimal(mdp, temperature)
    averaged = belief @ q
    clear = np.diff(np.sort(averaged, axis=1)[:, -2:])[:, 0] > 0.1
    geometric = softmax(averaged / temperature)
    np.testing.assert_allclose(geometric[clear], np.eye(3)[averaged.argmax(axis=1)][clear], atol=1e-9)
    np.testing.assert_allclose(
        mixture(belief, softmax(q / temperature)), mixture(belief, optimal_policy(mdp)), atol=1e-3
    )
