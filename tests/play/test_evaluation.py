"""Evaluation of a run, under its delay or a shorter one."""

import jax
import pytest

import delayrl
from delayrl.play.evaluation import Evaluator, evaluate
from delayrl.run.folder import Run


def test_any_shorter_delay(vdpo: Run) -> None:
    assert len({evaluate(vdpo.path, 2, delay)["mean_return"] for delay in (0, 1, 2, 3)}) == 4
    with pytest.raises(delayrl.DelayRLError, match="up to 3"):
        evaluate(vdpo.path, 2, 4)


def test_a_policy_is_evaluated_in_single_precision(vdpo: Run, monkeypatch) -> None:
    """`evaluate` too, where a GPU would multiply more coarsely."""
    played, found = Evaluator.__call__, []

    def watched(self, *args):
        found.append(jax.config.jax_default_matmul_precision)
        return played(self, *args)

    monkeypatch.setattr(Evaluator, "__call__", watched)
    evaluate(vdpo.path, 1)
    assert found == ["float32"]
