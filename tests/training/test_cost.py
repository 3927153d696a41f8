"""What learning costs: counted by hand, and by the optimisers of a run."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from delayrl.agents.adsac import ADSAC
from delayrl.agents.base import Phase, Schedule
from delayrl.agents.dida import DIDA
from delayrl.agents.random import Random
from delayrl.agents.sac import BPQL, SAC
from delayrl.core.precision import BFLOAT16, FEW, product
from delayrl.core.types import Spec
from delayrl.core.views import input_size
from delayrl.play.run import Run
from delayrl.run.cost import Cost
from delayrl.training.cost import cost_of, update_counts
from delayrl.training.products import follow, matmul_flops, traced_updates
from short_runs import arrays

SPEC, SCHEDULE = Spec(10, 3, 4), Schedule(steps=2_099, random_steps=100)
VIEWS: dict[str, Any] = {"actor_sees": "augmented", "critic_sees": "current"}


def test_parameters_by_hand() -> None:
    """Without target critics and Adam's moments: an actor on x_t, two critics on s_t, one temperature."""
    cost = cost_of(SAC(**VIEWS, hidden=(8, 8)), SPEC, SCHEDULE)
    actor = input_size(SPEC, "augmented") * 8 + 8 + 8 * 8 + 8 + 8 * 6 + 6
    critic = 13 * 8 + 8 + 8 * 8 + 8 + 8 + 1
    assert cost.parameters == actor + 2 * critic + 1


def test_steps_of_optimisers_by_hand() -> None:
    critic = cost_of(SAC(hidden=(8,), actor_every=5, actor_updates=2), Spec(10, 3, 0), SCHEDULE)
    assert critic.gradient_steps == {"actor": 0.4, "critic": 1.0, "temperature": 0.4}
    rounds = cost_of(
        SAC(hidden=(8,), actor_every=1, actor_updates=1, update_every=50, updates=25), Spec(10, 3, 0), SCHEDULE
    )
    assert rounds.gradient_steps == {"actor": 0.5, "critic": 0.5, "temperature": 0.5}
    coin = cost_of(ADSAC(SAC(hidden=(8,), actor_sees="augmented", critic_sees="augmented")), SPEC, SCHEDULE)
    halves = {"actor": 0.5, "auxiliary.actor": 0.5, "auxiliary.critic": 1.0, "auxiliary.temperature": 1.0}
    assert coin.gradient_steps == halves | {"temperature": 1.0}
    assert cost_of(Random(), SPEC, SCHEDULE) == Cost(0, {}, (), 0.0)


def test_an_expert_that_stops_and_a_student_that_begins() -> None:
    """DIDA's expert learns from step 100 to step 1,100, half of the updates; then its student, without a counter."""
    agent = DIDA(SAC(hidden=(8,)), expert_steps=1_100, round_steps=10, imitation_updates=20)
    cost = cost_of(agent, SPEC, SCHEDULE)
    assert cost.gradient_steps["reference.critic"] == pytest.approx(1001 / 2000, abs=5e-4)
    assert cost.gradient_steps["networks"] == pytest.approx(2 * 100 / 200, abs=0.02)
    assert cost.batches == (agent.reference.batch_size, agent.student_batch_size)


def test_the_cost_does_not_depend_on_the_precision() -> None:
    """Whatever was asked first: in bfloat16 the products are written out, with gradients that nobody takes."""

    def flops(precision: str) -> tuple[float, float]:
        traced_updates.cache_clear()
        with jax.default_matmul_precision(precision):
            return cost_of(BPQL, SPEC, SCHEDULE).flops, matmul_flops(lambda x: product(x, x), jnp.ones((FEW, FEW)))

    assert flops(BFLOAT16[1]) == flops("float32")
    traced_updates.cache_clear()


def test_flops_are_those_of_the_branches_that_are_taken() -> None:
    every = [cost_of(SAC(**VIEWS, actor_every=n, actor_updates=1), SPEC, SCHEDULE).flops for n in (1, 2, 4)]
    actor = (every[0] - every[1]) * 2
    assert every[1] - every[2] == pytest.approx(actor / 4)
    assert 0 < actor < every[0]
    assert cost_of(BPQL, SPEC, SCHEDULE).flops == pytest.approx(every[0], rel=1e-3)  # 50 updates every 50 steps


