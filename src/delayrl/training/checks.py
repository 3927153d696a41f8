"""What is refused before anything is stored or deleted, and what a new run is warned of."""

import functools
import warnings
from importlib.util import find_spec
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from delayrl.agents.base import Agent, Phase, State, template
from delayrl.core import replay as ring
from delayrl.core.types import Seen, Spec
from delayrl.envs.making import make
from delayrl.envs.task import closing_quietly
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.play import stepping
from delayrl.play.policy import spec_of
from delayrl.run.arrays import named_leaves
from delayrl.run.condition import Setup
from delayrl.training.machine import free_memory, uses_accelerator
from delayrl.training.products import traced_updates
from delayrl.training.state import Ways
from delayrl.training.tracking import SERVICES
from delayrl.wrappers import Delayed
from delayrl.wrappers.layers import check_limit, name_of

METRICS = ("step", "steps_per_second", "learning_steps_per_second")
"""What a run's lines of metrics hold anyway."""


def check_ways(ways: Ways) -> None:
    """Raise DelayRLError for ways to train that are none."""
    track = ways.track
    if not isinstance(ways.threads, Integral) or ways.threads < 1:
        raise DelayRLError(f"threads must be a whole number, at least 1; got {ways.threads!r}")
    if track is not None and track not in SERVICES:
        raise DelayRLError(f"track must be {' or '.join(SERVICES)}; got {track!r}")
    if track is not None and find_spec(SERVICES[track]) is None:
        raise DelayRLError(f"--track {track} needs `pip install 'delayrl[{track}]'`")
    if ways.callback is not None and not callable(ways.callback):
        raise DelayRLError(f"callback is a function of the step and the runs; got {ways.callback!r}")


def replay_bytes(spec: Spec, rows: int) -> int:
    """Return the size of one seed's replay."""
    replay = jax.eval_shape(lambda: ring.init(spec, rows))
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(replay))


def check_memory(setup: Setup, spec: Spec, seeds: int, device: str | None) -> None:
    """Raise DelayRLError for replays that the memory of this machine does not hold. An accelerator's is not known."""
    needed, free = seeds * replay_bytes(spec, setup.replay_rows(spec)), free_memory()
    if needed > free and not uses_accelerator(device):
        whose = "the replay takes" if seeds == 1 else f"the replays of {seeds} seeds take"
        line = f"{whose} {needed / 1e9:.1f} GB of memory, and {free / 1e9:.1f} GB are free; give a smaller"
        raise DelayRLError(f"{line} replay_capacity{'' if seeds == 1 else ', or fewer seeds at a time'}")


