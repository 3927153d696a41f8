"""What the delayed methods converge to, and what that costs, on small MDPs; docs/theory.md, sections 5 and 6.

Here every fixed point is a formula or an iteration on arrays. test_fixed_points.py finds them with the agents' own
updates.
"""

import itertools

import numpy as np
import pytest
from fixed_points import (
    Data,
    adsac_fixed_point,
    any_age_fixed_point,
    bpql_fixed_point,
    imitation_fixed_point,
    lower_value,
    pulled_by_kl,
    pulled_by_squares,
    shorter_histories,
)
from gaussians import moment_match
from scipy.optimize import minimize_scalar
from tabular import (
    MDP,
    augment,
    geometric_mean,
    guessing_game,
    kl,
    mixture,
    optimal_return,
    policy_return,
    random_mdp,
    soft_optimal,
    softmax,
    state_given_history,
    tracking,
)

seeds = pytest.mark.parametrize("seed", range(4))
two_seeds = pytest.mark.parametrize("seed", range(2))  # where fixed points take seconds


# ---- 5. Fixed points of the other methods (Lemma 3.7, Proposition 3.8) -------------------------------------


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


def test_older_views_than_the_shown_one_are_confounded() -> None:
    """Tracking under `uniform:1:3`: an action tells of hidden states, but not in samples of the view's own age."""
    chain = tracking().transition[:, 0]
    joint = {"all": np.zeros(2), "own age": np.zeros(2)}  # of s_t, where s_{t-3} = 0 and a_{t-1} = 1
    for delays in itertools.product((1, 2, 3), repeat=4):  # of s_{t-4} to s_{t-1}
        arrival = {row: row + delay for row, delay in zip(range(-4, 0), delays, strict=True)}
        newest = {now: max(row for row in arrival if arrival[row] <= now) for now in (-1, 0)}
        for states in itertools.product((0, 1), repeat=5):  # s_{t-4} to s_t
            if states[1] != 0 or states[newest[-1] + 4] != 1:  # the agent names the newest state that it has seen
                continue
            chance = np.prod([chain[one, two] for one, two in itertools.pairwise(states)])
            joint["all"][states[-1]] += chance
            joint["own age"][states[-1]] += chance * (newest[0] == -3)
    belief = np.linalg.matrix_power(chain, 3)[0, 1]
    assert joint["all"][1] / joint["all"].sum() == pytest.approx(0.5896)
    assert joint["own age"][1] / joint["own age"].sum() == pytest.approx(belief) == pytest.approx(0.244)


@seeds
@pytest.mark.parametrize("data", ["reference", "delayed", "lower_q"])
def test_imitation_reaches_the_belief_mixture_only_on_its_own_data(seed: int, data: Data) -> None:
    """Forward KL with Δ = 2: DAgger's data gives Eq. (7), the reference's data the posterior mixture."""
    mdp = random_mdp(np.random.default_rng(seed), states=3, actions=2)
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
def test_bpql_has_a_fixed_point_of_its_own(seed: int) -> None:
    """Neither mean of the delay-free optimum, nor the mixture of what its own critic finds soft-greedy."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3), 0.3
    q, policy = bpql_fixed_point(mdp, 1, temperature)
    belief = augment(mdp, 1).belief
    free_q, reference = soft_optimal(mdp, temperature)
    assert (q < free_q - 1e-3).all()  # its critic knows that the next action will be late too
    assert np.abs(policy - geometric_mean(belief, reference)).max() > 1e-3
    assert np.abs(policy - mixture(belief, reference)).max() > 0.1
    assert np.abs(policy - mixture(belief, softmax(q / temperature))).max() > 0.1


@pytest.mark.thorough
@pytest.mark.parametrize(("seed", "policy_gap", "value_gap"), [(0, 0.093, 2.249), (1, 0.183, 6.285), (2, 0.044, 0.605)])
def test_ad_sac_is_not_vdpo(seed: int, policy_gap: float, value_gap: float) -> None:
    """Its critics hold the lower of two actors' values, so without auxiliary delay Q lies below Q* under noise."""
    mdp, temperature = random_mdp(np.random.default_rng(seed)), 0.3
    belief = augment(mdp, 2).belief
    free_q, reference = soft_optimal(mdp, temperature)
    q, policy = adsac_fixed_point(mdp, 2, temperature)
    assert np.abs(policy - geometric_mean(belief, reference)).max() == pytest.approx(policy_gap, abs=1e-3)
    assert (free_q - q).max() == pytest.approx(value_gap, abs=1e-3)
    assert (q < free_q).all()