def test_a_run_takes_the_steps_that_its_configuration_names(vdpo: Run) -> None:
    cost, counted = Cost.from_json(vdpo.config["cost"]), arrays(vdpo)
    updates = 300 - 100 + 1
    for name, steps in cost.gradient_steps.items():
        expected = 5 * 5 if name == "clone" else steps * updates  # five rounds of five
        assert counted[f"{name}_opt_state.0.count"] == pytest.approx(expected, abs=0.2), name
    assert cost.gradient_steps["clone"] == 0.1
    trained = [x for name, x in counted.items() if "opt_state" not in name and "target" not in name]
    assert cost.parameters == sum(x.size for x in trained if x.dtype.kind == "f")


def test_branches_are_known_where_the_count_decides() -> None:
    x = jnp.ones((2, 3))

    def program(count: jax.Array, data: jax.Array) -> jax.Array:
        inner = lambda: jax.lax.cond(count // 4 % 2 == 0, lambda: (x @ x.T).sum(), lambda: 0.0)  # noqa: E731
        known = jax.lax.cond(count % 3 == 1, inner, lambda: (x @ x.T @ x).sum())
        return known + jax.lax.cond(data > 0, lambda: (x @ x.T).sum(), lambda: 0.0)

    counts = np.arange(24)
    products, _ = follow(jax.make_jaxpr(program)(jnp.int32(0), 1.0).jaxpr, [counts, None])
    once = 2 * 2 * 2 * 3
    taken = counts % 3 == 1
    inner = (taken & (counts // 4 % 2 == 0)).mean()
    assert sum(p.flops for p in products) == pytest.approx(once * (inner + 2 * (~taken).mean() + 0.5))


def test_booleans_and_fractions_of_the_count() -> None:
    """They may decide too: booleans that are added, quotients, and what is rounded to an integer or taken for truth."""
    x = jnp.ones((2, 3))

    def program(count: jax.Array) -> jax.Array:
        even, third = ((count % n == 0).astype(jnp.int32) for n in (2, 3))
        gates = (even + third == 2, even - third < 0, count / 10 < 0.5, (count / 10).astype(jnp.int32) == 1)
        gates += ((even - third).astype(bool), (count - 20) // 7 == -2, ((count // 10) & 1) == 1)
        gates += (((count / 10).astype(jnp.int32) | 1) == 1, ~(count // 10) == -2, (count * 20).astype(jnp.uint8) < 100)
        return sum(jax.lax.cond(gate, lambda: (x @ x.T).sum(), lambda: 0.0) for gate in gates)

    counts = np.arange(24)
    products, _ = follow(jax.make_jaxpr(program)(jnp.int32(0)).jaxpr, [counts])
    even, third = counts % 2 == 0, counts % 3 == 0
    gates = (even & third, third & ~even, counts < 5, counts // 10 == 1, even != third, (counts - 20) // 7 == -2)
    gates += (counts // 10 == 1, counts < 20, counts // 10 == 1, counts * 20 % 256 < 100)
    assert [p.flops for p in products] == [pytest.approx(24 * gate.mean()) for gate in gates]


def test_a_loop_of_unknown_length_has_unknown_flops() -> None:
    x = jnp.ones((3, 3))
    loop = lambda y: jax.lax.while_loop(lambda y: y.sum() < 9, lambda y: y @ x, y)  # noqa: E731
    assert np.isnan(matmul_flops(loop, x))
    cost = Cost(1, {"critic": 1.0}, (2,), float("nan"))
    assert cost.json["flops"] is None
    assert np.isnan(Cost.from_json(cost.json).flops)


@pytest.mark.parametrize(
    ("every", "updates", "first", "last"), [(1, 1, 100, 300), (50, 5, 100, 300), (50, 50, 101, 999)]
)
def test_updates_are_counted_as_the_learner_does(every: int, updates: int, first: int, last: int) -> None:
    due = [step for step in range(last + 1) if step >= first and step % every == 0]
    expected = [step // every * updates + i for step in due for i in range(updates)]
    assert update_counts(Phase(every, updates, 1, None), first, last).tolist() == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("steps", [1_000_000, 2_000_000_000])
@pytest.mark.parametrize("period", [2, 3, 4, 5, 8])
def test_of_many_updates_some_are_looked_at(period: int, steps: int) -> None:
    """And what happens at every second or fifth is among them as often as it happens."""
    counts = update_counts(Phase(1, 1, 1, None), 5_000, steps)  # type: ignore[arg-type]
    assert 1_000 < counts.size < 101_000
    assert np.ptp(np.bincount(counts % period)) <= 1


def test_a_run_folder_keeps_its_cost(vdpo: Run) -> None:
    assert vdpo.config["cost"]["batches"] == [8, 8]
    assert vdpo.config["configuration"] == vdpo.rows()[0]["configuration"]
