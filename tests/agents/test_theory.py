"""The theory of delayed imitation, checked exactly on small MDPs; docs/theory.md explains each test.

Numbers of equations and propositions are those of VDPO (Wu et al., NeurIPS 2024).
"""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar
from tabular import (
    MDP,
    Array,
    Data,
    augment,
    bpql_fixed_point,
    evaluate,
    gaussian_kl,
    geometric_mean,
    guessing_game,
    imitation_fixed_point,
    kl,
    mixture,
    moment_match,
    occupancy,
    optimal_policy,
    optimal_return,
    optimal_value,
    policy_return,
    precision_weighted,
    random_mdp,
    shorter_histories,
    soft_optimal,
    softmax,
    state_given_history,
    state_law_in_data,
    tracking,
    trajectory_kl,
    window_process,
)

seeds = pytest.mark.parametrize("seed", range(4))
delays = pytest.mark.parametrize("delay", range(4))


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


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
    rng = generator(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    delayed, windows = augment(mdp, delay), window_process(mdp, delay)
    policy = random_policy(rng, delayed.mdp.reward)
    acting = policy[windows.augmented]
    assert policy_return(delayed.mdp, policy) == pytest.approx(policy_return(windows.mdp, acting), abs=1e-10)
    data = state_law_in_data(windows, acting, np.full_like(delayed.belief, np.nan))
    np.testing.assert_allclose(data, delayed.belief, atol=1e-10)


def test_optimal_policy_is_the_best_of_all_deterministic_ones() -> None:
    mdp = augment(random_mdp(generator(0), states=2, actions=2), 1).mdp
    returns = [policy_return(mdp, np.eye(2)[list(choice)]) for choice in product(range(2), repeat=len(mdp.reward))]
    assert optimal_return(mdp) == pytest.approx(max(returns), abs=1e-12)


@seeds
def test_soft_optimal_policy_is_greedy_for_its_own_value(seed: int) -> None:
    """At the optimum the soft value is that of an MDP whose reward includes the entropy of the policy."""
    mdp, temperature = random_mdp(generator(seed)), 0.3
    q, policy = soft_optimal(mdp, temperature)
    entropy = -(policy * np.log(policy)).sum(axis=1, keepdims=True)
    value = evaluate(MDP(mdp.transition, mdp.reward + temperature * entropy, mdp.initial, mdp.discount), policy)
    np.testing.assert_allclose(mdp.reward + mdp.discount * mdp.transition @ value, q, atol=1e-9)


# ---- 1. What delay costs (Lemma 3.1) -----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_optimal_value_never_rises_with_delay(seed: int) -> None:
    """From every start state, not only on average."""
    mdp = random_mdp(generator(seed))
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
    mdp = random_mdp(generator(seed))
    reward = mdp.reward.copy()
    reward[:, 0] = reward.max() + 1
    shared = MDP(np.repeat(mdp.transition[:, :1], 3, axis=1), reward, mdp.initial, mdp.discount)
    returns = [optimal_return(augment(shared, delay).mdp) for delay in range(4)]
    np.testing.assert_allclose(returns, returns[0], atol=1e-9)


@seeds
def test_loss_is_the_expected_regret_under_the_belief(seed: int) -> None:
    """J*_0 - J(π_Δ) = Σ_t γ^t E[V*(s_t) - Q*(s_t, a_t)] with s_t ~ b(· | x_t)."""
    rng = generator(seed)
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
    mdp = random_mdp(generator(seed), deterministic=True)
    delayed = augment(mdp, delay)
    assert set(np.unique(delayed.belief)) == {0.0, 1.0}
    np.testing.assert_allclose(optimal_value(delayed.mdp), delayed.belief @ optimal_value(mdp), atol=1e-9)


def test_deterministic_transitions_lose_when_the_start_is_not_seen() -> None:
    """If nothing is seen before step Δ, a random s_0 costs even a deterministic MDP; a known s_0 does not."""
    mdp, delay = random_mdp(generator(1), deterministic=True), 2
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
    rng = generator(seed)
    mdp = random_mdp(rng, states=3, actions=2)
    policy = random_policy(rng, augment(mdp, delay).mdp.reward)
    found = trajectory_kl(mdp, delay, random_policy(rng, mdp.reward), policy)
    assert found.mass == pytest.approx(1, abs=1e-12)
    assert found.trajectory == pytest.approx(found.joint, abs=1e-12)
    assert found.trajectory > 0.1


@seeds
def test_other_readings_of_the_state_level_sum_fail(seed: int) -> None:
    """d^π(s_t) says nothing of x_t: s_t from b(· | x_t) is right for Δ ≤ 1 only, s_t drawn apart never."""
    rng = generator(seed)
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
    rng = generator(seed)
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
    rng = generator(seed)
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
    rng = generator(seed)
    belief, policy = rng.dirichlet(np.ones(4)), rng.dirichlet(np.ones(3), size=4)
    best = mixture(belief, policy)
    found = best_distribution(lambda q: float(belief @ kl(policy, q)), 3)
    np.testing.assert_allclose(found, best, atol=1e-5)
    other = rng.dirichlet(np.ones(3))  # the excess of any other policy is exactly KL(mixture ‖ other)
    assert belief @ kl(policy, other) - belief @ kl(policy, best) == pytest.approx(kl(best, other), abs=1e-12)


@seeds
def test_reverse_objective_is_minimised_by_the_geometric_mean(seed: int) -> None:
    rng = generator(seed)
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
    rng = generator(seed)
    belief, q, temperature = rng.dirichlet(np.ones(4), size=5), rng.normal(size=(4, 3)), 0.3
    improved = softmax(belief @ q / temperature)
    np.testing.assert_allclose(improved, geometric_mean(belief, softmax(q / temperature)), atol=1e-12)
    assert np.abs(improved - mixture(belief, softmax(q / temperature))).max() > 0.05


@seeds
def test_cold_limits(seed: int) -> None:
    """α → 0: the geometric mean maximises E_b[Q*]; the mixture draws an action as often as it is optimal."""
    mdp, temperature = random_mdp(generator(seed)), 0.003
    belief = augment(mdp, 2).belief
    q, _ = soft_optimal(mdp, temperature)
    averaged = belief @ q
    clear = np.diff(np.sort(averaged, axis=1)[:, -2:])[:, 0] > 0.1
    geometric = softmax(averaged / temperature)
    np.testing.assert_allclose(geometric[clear], np.eye(3)[averaged.argmax(axis=1)][clear], atol=1e-9)
    np.testing.assert_allclose(
        mixture(belief, softmax(q / temperature)), mixture(belief, optimal_policy(mdp)), atol=1e-3
    )


# ---- 4. Gaussians ------------------------------------------------------------------------------------------


def gaussian_references(seed: int) -> tuple[Array, Array, Array]:
    rng = generator(seed)
    return rng.dirichlet(np.ones(5)), rng.normal(size=(5, 2)), np.exp(rng.normal(size=(5, 2)))


@seeds
@pytest.mark.parametrize("forward", [True, False])
def test_closed_forms_for_gaussians(seed: int, forward: bool) -> None:
    weight, mean, variance = gaussian_references(seed)

    def objective(parameters: Array) -> float:
        own_mean, own_variance = parameters[:2], np.exp(parameters[2:])
        if forward:
            return float(weight @ gaussian_kl(mean, variance, own_mean, own_variance))
        return float(weight @ gaussian_kl(own_mean, own_variance, mean, variance))

    found = minimize(objective, np.zeros(4), tol=1e-12).x
    best_mean, best_variance = (moment_match if forward else precision_weighted)(weight, mean, variance)
    np.testing.assert_allclose(found[:2], best_mean, atol=1e-4)
    np.testing.assert_allclose(np.exp(found[2:]), best_variance, rtol=1e-4)


@seeds
def test_gaussian_closed_forms_are_the_moments_of_the_two_means(seed: int) -> None:
    """On a grid: the forward minimiser has the mixture's moments, the reverse one is the geometric mean."""
    weight, mean, variance = gaussian_references(seed)
    mean, variance = mean[:, :1], variance[:, :1]
    grid = np.linspace(-30, 30, 20001)
    density = np.exp(-((grid - mean) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    for function, shape in ((moment_match, weight @ density), (precision_weighted, None)):
        if shape is None:
            shape = np.exp(weight @ np.log(np.maximum(density, 1e-300)))
        shape = shape / shape.sum()
        centre = shape @ grid
        best_mean, best_variance = function(weight, mean, variance)
        assert best_mean[0] == pytest.approx(centre, abs=1e-6)
        assert best_variance[0] == pytest.approx(shape @ (grid - centre) ** 2, rel=1e-6)


def test_equal_widths_differ_in_width_only() -> None:
    """Two references at ±1, equally wide and likely: both minimisers sit between them, on neither."""
    weight, mean, variance = np.array([0.5, 0.5]), np.array([[-1.0], [1.0]]), np.full((2, 1), 0.04)
    np.testing.assert_allclose(moment_match(weight, mean, variance), [[0.0], [1.04]], atol=1e-12)
    np.testing.assert_allclose(precision_weighted(weight, mean, variance), [[0.0], [0.04]], atol=1e-12)
    sharper = np.array([[0.01], [0.09]])
    np.testing.assert_allclose(precision_weighted(weight, mean, sharper), [[-0.8], [0.018]], atol=1e-12)
    np.testing.assert_allclose(moment_match(weight, mean, sharper), [[0.0], [1.05]], atol=1e-12)


def test_averaged_reverse_kl_does_not_seek_modes() -> None:
    """KL(q ‖ E_b[π]) picks one mode; E_b KL(q ‖ π), which VDPO minimises, sits between them."""
    grid = np.linspace(-4, 4, 4001)
    width = grid[1] - grid[0]

    def log_density(mean: float, deviation: float) -> Array:
        density: Array = -0.5 * ((grid - mean) / deviation) ** 2 - np.log(deviation * np.sqrt(2 * np.pi))
        return density

    left, right = log_density(-1.0, 0.2), log_density(1.0, 0.2)
    both = np.logaddexp(left, right) - np.log(2)

    def to_the_mixture(parameters: Array) -> float:
        own = log_density(parameters[0], np.exp(parameters[1]))
        return float((np.exp(own) * (own - both)).sum() * width)

    mode = minimize(to_the_mixture, np.array([0.3, -1.0]), tol=1e-10).x
    assert mode[0] == pytest.approx(1, abs=1e-3)
    assert np.exp(mode[1]) == pytest.approx(0.2, abs=1e-3)
    between, _ = precision_weighted(np.array([0.5, 0.5]), np.array([[-1.0], [1.0]]), np.full((2, 1), 0.04))
    assert between == pytest.approx(0)


# ---- 5. Fixed points of the other methods (Lemma 3.7, Proposition 3.8) -------------------------------------


@seeds
def test_dida_reaches_the_mixture_only_with_a_likelihood(seed: int) -> None:
    """Discrete actions, DAgger's data: log loss gives the mixture, 0-1 loss the mixture's mode alone."""
    mdp = random_mdp(generator(seed))
    _, expert = soft_optimal(mdp, 0.3)
    belief = augment(mdp, 1).belief[-1]
    target = mixture(belief, expert)
    log_loss = best_distribution(lambda q: -float(target @ np.log(q)), 3)
    np.testing.assert_allclose(log_loss, target, atol=1e-5)
    wrong = [1 - target[action] for action in range(3)]
    assert int(np.argmin(wrong)) == int(target.argmax())
    assert np.abs(np.eye(3)[target.argmax()] - target).max() > 0.01


def test_dida_with_a_deterministic_student_takes_the_median_or_the_mean() -> None:
    """One action per history cannot be the mixture: L1 (the released loss) gives the median."""
    belief, expert = np.array([0.30, 0.25, 0.45]), np.array([-1.0, -0.6, 1.0])
    l1 = minimize_scalar(lambda a: float(belief @ np.abs(expert - a)), bounds=(-1, 1), method="bounded")
    l2 = minimize_scalar(lambda a: float(belief @ (expert - a) ** 2), bounds=(-1, 1), method="bounded")
    assert l1.x == pytest.approx(-0.6, abs=1e-4)
    assert l2.x == pytest.approx(0.0, abs=1e-6)
    assert belief @ expert == pytest.approx(0.0)
    width = np.full((3, 1), 1e-12)
    assert moment_match(belief, expert[:, None], width)[1] == pytest.approx(0.84)  # the mixture's variance, lost


@seeds
@pytest.mark.parametrize("data", ["reference", "delayed", "lower_q"])
def test_imitation_reaches_the_belief_mixture_only_on_its_own_data(seed: int, data: Data) -> None:
    """Forward KL with Δ = 2: DAgger's data gives Eq. (7), the reference's data the posterior mixture."""
    mdp = random_mdp(generator(seed), states=3, actions=2)
    _, reference = soft_optimal(mdp, 0.3)
    delayed = augment(mdp, 2)
    found = imitation_fixed_point(mdp, 2, 0.3, data=data, forward=True)
    gap = np.abs(found - mixture(delayed.belief, reference)).max()
    assert gap < 1e-9 if data == "delayed" else gap > 1e-3
    if data == "reference":
        posterior = state_given_history(mdp, delayed.histories, reference)
        np.testing.assert_allclose(found, mixture(posterior, reference), atol=1e-9)


def test_imitating_the_reference_on_its_own_data_latches() -> None:
    """Tracking, Δ = 2: the student takes its own last action for evidence and repeats it for ever."""
    mdp, temperature = tracking(), 0.1
    delayed = augment(mdp, 2)
    blind = 0.5 / (1 - mdp.discount)
    found = {
        (data, forward): policy_return(
            delayed.mdp, imitation_fixed_point(mdp, 2, temperature, data=data, forward=forward)
        )
        for data in ("reference", "delayed", "lower_q")
        for forward in (True, False)
    }
    assert optimal_return(delayed.mdp) == pytest.approx(16.656, abs=1e-3)
    assert found["delayed", False] == pytest.approx(16.636, abs=2e-3)
    assert found["delayed", True] == pytest.approx(14.500, abs=2e-3)
    assert found["reference", True] < blind + 1.5
    assert found["reference", False] < blind + 2.2
    assert found["lower_q", False] == pytest.approx(found["delayed", False], abs=1e-2)
    assert found["lower_q", True] == pytest.approx(found["delayed", True], abs=1e-2)
    repeats = imitation_fixed_point(mdp, 2, temperature, data="reference", forward=False)
    rows = [delayed.histories.index((state, (0, last))) for state in range(2) for last in range(2)]
    assert [int(repeats[row].argmax()) for row in rows] == [0, 1, 0, 1]


@seeds
@pytest.mark.parametrize("shorter", [0, 1, 2])
def test_ad_sac_reaches_a_geometric_mean(seed: int, shorter: int) -> None:
    """With the auxiliary task solved. Without auxiliary delay it is VDPO's reverse minimiser, not Eq. (7)."""
    mdp, temperature = random_mdp(generator(seed)), 0.3
    auxiliary, delayed = augment(mdp, shorter), augment(mdp, 2)
    q, policy = soft_optimal(auxiliary.mdp, temperature)
    law = shorter_histories(mdp, 2, shorter)
    improved = softmax(law @ q / temperature)
    np.testing.assert_allclose(improved, geometric_mean(law, policy), atol=1e-10)
    _, reference = soft_optimal(mdp, temperature)
    if shorter == 0:
        np.testing.assert_allclose(law, delayed.belief, atol=1e-12)
        np.testing.assert_allclose(improved, geometric_mean(delayed.belief, reference), atol=1e-10)
    if shorter == 2:  # no step is left to average over: this is soft policy iteration on x_t
        np.testing.assert_allclose(improved, soft_optimal(delayed.mdp, temperature)[1], atol=1e-10)
    assert np.abs(improved - mixture(delayed.belief, reference)).max() > 0.1


@seeds
def test_bpql_has_a_fixed_point_of_its_own(seed: int) -> None:
    """A geometric mean of what its own critic finds soft-greedy; neither mean of the delay-free optimum."""
    mdp, temperature = random_mdp(generator(seed), states=3), 0.3
    q, policy = bpql_fixed_point(mdp, 1, temperature)
    belief = augment(mdp, 1).belief
    free_q, reference = soft_optimal(mdp, temperature)
    np.testing.assert_allclose(policy, geometric_mean(belief, softmax(q / temperature)), atol=1e-10)
    assert (q < free_q - 1e-3).all()  # its critic knows that the next action will be late too
    assert np.abs(policy - geometric_mean(belief, reference)).max() > 1e-3
    assert np.abs(policy - mixture(belief, reference)).max() > 0.1
    assert np.abs(policy - mixture(belief, softmax(q / temperature))).max() > 0.1


@seeds
@pytest.mark.parametrize("delay", [1, 2])
def test_all_fixed_points_agree_without_noise(seed: int, delay: int) -> None:
    """Deterministic transitions: every belief is a point, where every method has the reference's policy."""
    mdp, temperature = random_mdp(generator(seed), states=3, actions=2, deterministic=True), 0.3
    delayed = augment(mdp, delay)
    _, reference = soft_optimal(mdp, temperature)
    expected = delayed.belief @ reference
    for policy in (
        mixture(delayed.belief, reference),
        geometric_mean(delayed.belief, reference),
        bpql_fixed_point(mdp, delay, temperature)[1],
        soft_optimal(delayed.mdp, temperature)[1],
        imitation_fixed_point(mdp, delay, temperature, data="reference", forward=True),
        imitation_fixed_point(mdp, delay, temperature, data="lower_q", forward=False),
    ):
        np.testing.assert_allclose(policy, expected, atol=1e-8)
    assert policy_return(delayed.mdp, expected) == pytest.approx(policy_return(mdp, reference), abs=1e-8)


# ---- 6. What the choice costs ------------------------------------------------------------------------------


@pytest.mark.parametrize(("wrong_cost", "mixture_wins"), [(0.0, True), (0.5, True), (2.0, False), (4.0, False)])
def test_either_mean_can_be_the_better_one(wrong_cost: float, mixture_wins: bool) -> None:
    """Guess a side that stays hidden: the mixture guesses at once, the geometric mean waits for ever."""
    mdp = guessing_game(wrong_cost)
    delayed = augment(mdp, 1)
    _, reference = soft_optimal(mdp, 0.02)
    guess = mdp.discount * (1 - wrong_cost) / 2
    wait = -0.02 * mdp.discount / (1 - mdp.discount)
    by_mixture = policy_return(delayed.mdp, mixture(delayed.belief, reference))
    by_geometric = policy_return(delayed.mdp, geometric_mean(delayed.belief, reference))
    best = optimal_return(delayed.mdp)
    assert by_mixture == pytest.approx(guess, abs=1e-2)
    assert by_geometric == pytest.approx(wait, abs=1e-2)
    assert best == pytest.approx(max(guess, wait), abs=1e-9)
    assert (by_mixture > by_geometric) is mixture_wins
    assert best - min(by_mixture, by_geometric) > 0.25  # a gap that no number of samples closes (Lemma 3.5)


@pytest.mark.parametrize("seed", range(10))
def test_geometric_mean_wins_on_random_mdps(seed: int) -> None:
    """And no delayed policy beats the best delayed policy."""
    mdp, temperature = random_mdp(generator(seed)), 0.1
    delayed = augment(mdp, 2)
    _, reference = soft_optimal(mdp, temperature)
    by_mixture = policy_return(delayed.mdp, mixture(delayed.belief, reference))
    by_geometric = policy_return(delayed.mdp, geometric_mean(delayed.belief, reference))
    assert by_mixture < by_geometric <= optimal_return(delayed.mdp) + 1e-9


def test_occupancy_is_a_distribution() -> None:
    mdp = random_mdp(generator(0))
    _, policy = soft_optimal(mdp, 0.3)
    share = occupancy(mdp, policy)
    assert share.sum() == pytest.approx(1)
    reward = (policy * mdp.reward).sum(axis=1)
    assert share @ reward == pytest.approx((1 - mdp.discount) * policy_return(mdp, policy))