@two_seeds
def test_ad_sac_is_a_more_cautious_bpql(seed: int) -> None:
    """The delayed actor's mean value is the lower one, which is BPQL's; the minimum of samples lies below both."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3, actions=2), 0.3
    bpql, adsac = bpql_fixed_point(mdp, 2, temperature), adsac_fixed_point(mdp, 2, temperature)
    assert (adsac.q < bpql.q - 0.02).all()
    assert (bpql.q < soft_optimal(mdp, temperature)[0] - 0.02).all()
    assert np.abs(adsac.policy - bpql.policy).max() < 0.02


# ---- any-age: the pull of younger policies on older ones ---------------------------------------------------


@seeds
@pytest.mark.parametrize("younger", [0, 1, 2])
def test_a_pull_by_kl_has_no_bias(seed: int, younger: int) -> None:
    """Towards the soft-greedy policy of any younger view, with any weight: what it asks for is BPQL's policy itself."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3, actions=2), 0.3
    q, policy = bpql_fixed_point(mdp, 2, temperature)
    belief = augment(mdp, 2).belief
    shorter = softmax(augment(mdp, younger).belief @ q / temperature)
    log_younger = shorter_histories(mdp, 2, younger) @ np.log(shorter)
    for weight in (0.1, 1.0, 10.0):
        found = pulled_by_kl(belief @ q, log_younger, temperature, weight)
        np.testing.assert_allclose(found, policy, atol=1e-9)
        rng, objective = np.random.default_rng(7), any_age_objective(belief @ q, temperature, weight)
        for _ in range(20):  # and it is the minimum
            other = rng.dirichlet(np.ones(2), size=len(policy))
            own, others = (objective(p) - weight * (p * log_younger).sum(1) for p in (found, other))
            assert (own <= others + 1e-12).all()


def any_age_objective(averaged: np.ndarray, temperature: float, weight: float):
    """½ E[α log π - Q] + w Σ π log π, to which the pull adds -w Σ π E[log π_j]."""
    return lambda p: ((0.5 * temperature + weight) * p * np.log(p) - 0.5 * p * averaged).sum(1)


@pytest.mark.parametrize(
    ("mdp", "delay", "temperature", "fresh", "late"),
    [(random_mdp(np.random.default_rng(0)), 2, 0.3, 5.442, 4.087), (tracking(), 1, 0.1, 19.999, 18.095)],
)
def test_what_the_delay_costs_any_age(mdp: MDP, delay: int, temperature: float, fresh: float, late: float) -> None:
    """Returns of one agent's policies at age 0 and at age Δ, as in the table of `docs/theory.md`."""
    q, policy = bpql_fixed_point(mdp, delay, temperature)
    assert policy_return(mdp, softmax(q / temperature)) == pytest.approx(fresh, abs=1e-3)
    assert policy_return(augment(mdp, delay).mdp, policy) == pytest.approx(late, abs=1e-3)


@two_seeds
def test_a_pull_by_squares_is_a_bias_until_it_is_gone(seed: int) -> None:
    """It asks for the mixture, more so with a larger weight; without a weight, or without noise, it is BPQL."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3, actions=2), 0.3
    bpql = bpql_fixed_point(mdp, 2, temperature)
    gaps = []
    for weight in (0.0, 0.1, 1.0, 10.0):
        _, policy = any_age_fixed_point(mdp, 2, temperature, weight, "squares")
        np.testing.assert_allclose(policy.sum(1), 1, atol=1e-9)
        gaps.append(np.abs(policy - bpql.policy).max())
    assert gaps[0] < 1e-9
    assert gaps == sorted(gaps)
    assert gaps[-1] > 0.02
    kl_pull = any_age_fixed_point(mdp, 2, temperature, 10.0, "kl")
    np.testing.assert_allclose(kl_pull.policy, bpql.policy, atol=1e-8)
    certain = random_mdp(np.random.default_rng(seed), states=3, actions=2, deterministic=True)
    free = bpql_fixed_point(certain, 2, temperature).policy
    np.testing.assert_allclose(any_age_fixed_point(certain, 2, temperature, 10.0, "squares").policy, free, atol=1e-6)


@seeds
def test_the_pull_by_squares_is_at_its_minimum(seed: int) -> None:
    """No other distribution has a lower objective than what the formula with Wright's omega gives."""
    rng = np.random.default_rng(seed)
    averaged, mean = rng.normal(size=(50, 4)), rng.dirichlet(np.ones(4), size=50)

    def objective(p: np.ndarray) -> np.ndarray:
        return 0.5 * (0.3 * (p * np.log(p)).sum(1) - (p * averaged).sum(1)) + 2.0 * ((p - mean) ** 2).sum(1)

    found = pulled_by_squares(averaged, mean, 0.3, 2.0)
    for spread in (1e-3, 0.1, 1.0):
        other = (1 - spread) * found + spread * rng.dirichlet(np.ones(4), size=50)
        assert (objective(found) < objective(other)).all()


