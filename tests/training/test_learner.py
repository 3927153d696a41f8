"""Which updates run when, with which keys, counts, batches and observations: noted by an agent that learns nothing."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from conftest import learned
from delayrl.agents.base import Phase
from delayrl.core.types import Seen, Spec, Transition
from delayrl.training.learner import Program

SPEC = Spec(1, 1, 2)
FIRST_UPDATE, STEPS = 5, 12


class Notes(NamedTuple):
    """One row for each update: phase, count, a number drawn from its key, batch size, longest k, newest observation."""

    rows: jax.Array
    length: jax.Array


@dataclass(frozen=True)
class Probe:
    """An agent whose updates note what they were given, with phases (every, updates, batch)."""

    schedule: tuple[tuple[int, int, int], ...]

    def ahead(self, spec: Spec) -> int:
        return 3

    def phases(self) -> tuple[Phase, ...]:
        return tuple(Phase(*of, functools.partial(self.note, i)) for i, of in enumerate(self.schedule))

    def init(self, spec: Spec, key: Any) -> Notes:
        return Notes(jnp.zeros((40, 6)), jnp.int32(0))

    def act(self, state: Notes, seen: Seen, key: Any, *, explore: bool) -> jax.Array:
        return jax.random.uniform(key, (1,)) if explore else jnp.zeros(1)

    def note(self, index: int, state: Notes, windows: Any, key: Any, count: jax.Array) -> tuple[Notes, dict]:
        seen = len(windows.lead), windows.n_step.max(), windows.obs.max()
        row = jnp.stack([jnp.float32(x) for x in (index, count, jax.random.uniform(key), *seen)])
        return Notes(state.rows.at[state.length].set(row), state.length + 1), {f"count{index}": jnp.float32(count)}


def transition(step: int) -> Transition:
    """Step `step` of one long episode, from the observation `step - 1`."""
    now, then = np.float32([step - 1]), np.float32([step])
    zero, no = np.int32(0), np.bool_(False)
    return Transition(now, zero, np.float32([0.5]), np.float32(0), no, no, then, zero)  # type: ignore[arg-type]


def hidden(step: int) -> int:
    return step % 4


def expected(schedule: tuple[tuple[int, int, int], ...], block: int) -> tuple[list[list[float]], dict[str, float]]:
    """The rows in order, and the metrics of the last block."""
    rows, metrics = [], {}

    def note(index: int, step: int, newest: int) -> float:
        every, updates, batch = schedule[index]
        counts = [step // every * updates + i for i in range(updates)]
        for i, count in enumerate(counts):
            key = jax.random.key(3)
            for number in (step, index, i):
                key = jax.random.fold_in(key, number)
            drawn = float(jax.random.uniform(jax.random.split(key)[1]))
            rows.append([index, count, drawn, batch, 3, newest])
        return float(np.mean(counts))

    for last in range(block, STEPS + 1, block):
        steps = range(last - block + 1, last + 1)
        due = {n: [i for i, of in enumerate(schedule) if n % of[0] == 0 and n >= FIRST_UPDATE] for n in steps}
        at_once = all(0 in phases for phases in due.values())
        if at_once:
            metrics["count0"] = float(np.mean([note(0, step, step - hidden(step)) for step in steps]))
        for step in steps:
            for index in due[step][at_once:]:
                metrics[f"count{index}"] = note(index, step, last - hidden(last))
    return rows, metrics


@pytest.mark.parametrize(
    ("schedule", "block"),
    [(((2, 3, 256), (5, 2, 128)), 1), (((1, 1, 256), (3, 2, 128)), 4), (((2, 1, 256), (3, 2, 128)), 4)],
)
def test_every_update(schedule: tuple[tuple[int, int, int], ...], block: int) -> None:
    """A first phase that is due at every step follows each stored step; all others run at the end of a block."""
    program, keys = Program(Probe(schedule), SPEC), jax.random.key(3)[None]  # type: ignore[arg-type]
    data = [[transition(step) for step in range(1, STEPS + 1)]]
    *_, (learner, metrics) = learned(program, keys, data, FIRST_UPDATE, hidden=hidden, block=block)
    rows, of_last = expected(schedule, block)
    assert int(learner.agent.length[0]) == len(rows)
    np.testing.assert_allclose(learner.agent.rows[0, : len(rows)], rows, rtol=1e-6)
    assert {name: float(x[0]) for name, x in metrics.items()} == {name: of_last[name] for name in metrics}


def test_acting_explores_with_the_steps_key() -> None:
    program = Program(Probe(()), SPEC)  # type: ignore[arg-type]
    notes = jax.tree.map(lambda x: x[None], Probe(()).init(SPEC, None))
    what = Seen(np.zeros((1, 1), np.float32), np.zeros(1, np.int32), np.zeros((1, 2, 1), np.float32))  # type: ignore[arg-type]
    for step in (4, 5):
        action = program.act(notes, what, jax.random.key(3)[None], step)
        np.testing.assert_array_equal(action[0], jax.random.uniform(jax.random.fold_in(jax.random.key(3), step), (1,)))
