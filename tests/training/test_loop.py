"""The order of acting, learning, evaluating and saving, and who chooses which action."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from delayrl.agents.base import Schedule
from delayrl.core import replay as ring
from delayrl.core.protocol import CORRECTED, Protocol
from delayrl.core.types import Spec
from delayrl.delays import as_delay
from delayrl.envs.making import make
from delayrl.training import loop
from delayrl.training.actor import Actor
from delayrl.training.learner import Stored
from delayrl.training.loop import Loop
from delayrl.training.state import TrainState, Ways

SCHEDULE = Schedule(steps=10, random_steps=4, updates_per_call=2, evaluate_every=4)
SEEDS = [3, 4]


def trained(
    monkeypatch: pytest.MonkeyPatch, schedule: Schedule, protocol: Protocol = CORRECTED, stored: list | None = None
) -> tuple[list, Any]:
    """Run the loop with a program that acts with 0.5 and learns nothing. Returns its calls and the executed actions.

    `stored` takes what the program is given to learn from.
    """
    calls: list[tuple] = []

    class Recorder:
        def evaluate(self, step: int, agent: Any) -> str:
            calls.append(("evaluate", step))
            return ""

        def episodes(self, ended: list[list[dict[str, Any]]]) -> None:
            assert len(ended) == len(SEEDS)

    class Fake:
        learnable = ring.ALL

        def act(self, agent: Any, seen: Any, keys: Any, step: int) -> Any:
            calls.append(("act", step))
            return np.full((len(SEEDS), 1), 0.5, np.float32)

        def learn(self, learner: Any, pending: list, keys: Any, last: int, first: int) -> tuple:
            calls.append(("learn", last, len(pending)))
            if stored is not None:
                stored.extend(pending)
            return learner, {}, last >= first

    def save(group: Any, state: TrainState, *, complete: bool = False) -> TrainState:
        calls.append(("save", state.step, complete))
        return state

    executed: list[list[tuple[int, float]]] = [[] for _ in SEEDS]  # (step of the episode, action)

    class Watched(Actor):
        def step(self, action: Any) -> Any:
            executed[SEEDS.index(self.seed)].append((len(self.actions), float(action[0])))
            return super().step(action)

    monkeypatch.setattr(loop, "save", save)
    monkeypatch.setattr(loop, "Actor", Watched)
    actors = [Watched(make("delayrl/Counter-v0", 2, rescale=True), seed, False, protocol) for seed in SEEDS]
    agent = SimpleNamespace(privileged=False)
    setup = SimpleNamespace(agent=agent, schedule=schedule, delay=as_delay(2), protocol=protocol)
    group: Any = SimpleNamespace(
        setup=setup, seeds=SEEDS, keys=None, spec=Spec(2, 1, 2), program=Fake(), ways=Ways(), apply=map, folders=[]
    )
    replay = jax.vmap(lambda steps: ring.init(Spec(2, 1, 2), 100)._replace(steps=steps))(np.array([99, 99]))
    learner: Any = SimpleNamespace(agent=None, replay=replay)
    state = TrainState(0, learner, actors, [], None, [{}, {}], [(0, 0), (0, 0)])
    bar = SimpleNamespace(update=lambda count: None, set_postfix_str=lambda text: None)
    Loop(group, state, Recorder()).train(lambda: False, bar)  # type: ignore[arg-type]
    return calls, executed


def test_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Actions are chosen before the update that follows a step; what is evaluated has learned from every step."""
    calls, _ = trained(monkeypatch, SCHEDULE)
    assert calls == [
        ("learn", 2, 2),
        *(("act", 4), ("learn", 4, 2), ("evaluate", 4), ("save", 4, False)),
        *(("act", 5), ("act", 6), ("learn", 6, 2), ("act", 7)),
        *(("act", 8), ("learn", 8, 2), ("evaluate", 8), ("save", 8, False)),
        *(("act", 9), ("act", 10), ("learn", 10, 2), ("evaluate", 10), ("save", 10, True)),
    ]


def test_what_is_hidden_after_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many of the newest observations as are on their way after the step itself; none after an end."""
    stored: list[list[Stored]] = []
    trained(monkeypatch, Schedule(steps=40, random_steps=4, updates_per_call=2, evaluate_every=40), stored=stored)
    assert len(stored) == 40
    for own in zip(*stored, strict=True):
        moment, hidden = 0, []
        for step in own:
            moment = 0 if step.transition.done else moment + 1
            hidden.append(min(moment, 2))
        assert [int(step.hidden) for step in own] == hidden
        assert hidden.count(0) > 1


def test_random_actions_are_of_seed_and_step(monkeypatch: pytest.MonkeyPatch) -> None:
    _, executed = trained(monkeypatch, SCHEDULE)
    drawn = np.array([[action for _, action in of_seed[:4]] for of_seed in executed])
    assert len(np.unique(drawn)) == 8
    assert (np.abs(drawn) <= 1).all()
    assert all(action == 0.5 for of_seed in executed for _, action in of_seed[4:])


@pytest.mark.parametrize(("opening", "length"), [("agent", 0), ("one-random", 1), ("random", 2), ("zeros", 2)])
def test_openings(opening: Any, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a delay of 2: of every episode that many first actions are the protocol's, all later ones the agent's."""
    schedule = Schedule(steps=30, random_steps=0, updates_per_call=1, evaluate_every=30)
    _, executed = trained(monkeypatch, schedule, replace(CORRECTED, opening=opening))
    opens = [action for of_seed in executed for moment, action in of_seed if moment < length]
    later = [action for of_seed in executed for moment, action in of_seed if moment >= length]
    assert later == [0.5] * len(later) != []
    assert len(opens) >= 4 * length
    if opening == "zeros":
        assert not any(opens)
    else:
        assert len({*opens, 0.0, 0.5}) == len(opens) + 2