@seeds
def test_the_minimum_of_samples_costs_a_positive_part(seed: int) -> None:
    """E min(V, Q - α log π) = E[Q - α log π] - α E[(log π_Q - log π)⁺], a ~ π, for any critic and policies."""
    rng = np.random.default_rng(seed)
    q, policy, temperature = rng.normal(size=(5, 3)), rng.dirichlet(np.ones(3), size=5), 0.3
    late = q - temperature * np.log(policy)
    greedy = softmax(q / temperature)
    cost = temperature * (policy * np.maximum(np.log(greedy / policy), 0)).sum(axis=1)
    lower = (policy * lower_value(q, late, temperature)).sum(axis=1)
    np.testing.assert_allclose(lower, (policy * late).sum(axis=1) - cost, atol=1e-12)
    assert (cost > 1e-3).all()
    assert (cost <= temperature * kl(policy, greedy) + temperature * np.exp(-1)).all()


@seeds
def test_ad_sac_with_the_full_auxiliary_delay_is_a_sac(seed: int) -> None:
    """Both actors are then one, and the minimum of equal values costs nothing."""
    mdp, temperature = random_mdp(np.random.default_rng(seed)), 0.3
    q, policy = soft_optimal(augment(mdp, 2).mdp, temperature)
    found = adsac_fixed_point(mdp, 2, temperature, shorter=2)
    np.testing.assert_allclose(found.q, q, atol=1e-9)
    np.testing.assert_allclose(found.policy, policy, atol=1e-9)


@seeds
def test_a_longer_auxiliary_delay_averages_over_shorter_histories(seed: int) -> None:
    """π_Δ is a geometric mean over x^τ given x, of policies that are soft-greedy for AD-SAC's critic."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3, actions=2), 0.3
    q, policy = adsac_fixed_point(mdp, 2, temperature, shorter=1)
    law = shorter_histories(mdp, 2, 1)
    np.testing.assert_allclose(policy, geometric_mean(law, softmax(q / temperature)), atol=1e-9)
    solved, _ = soft_optimal(augment(mdp, 1).mdp, temperature)
    assert (q < solved - 1e-3).all()  # the auxiliary task's own values know nothing of the longer delay


@seeds
@pytest.mark.parametrize("delay", [1, 2])
def test_all_fixed_points_agree_without_noise(seed: int, delay: int) -> None:
    """Deterministic transitions: every belief is a point, where every method has the reference's policy."""
    mdp, temperature = random_mdp(np.random.default_rng(seed), states=3, actions=2, deterministic=True), 0.3
    delayed = augment(mdp, delay)
    _, reference = soft_optimal(mdp, temperature)
    expected = delayed.belief @ reference
    for policy in (
        mixture(delayed.belief, reference),
        geometric_mean(delayed.belief, reference),
        bpql_fixed_point(mdp, delay, temperature).policy,
        adsac_fixed_point(mdp, delay, temperature).policy,
        adsac_fixed_point(mdp, delay, temperature, data="lower_q").policy,
        soft_optimal(delayed.mdp, temperature)[1],
        imitation_fixed_point(mdp, delay, temperature, data="reference", forward=True),
        imitation_fixed_point(mdp, delay, temperature, data="lower_q", forward=False),
    ):
        np.testing.assert_allclose(policy, expected, atol=1e-8)
    free_q, _ = soft_optimal(mdp, temperature)
    np.testing.assert_allclose(adsac_fixed_point(mdp, delay, temperature).q, free_q, atol=1e-8)
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
    mdp, temperature = random_mdp(np.random.default_rng(seed)), 0.1
    delayed = augment(mdp, 2)
    _, reference = soft_optimal(mdp, temperature)
    by_mixture = policy_return(delayed.mdp, mixture(delayed.belief, reference))
    by_geometric = policy_return(delayed.mdp, geometric_mean(delayed.belief, reference))
    assert by_mixture < by_geometric <= optimal_return(delayed.mdp) + 1e-9
