"""Travel times drawn on a device have the probabilities of the laws, and their numbers may change."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from delayrl import DelayRLError
from delayrl.batched import as_batched, per_episode
from delayrl.batched.delay import BatchedDelay
from delayrl.batched.laws import Law, draw
from delayrl.delays import Markov, as_delay
from delayrl.delays.episodes import Sum
from own_laws import Burst

ROBOTS, MESSAGES = 3000, 4
TEXTS = (
    "uniform:1:4@raw",
    "choice:1=0.1,5=0.9",
    "poisson:2:5",
    "gamma:3:1.5:6",
    "gilbert:1:4:0.2:0.6",
    "walk:3:0.5",
    "markov:0,2:0.9,0.1/0.5,0.5",
    "recorded:0,3,3,1,2,",
    "episode:2:4",
    "episode:gilbert:1:3:0.2:0.6",
)


@jax.jit
def travel_times(law: Law, seed: int) -> jax.Array:
    """Draw the first messages of many episodes, [ROBOTS, MESSAGES]."""

    def episode(key: jax.Array) -> jax.Array:
        def message(state: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
            travel, state = draw(law, state, key)
            return state, travel

        return jax.lax.scan(message, jnp.zeros((), jnp.int32), jax.random.split(key, MESSAGES))[1]

    return jax.vmap(episode)(jax.random.split(jax.random.key(seed), ROBOTS))


def pairs(times: np.ndarray, longest: int) -> np.ndarray:
    """Count the first and the last message of each episode together, [longest + 1, longest + 1]."""
    return np.bincount(times[:, 0] * (longest + 1) + times[:, -1], minlength=(longest + 1) ** 2)


@pytest.mark.parametrize("text", TEXTS)
def test_draws_have_the_probabilities_of_the_law(text: str) -> None:
    """First and last message together, so that what a chain or an episode remembers counts; chi-square, p > 0.001."""
    law = as_delay(text).observation.law
    random, theirs = np.random.default_rng(0), []
    for _ in range(8 * ROBOTS):
        state, times = 0, []
        for _ in range(MESSAGES):
            travel, state = law.draw(state, random)
            times.append(travel)
        theirs.append(times)
    ours = np.asarray(travel_times(as_batched(text).observation.law, 1))
    counts = np.stack([pairs(ours, law.maximum), pairs(np.array(theirs), law.maximum)])
    often = counts.sum(0) > 40
    assert not counts[0, counts[1] == 0].any(), "a pair that the law does not give"
    assert stats.chi2_contingency(counts[:, often]).pvalue > 1e-3


def test_a_choice_by_its_own_probabilities() -> None:
    ours = np.asarray(travel_times(as_batched("choice:0=0.5,2=0.3,5=0.2").observation.law, 2)).ravel()
    counts = np.bincount(ours, minlength=6)
    assert counts[[1, 3, 4]].tolist() == [0, 0, 0]
    assert stats.chisquare(counts[[0, 2, 5]], ours.size * np.array([0.5, 0.3, 0.2])).pvalue > 1e-3


def test_a_chain_starts_in_its_stationary_distribution() -> None:
    law = as_delay("markov:0,2:0.9,0.1/0.5,0.5").observation.law
    assert isinstance(law, Markov)
    first = np.asarray(travel_times(as_batched("markov:0,2:0.9,0.1/0.5,0.5").observation.law, 3))[:, 0]
    counts = np.bincount(first, minlength=3)[[0, 2]]
    assert stats.chisquare(counts, ROBOTS * np.array([5 / 6, 1 / 6])).pvalue > 1e-3


def test_a_recording_plays_in_order() -> None:
    steps = np.array([0, 3, 4, 1, 2])
    times = np.asarray(travel_times(as_batched("recorded:0,3,4,1,2,").observation.law, 4))
    begins = np.argsort(steps)[times[:, 0]]
    np.testing.assert_array_equal(times, steps[(begins[:, None] + np.arange(MESSAGES)) % 5])


def test_ranges_differ_per_environment_and_change_without_compiling() -> None:
    """Each robot draws from its own range; another range of the same maximum runs in the same program."""
    low, high = np.array([0, 2, 5]), np.array([1, 4, 5])
    delay = replace(BatchedDelay(), observation=per_episode(low, high, maximum=6))
    compiled = 0

    @jax.jit
    def drawn(delay: BatchedDelay, seed: int) -> jax.Array:
        nonlocal compiled
        compiled += 1
        keys = jax.random.split(jax.random.key(seed), (len(low), 200))
        zero = jnp.zeros((), jnp.int32)
        one = jax.vmap(lambda law, key: draw(law, zero, key)[0], in_axes=(None, 0))
        return jax.vmap(one, in_axes=(delay.axes().observation.law, 0))(delay.observation.law, keys)

    for shift in (0, 1):
        moved = replace(delay, observation=per_episode(low + shift, high + shift, maximum=6))
        times = np.asarray(drawn(moved, 0))
        assert [sorted(set(row)) for row in times.tolist()] == [
            list(range(first + shift, last + shift + 1)) for first, last in zip(low, high, strict=True)
        ]
    assert compiled == 1


def test_what_needs_no_law() -> None:
    """Constant delays and held back messages have no numbers, so nothing is drawn."""
    delay = as_batched("3+action=uniform:1:2@wait+reward=4")
    assert not jax.tree.leaves(delay)
    assert (delay.maximum, delay.action.maximum, delay.reward.maximum) == (5, 2, 4)
    assert as_batched(delay) is delay
    assert as_batched(per_episode(1, 2)).observation.maximum == 2
    none = replace(as_batched("2"), action=per_episode([0, 0], 0))
    assert (none.action, none.maximum) == (as_batched("2").action, 2)
    assert as_batched("80ms", step_seconds=0.04).observation.maximum == 2


def test_bad_input() -> None:
    for make, words in (
        (lambda: as_batched(Burst()), "runs in Python, .* give delayrl.delays.Recorded"),
        (lambda: as_batched(as_delay("uniform:1:2+action=episode:1:2").observed()), "runs in Python"),
        (lambda: jax.jit(lambda high: per_episode(0, high).maximum)(3), "no bound: give maximum="),
        (lambda: per_episode([2, 3], [1, 4]), r"low ≤ high; got \[2, 3\] and \[1, 4\]"),
        (lambda: per_episode(-1, 2), "negative"),
        (lambda: per_episode(1, 2.5), "whole environment steps; got 2.5; for a time write 2.5s"),
        (lambda: per_episode([0, 1], [2, 3, 4]), r"one for each environment; got \[0, 1\] and \[2, 3, 4\]"),
        (lambda: per_episode([], []), "one for each environment"),
        (lambda: per_episode([[0, 1]], [[2, 3]]), "one for each environment"),
        (lambda: per_episode(0, 7, maximum=6), "up to 7 steps is above its maximum of 6"),
    ):
        with pytest.raises(DelayRLError, match=words):
            make()
    assert isinstance(as_delay("uniform:1:2+action=episode:1:2").observed().observation.law, Sum)
