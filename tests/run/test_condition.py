"""A condition is resolved once: the same whatever the user wrote, and the same when it is read back."""

import json
from dataclasses import dataclass, field, replace

import pytest

from delayrl.agents.any_age import AnyAge
from delayrl.agents.lifting import Lifting
from delayrl.core.replay import ALL
from delayrl.core.types import Spec
from delayrl.delays import Constant, Delay
from delayrl.errors import DelayRLError
from delayrl.run.cell import Cell
from delayrl.run.condition import resolve


def test_what_means_the_same_is_the_same() -> None:
    given = [5, "5", Constant(5), Delay(5), "200ms"]
    setups = [resolve("bpql", "Pendulum-v1", delay, "small", "corrected", {}) for delay in given[:4]]
    setups.append(resolve("bpql", "Pendulum-v1", "250ms", "small", "corrected", {"n_steps": 3}))  # steps of 50 ms
    assert len({setup.cell_id([0]) for setup in setups}) == 1
    assert {setup.condition.delay for setup in setups} == {5}
    assert [setup.delay for setup in setups] == [Delay(5)] * 5


def test_the_id_is_of_everything_that_decides_a_result() -> None:
    base = ("bpql", "Pendulum-v1", 5, "small", "corrected", {})
    others = [(0, "a-sac"), (2, 4), (3, "paper"), (4, "official"), (5, {"discount": 0.9}), (5, {"steps": 20_000})]
    changed = [resolve(*(value if i == at else given for i, given in enumerate(base))) for at, value in others]
    ids = [setup.cell_id([0]) for setup in (resolve(*base), *changed)] + [resolve(*base).cell_id([0, 1])]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize("preset", ["small", "paper"])
def test_what_a_user_gives_is_never_scaled(preset: str) -> None:
    """Neither by name nor in an instance; a preset's own numbers follow the length of the run."""
    values = {"lifting_hold": 2000, "lifting_end": 6000}
    given = resolve(Lifting(**values), "Pendulum-v1", 5, preset, "corrected", {"steps": 30_000}).agent
    named = resolve("lifting", "Pendulum-v1", 5, preset, "corrected", {"steps": 30_000, **values}).agent
    assert [(agent.lifting_hold, agent.lifting_end) for agent in (given, named)] == [(2000, 6000)] * 2
    usual = resolve(Lifting, "Pendulum-v1", 5, preset, "corrected", {"steps": 30_000})
    assert usual.agent == resolve("lifting", "Pendulum-v1", 5, preset, "corrected", {"steps": 30_000}).agent
    assert usual.agent.lifting_end < 30_000


def test_agents_in_fields_are_told_the_length_of_the_run() -> None:
    held = Holds(AnyAge(pull_weight=1.0, second_age="random"))
    assert resolve(held, "Pendulum-v1", 5, "small", "corrected", {"steps": 700}).agent.inner.run_steps == 700
    with pytest.raises(DelayRLError, match="pull_weight needs a younger second_age"):
        resolve(Holds(AnyAge(pull_weight=1.0, second_age="none")), "Pendulum-v1", 5, "small", "corrected", {})


@dataclass(frozen=True)
class Holds:
    """An agent of a user that leaves all to another."""

    inner: AnyAge = field(default_factory=AnyAge)
    privileged = False

    def ahead(self, spec):
        return self.inner.ahead(spec)

    def phases(self):
        return self.inner.phases()

    def init(self, spec, key):
        return self.inner.init(spec, key)

    def act(self, state, seen, key, *, explore):
        return self.inner.act(state, seen, key, explore=explore)

    def deterministic(self, state):
        return self.inner.deterministic(state)


def test_json_round_trip() -> None:
    condition = resolve("vdpo", "Pendulum-v1", "uniform:1:3@fifo", "small", "corrected", {"width": 8}).condition
    cell = Cell(condition, (3, 4), "0123456789ab")
    stored = json.loads(json.dumps(cell.json))
    assert Cell.from_json(stored, "0123456789ab") == cell
    for name in stored:
        with pytest.raises(DelayRLError, match=f"no good {name}"):
            Cell.from_json({**stored, name: None}, "")


def test_rows_name_a_long_delay_shortly() -> None:
    delay = "recorded:" + ",".join(["3"] * 60) + ","
    condition = resolve("bpql", "Pendulum-v1", delay, "small", "corrected", {}).condition
    assert condition.delay == delay
    assert len(str(condition.columns["delay"])) < 30
    assert replace(condition, delay=condition.short_delay).short_delay == condition.short_delay


def test_protocols_are_values() -> None:
    """The habits of each agent's released code: which of them drop the last starts, and which sample in evaluation."""
    official = {
        agent: resolve(agent, "Pendulum-v1", 3, "small", "official", {}) for agent in ("vdpo", "ad-sac", "bpql")
    }
    spec = Spec(3, 1, 3)
    assert [setup.learnable(spec).until_end for setup in official.values()] == [3, 3, 1]
    assert [getattr(setup.agent, "evaluation", "mode") for setup in official.values()] == ["mode", "sample", "mode"]
    limits = [setup.protocol.time_limit for setup in official.values()]
    assert limits == ["terminates", "terminates", "bootstraps"]
    corrected = resolve("vdpo", "Pendulum-v1", 3, "small", "corrected", {})
    assert corrected.learnable(spec) == ALL
    assert resolve("ad-sac", "Pendulum-v1", 3, "small", "official", {"evaluation": "mode"}).agent.evaluation == "mode"
    with pytest.raises(DelayRLError, match="protocol must be corrected or official; got 'mine'"):
        resolve("vdpo", "Pendulum-v1", 3, "small", "mine", {})