def check_fit(setup: Setup, env: Delayed) -> None:
    """Raise DelayRLError if an agent does not fit its schedule or its task."""
    agent, schedule, spec = setup.agent, setup.schedule, spec_of(env)
    if agent.ahead(spec) < 1:  # the window of a step needs the row after it, or its action and reward are zeros
        raise DelayRLError(f"an agent's ahead counts the steps of its targets, at least 1; got {agent.ahead(spec)}")
    least = 2 * (setup.delay.latest + agent.ahead(spec)) + 2
    for name, count in (("replay_capacity", least * setup.entries(spec)), ("random_steps", least)):
        if getattr(schedule, name) < count:
            raise DelayRLError(f"{name} must be at least {count} here; got {getattr(schedule, name)}")
    if not isinstance(agent.phases(), tuple) or not all(isinstance(phase, Phase) for phase in agent.phases()):
        raise DelayRLError("an agent's phases() returns a tuple of Phase; of one, as (Phase(…),)")
    for phase in agent.phases():
        if low := [name for name in ("every", "updates", "batch") if getattr(phase, name) < 1]:
            raise DelayRLError(f"{' and '.join(low)} of an agent's phase are at least 1; got {phase[:3]}")
    firsts = [-(-schedule.first_update // phase.every) * phase.every for phase in agent.phases()]
    if firsts and (last := max(firsts)) > schedule.steps >= min(firsts):
        line = f"a part would learn nothing: its first update is at step {last:,}, and the run ends at step"
        raise DelayRLError(f"{line} {schedule.steps:,}; give more steps, or let it learn more often")
    if (first := min(firsts, default=0)) > schedule.steps:
        start = "a smaller update_after" if schedule.update_after else "fewer random_steps"
        start = f"or {start}" if setup.condition.preset == "small" else f"{start}, or preset small"
        line = f"nothing would be learned: the first update is at step {first:,}, and the run ends"
        raise DelayRLError(f"{line} at step {schedule.steps:,}; give more steps, {start}")
    every, block = schedule.evaluate_every, schedule.updates_per_call
    if every % block:  # or evaluating would change what is learned
        raise DelayRLError(f"evaluate_every must be a multiple of updates_per_call; got {every} and {block}")
    check_limit(env, str(setup.task))
    template(agent, spec)  # its networks refuse sizes that they cannot have


def check_agent(agent: Agent, spec: Spec) -> None:
    """Raise DelayRLError if a run could not store, restore or log what the agent's functions return. Traces them."""
    state = template(agent, spec)
    _check_act(agent, spec, state)
    _check_updates(agent, spec, state)


def _check_act(agent: Agent, spec: Spec, state: State) -> None:
    """Raise DelayRLError unless the agent's action has the task's size, in training and in evaluation."""
    shape, number = jax.ShapeDtypeStruct, jax.ShapeDtypeStruct((), jnp.int32)
    obs, actions = shape((spec.obs_size,), jnp.float32), shape((spec.delay, spec.action_size), jnp.float32)
    key = jax.eval_shape(lambda: jax.random.key(0))
    for explore in (True, False):
        seen = Seen(obs, number, actions, obs if explore and agent.privileged else None)  # type: ignore[arg-type]
        action = jax.eval_shape(functools.partial(agent.act, explore=explore), state, seen, key)
        if (got := getattr(action, "shape", type(action).__name__)) != (spec.action_size,):
            raise DelayRLError(f"an agent's act returns an action of shape {(spec.action_size,)}; got {got}")


def _check_updates(agent: Agent, spec: Spec, state: State) -> None:
    """Raise DelayRLError unless updates keep the form of the agent's state, and log single numbers."""
    leaves = named_leaves(state)
    for name, leaf in leaves.items():
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            raise DelayRLError(f"the agent's state holds a random key, {name}: store jax.random.key_data of it")
    for _, traced in traced_updates(agent, spec):
        returned = traced.out_info
        if not isinstance(returned, tuple) or len(returned) != 2 or not isinstance(returned[1], dict):
            raise DelayRLError("an agent's update returns the new state and a dict of metrics")
        updated, metrics = named_leaves(returned[0]), returned[1]
        if other := sorted(updated.keys() ^ leaves.keys()):
            raise DelayRLError(f"an agent's update returns a state with the arrays of its init; not so {other[0]}")
        for name, leaf in updated.items():
            if (leaf.shape, leaf.dtype) != (leaves[name].shape, leaves[name].dtype):
                was, now = (f"{x.dtype}{list(x.shape)}" for x in (leaves[name], leaf))
                raise DelayRLError(f"an agent's update keeps the types of its state: {name} was {was}, and is {now}")
        for name, metric in metrics.items():
            shape = getattr(metric, "shape", "none")  # of a nested one
            if name in METRICS or shape != ():
                why = "which every run has" if name in METRICS else f"of shape {shape}"
                raise DelayRLError(f"metrics of an agent are single numbers with names of their own; got {name}, {why}")


def check_repeats(setup: Setup) -> None:
    """Warn if an environment does not begin twice in the same way from one seed. It is made for that, and closed."""
    with closing_quietly(make(setup.task, setup.delay.observed(), rescale=True)) as env:
        first, again = (_beginning(env) for _ in range(2))
    if not np.array_equal(first, again, equal_nan=True):
        why = "its reset has to call super().reset(seed=seed), its steps to draw from self.np_random alone, and its "
        why += "wrappers to keep nothing over a reset"
        line = f"{name_of(env)} does not begin an episode twice in the same way from one seed ({why})"
        warnings.warn(f"{line}: a run on it cannot go on after a stop", DelayWarning, stacklevel=4)


def _beginning(env: Delayed) -> NDArray[Any]:
    """Return the observations and rewards of the first three steps from seed 0, in a row."""
    numbers = [np.ravel(stepping.reset(env, 0)[1]["truth"])]
    for _ in range(3):
        action = np.full(env.action_space.shape, 0.1, np.float32)
        _, reward, terminated, truncated, info = stepping.step(env, action)
        numbers += [np.ravel(info["truth"]), np.ravel(reward)]
        if terminated or truncated:
            break
    return np.concatenate(numbers)
