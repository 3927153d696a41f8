"""Evaluation of a run, under its delay or a shorter one."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import delayrl
from delayrl.core.types import Seen, Spec
from delayrl.envs.making import make
from delayrl.play.evaluation import EVALUATION, HELD_OUT, RANDOM_ACTIONS, TRAINING, Evaluator, evaluate, reset_seed
from delayrl.play.run import Run
from own_tasks import failing


def test_any_shorter_delay(vdpo: Run) -> None:
    assert len({evaluate(vdpo.path, 2, delay)["mean_return"] for delay in (0, 1, 2, 3)}) == 4
    with pytest.raises(delayrl.DelayRLError, match="up to 3"):
        evaluate(vdpo.path, 2, 4)


def test_a_policy_is_evaluated_in_single_precision(vdpo: Run, monkeypatch) -> None:
    """`evaluate` too, where a GPU would multiply more coarsely; on start states that the run has not seen."""
    played, found = Evaluator.__call__, []

    def watched(self, *args):
        found.append((jax.config.jax_default_matmul_precision, args[1]))
        return played(self, *args)

    monkeypatch.setattr(Evaluator, "__call__", watched)
    evaluate(vdpo.path, 1)
    assert found == [("float32", [[reset_seed(0, HELD_OUT, 0)]])]


def test_streams_are_apart() -> None:
    assert len({TRAINING, EVALUATION, RANDOM_ACTIONS, HELD_OUT}) == 4


@dataclass(frozen=True)
class Shaky:
    """It acts with noise, and differently if it is told to explore; with `ages`, with a tenth of the age."""

    ages: bool = False

    def act(self, state: Any, seen: Seen, key: Any, *, explore: bool) -> jax.Array:
        return seen.age[None] / 10 if self.ages else jax.random.uniform(key, (1,)) + explore


def test_episodes_by_hand() -> None:
    """Every episode: its noise of seed, step and episode, its opening, its return and length."""
    resets, keys = [[1, 2], [3, 4]], jax.vmap(jax.random.key)(jnp.arange(2))
    opening = np.random.default_rng(0).uniform(-1, 1, (2, 2, 2, 1)).astype(np.float32)
    evaluator = Evaluator(Shaky(), Spec(1, 1, 1), "delayrl/Walk-v0", 1, 2, 2)  # type: ignore[arg-type]
    played = evaluator(jnp.zeros(2), resets, keys, opening)
    for i in range(2):
        for j in range(2):
            env, total = make("delayrl/Walk-v0"), 0.0
            env.reset(seed=resets[i][j])
            for step in range(50):
                key = jax.random.fold_in(jax.random.fold_in(keys[i], step), j)
                action = opening[i, j, step] if step < 2 else np.asarray(jax.random.uniform(key, (1,)))
                total += env.step(action)[1]
            np.testing.assert_allclose(played.returns[i, j], total, rtol=1e-5)
    assert (played.lengths == 50).all()


def test_what_cannot_be_played(vdpo: Run) -> None:
    """A task of other sizes, half an episode, a seed that is none, and an environment that fails."""
    line = "the policy takes observations of size 10 and gives actions of size 2; Pendulum-v1 has sizes 3 and 1"
    with pytest.raises(delayrl.DelayRLError, match=f"^{line}$"):
        evaluate(vdpo.policy(), 2, env="Pendulum-v1")
    with pytest.raises(delayrl.DelayRLError, match=r"^episodes must be a whole number, at least 1; got 2\.5$"):
        evaluate(vdpo, 2.5)  # type: ignore[arg-type]
    with pytest.raises(delayrl.DelayRLError, match=r"^a seed must be a whole number from 0 to 2147483647; got 1\.5$"):
        evaluate(vdpo, seed=1.5)  # type: ignore[arg-type]
    for method in ("reset", "step"):
        evaluator = Evaluator(Shaky(), Spec(1, 1, 1), failing(method), 1, 1, 1)  # type: ignore[arg-type]
        with pytest.raises(delayrl.DelayRLError, match=f"^Failing failed in {method}: ZeroDivisionError: .*own_tasks"):
            evaluator(jnp.zeros(1), [[1]], jax.random.key(0)[None])


def test_late_rewards_change_no_return() -> None:
    """Evaluation counts a reward when it is earned, and an episode has the task's length."""
    returns = []
    for delay in ("1", "1+reward=3"):
        evaluator = Evaluator(Shaky(), Spec(2, 1, 1), "delayrl/Counter-v0", delay, 1, 3)  # type: ignore[arg-type]
        played = evaluator(jnp.zeros(1), [[1, 2, 3]], jax.random.key(0)[None])
        np.testing.assert_array_equal(played.returns, played.lengths * (played.lengths + 1) / 2)
        returns.append(played.lengths.tolist())
    assert returns[0] == returns[1]


def test_travel_times_may_have_seeds_of_their_own() -> None:
    """They are those of an episode that was reset with this seed."""
    evaluator = Evaluator(Shaky(ages=True), Spec(1, 1, 3), "delayrl/Walk-v0", "uniform:0:3", 1, 1)  # type: ignore[arg-type]
    key, one, other = jax.random.key(0)[None], [[1]], [[2]]
    same = [evaluator(jnp.zeros(1), one, key, None, travel).returns.item() for travel in (None, one, other)]
    assert same[0] == same[1] != same[2]
