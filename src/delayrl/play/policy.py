"""Trained policies: `load` a run, then `act` on what the wrapper shows."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from gymnasium.wrappers import RescaleAction
from numpy.typing import NDArray

from delayrl.agents.base import Agent, State, template
from delayrl.core.cache import keep_compiled
from delayrl.core.types import Action, Key, Seen, Spec
from delayrl.core.views import seen_now
from delayrl.delays import Delay, stored_delay
from delayrl.envs.making import make
from delayrl.envs.task import Task, TaskLike, closing_quietly, stored_task
from delayrl.errors import DelayRLError
from delayrl.run.agents import AgentLike, agent_of, warn_of_other_code
from delayrl.run.arrays import age_of, inner_range, restore_tree
from delayrl.run.checkpoint import Checkpoint
from delayrl.run.folder import RunFolder, RunLike, path_of


class Policy:
    """A policy with its weights.

    Attributes:
        agent: its hyperparameters.
        state: its weights, a tree of arrays.
        spec: sizes of the task, and the longest age it was trained for.
        low, high: the range of its actions, [A], in single precision, rounded inwards.
        step: how many environment steps it has learned from; None if unknown.
        trained: the delay that it was trained under; None if unknown.
        task: what it was trained on, or the `env` that it was loaded with; None if unknown.
        name: that of its agent.
    """

    def __init__(
        self,
        agent: Agent,
        state: State,
        spec: Spec,
        low: NDArray[Any],
        high: NDArray[Any],
        *,
        step: int | None = None,
        trained: Delay | None = None,
        task: Task | None = None,
        name: str = "",
    ) -> None:
        self.agent, self.state, self.spec, self.name = agent, state, spec, name or type(agent).__name__
        self.step, self.trained, self.task = step, trained, task
        self.low, self.high = inner_range(low, high)
        self._key = jax.random.key(0)

        def decide(state: State, seen: Seen, key: Key) -> Action:
            with jax.default_matmul_precision("float32"):  # as in evaluation: a GPU's own is coarser
                return agent.act(state, seen, key, explore=False)

        self._act = jax.jit(decide)

    def __repr__(self) -> str:
        return f"Policy({self.name} on {self.task}, ages {self.min_age}..{self.spec.delay}, step {self.step})"

    @property
    def delay(self) -> Delay | int:
        """The delay that it was trained under; if unknown, the longest age that it takes."""
        return self.spec.delay if self.trained is None else self.trained

    @property
    def min_age(self) -> int:
        """The shortest age that it learned, after the start of an episode, in steps; 0 if unknown."""
        return 0 if self.trained is None or getattr(self.agent, "every_age", False) else self.trained.minimum

    def act(self, obs: NDArray[Any], info: dict[str, Any]) -> NDArray[np.float32]:
        """Return the action, in the task's own units: the policy's mode, but a draw of agents whose evaluation samples.

        Args:
            obs: the newest observation that has arrived, [S].
            info: `age`, and `actions` [≥ age, A] taken since, oldest first, in the task's own units: what
                `Delayed` puts there. Entries after the first `age` are ignored.

        Raises:
            DelayRLError: wrong sizes, numbers that are not real or not finite, no age or actions, an age that is no
                integer, or one that the policy was not trained for.
        """
        if not {"age", "actions"} <= info.keys():
            raise DelayRLError("the policy needs the info that `Delayed` gives: it has no age and actions here")
        age = age_of(info["age"], self.spec.delay)
        try:
            obs, actions = np.asarray(obs), np.asarray(info["actions"])
        except ValueError:  # rows of several lengths
            raise DelayRLError("the policy takes arrays of numbers: obs [S] and actions [≥ age, A]") from None
        if not all(np.can_cast(x.dtype, np.float64, "same_kind") for x in (obs, actions)):
            raise DelayRLError(f"the policy takes real numbers; got {obs.dtype} and actions of {actions.dtype}")
        if obs.shape != (self.spec.obs_size,):
            raise DelayRLError(f"the policy takes observations of size {self.spec.obs_size}; got shape {obs.shape}")
        actions = actions.reshape(-1, self.spec.action_size) if actions.size == 0 else actions
        if actions.ndim != 2 or actions.shape[1] != self.spec.action_size:
            raise DelayRLError(f"actions are rows of {self.spec.action_size} numbers; got shape {actions.shape}")
        if len(actions) < age:
            raise DelayRLError(f"an observation of age {age} needs the {age} actions taken since; got {len(actions)}")
        actions = actions[:age]
        if not (np.isfinite(obs).all() and np.isfinite(actions).all()):
            raise DelayRLError("the policy was given an observation or an action that is not finite")
        scaled = 2 * (actions - self.low) / (self.high - self.low) - 1
        seen = seen_now(obs, {"age": age, "actions": scaled}, self.spec.delay, privileged=False)
        self._key, key = jax.random.split(self._key)
        action = np.asarray(self._act(self.state, seen, key))
        return np.clip(self.low + (action + 1) / 2 * (self.high - self.low), self.low, self.high)  # it is rounded


def load(
    run: RunLike,
    env: TaskLike | None = None,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: AgentLike | None = None,
) -> Policy:
    """Load the policy of a run folder from its newest good checkpoint.

    Args:
        run: the run, or its folder.
        env: what makes its environment, if the run cannot name it (a lambda) or may not (docs/own-task.md). It gets the
            keyword arguments and wrappers of the run.
        env_kwargs: keyword arguments of the environment that replace or complete the run's.
        agent: its class, an instance or a name, if the run cannot name it or may not (docs/own-agent.md). It gets the
            hyperparameters of the run.

    Raises:
        DelayRLError: no run folder, no good checkpoint, one of another agent, a task that cannot be made.
    """
    keep_compiled()
    folder = RunFolder(path_of(run))
    config = folder.config
    return restored(folder, config, folder.latest(), stored_task(config["env"], folder.path, env, env_kwargs), agent)


def restored(
    run: RunFolder, config: dict[str, Any], checkpoint: Checkpoint, task: Task, given: AgentLike | None = None
) -> Policy:
    """Load the policy in a checkpoint of a run with this configuration, whose task is looked up; `given` as `load`."""
    agent = agent_of(config, run.path, given)
    if given is None:
        warn_of_other_code(config, run.path, agent)
    trained = stored_delay(config["delay"], run.path)
    with closing_quietly(make(task, trained)) as env:
        spec, actions = spec_of(env), env.action_space
    try:
        state = restore_tree(template(agent, spec), checkpoint.arrays("agent"), checkpoint.path)
    except DelayRLError as error:
        instead = [name for name, other in (("env", str(task) != config["env"]), ("agent", given is not None)) if other]
        if not instead:
            raise
        raise DelayRLError(f"the run does not fit the {' and the '.join(instead)} given: {error}") from error
    known = {"step": checkpoint.step, "trained": trained, "task": task, "name": config["agent"]}
    return Policy(agent, state, spec, actions.low, actions.high, **known)


def spec_of(env: Any) -> Spec:
    """Return the sizes, the longest age and the actions' range of a wrapped task."""
    task = env.env.env if isinstance(env.env, RescaleAction) else env.env
    actions: Any = task.action_space
    half_range = (actions.high.astype(float) - actions.low) / 2
    return Spec(env.observation_space.shape[0], env.action_space.shape[0], env.history, float(np.log(half_range).sum()))
