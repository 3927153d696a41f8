"""Evaluation: no exploration, a start state for each episode, one row for each episode and never a mean."""

import contextlib
import functools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from delayrl.agents.base import Agent, State
from delayrl.core.types import Action, Key, Seen, Spec
from delayrl.core.views import seen_now
from delayrl.delays import Delay, DelayLike
from delayrl.envs.making import check_limit, delay_of, make, name_of
from delayrl.envs.task import Task, TaskLike, as_task, closing_quietly
from delayrl.errors import DelayRLError, DelayWarning
from delayrl.play import stepping
from delayrl.play.policy import Policy, load, spec_of
from delayrl.run.agents import AgentLike
from delayrl.run.folder import RunLike
from delayrl.run.rows import deviation


class Episodes(NamedTuple):
    """Undiscounted returns and lengths, [seeds, episodes]."""

    returns: NDArray[np.float64]
    lengths: NDArray[np.int64]


class Evaluation(TypedDict):
    """What a policy returned in evaluation: a dictionary with these names, which JSON can hold."""

    agent: str
    """The agent that trained it."""
    env: str
    """The task that was played."""
    delay: int | str
    """The delay that it was played under."""
    step: int | None
    """The step of its training; None for a policy that does not say it."""
    episodes: int
    """How many were played."""
    mean_return: float
    """The mean of `returns`."""
    std_return: float | None
    """Their standard deviation, with n - 1 in the denominator; None for one episode."""
    returns: list[float]
    """The undiscounted return of each episode."""


class AgeEvaluation(Evaluation):
    """An evaluation under one constant delay of a sweep over all ages."""

    learned: bool
    """Whether the policy learned that age, after the start of an episode."""


class Evaluator:
    """Plays episodes of all seeds beside each other, with one call of the policy for each step of all of them.

    `spec` is the task as the agent was trained on it; it is played under `delay`, which may be shorter. `apply` is
    `map`, or that of a pool of threads, which steps the environments beside each other.
    """

    def __init__(
        self,
        agent: Agent,
        spec: Spec,
        env: TaskLike,
        delay: int | str | Delay,
        seeds: int,
        episodes: int,
        apply: Callable[..., Iterator[Any]] = map,
    ) -> None:
        served = servable(env, delay, spec)
        self._delay, self._apply, self._shape = spec.delay, apply, (seeds, episodes)
        self._act = _compiled_act(agent)
        with contextlib.ExitStack() as held:
            made = (make(env, served, rescale=True) for _ in range(seeds * episodes))
            self._envs = [held.enter_context(closing_quietly(one)) for one in made]
            check_fits(self._envs[0], spec)
            check_limit(self._envs[0], str(as_task(env)))
            self._held = held.pop_all()  # now that nothing is refused any more

    def __call__(
        self,
        states: State,
        reset_seeds: Sequence[Sequence[int]],
        keys: Key,
        opening: NDArray[np.float32] | None = None,
        travel_seeds: Sequence[Sequence[int]] | None = None,
    ) -> Episodes:
        """Play one episode from each reset seed, [seeds, episodes].

        `opening` are first actions that are not the policy's, [seeds, episodes, steps, A]; `travel_seeds` the seeds of
        the travel times, if they are not those of the start states. Raises DelayRLError for what is not finite.
        """
        shape, number = self._shape, len(self._envs)
        returns, lengths, running = np.zeros(number), np.zeros(number, np.int64), np.ones(number, bool)
        starts = [stepping.reset(env, int(seed)) for env, seed in zip(self._envs, np.ravel(reset_seeds), strict=True)]
        if travel_seeds is not None:
            starts = [env.draw_from(int(seed)) for env, seed in zip(self._envs, np.ravel(travel_seeds), strict=True)]
        seen = [self._see(*start) for start in starts]
        step = 0
        while running.any():
            batch = jax.tree.map(lambda *x: np.stack(x).reshape(*shape, *np.shape(x[0])), *seen)
            actions = np.asarray(self._act(states, batch, keys, np.int32(step))).reshape(number, -1)
            if not (np.abs(actions[running]) <= 1).all():
                raise DelayRLError("the policy gives actions beyond [-1, 1], or none that are numbers, in evaluation")
            if opening is not None and step < opening.shape[2]:
                actions = opening[:, :, step].reshape(number, -1)
            step += 1
            alive = np.flatnonzero(running)
            played = self._apply(stepping.step, [self._envs[i] for i in alive], actions[alive])
            for i, (obs, reward, terminated, truncated, info) in zip(alive, played, strict=True):
                if not (np.isfinite(reward) and np.isfinite(info["truth"]).all()):
                    raise DelayRLError("the environment gave a number that is not finite in evaluation")
                returns[i] += reward
                lengths[i] += 1
                running[i] = not (terminated or truncated)
                seen[i] = self._see(obs, info)
        return Episodes(returns.reshape(shape), lengths.reshape(shape))

    def close(self) -> None:
        """Close the environments."""
        self._held.close()

    def _see(self, obs: NDArray[Any], info: dict[str, Any]) -> Any:
        return seen_now(obs, info, self._delay, privileged=False)


def servable(env: TaskLike, delay: DelayLike, spec: Spec) -> Delay:
    """Return the delay without that of rewards. Raises DelayRLError if it is longer than a policy was trained for."""
    served = delay_of(env, delay).acted()
    if served.maximum > spec.delay:
        further = f"train with --delay {served.maximum} for more"
        raise DelayRLError(f"the policy takes delays up to {spec.delay} steps; got {served.maximum}; {further}")
    return served


def check_fits(env: Any, spec: Spec) -> None:
    """Raise DelayRLError if observations or actions of a task have other sizes than those of a policy."""
    own = spec_of(env)
    if (own.obs_size, own.action_size) != (spec.obs_size, spec.action_size):
        line = f"the policy takes observations of size {spec.obs_size} and gives actions of size {spec.action_size}"
        raise DelayRLError(f"{line}; {name_of(env)} has sizes {own.obs_size} and {own.action_size}")


@functools.lru_cache(8)
def _compiled_act(agent: Agent) -> Any:
    """Deterministic actions for [seeds, episodes], each with a key of its own."""

    def act(state: State, seen: Seen, key: Key, step: Array, episode: Array) -> Action:
        for number in (step, episode):
            key = jax.random.fold_in(key, number)
        return agent.act(state, seen, key, explore=False)

    def act_in_episodes(state: State, seen: Seen, key: Key, step: Array) -> Action:
        numbers = jnp.arange(seen.age.shape[0])
        return jax.vmap(act, (None, 0, None, None, 0))(state, seen, key, step, numbers)

    return jax.jit(jax.vmap(act_in_episodes, (0, 0, 0, None)))


def check_seed(seed: int) -> None:
    """Raise DelayRLError unless a seed is a whole number from 0 to 2³¹ - 1."""
    if not isinstance(seed, int | np.integer) or not 0 <= seed < 2**31:
        raise DelayRLError(f"a seed must be a whole number from 0 to {2**31 - 1}; got {seed!r}")


def reset_seed(seed: int, *stream: int) -> int:
    """Return a seed for one episode: the same numbers give the same seed, others an unrelated one."""
    return int(np.random.SeedSequence([seed, *stream]).generate_state(1)[0] >> 1)


TRAINING, EVALUATION, RANDOM_ACTIONS, HELD_OUT = 0, 1, 2, 3
"""Streams of `reset_seed`: training, evaluation and `evaluate` share no start states."""


def evaluate(
    run: RunLike | Policy,
    episodes: int = 10,
    delay: DelayLike | None = None,
    seed: int = 0,
    *,
    env: TaskLike | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: AgentLike | None = None,
) -> Evaluation:
    """Play the policy of a run on start states that it never saw.

    Args:
        run: the run, its folder, or a policy.
        episodes: how many.
        delay: any delay that it can serve, as `train`; None for the one it was trained for.
        seed: of the start states.
        env: what makes the environment, as `load`.
        env_kwargs: keyword arguments of it, as `load`.
        agent: as `load`.

    Raises:
        DelayRLError: no run, no good checkpoint, a delay that the policy was not trained for.
    """
    _check_sample(episodes, seed)
    policy, task = _loaded(run, env, env_kwargs, agent)
    if delay is not None and (played := delay_of(task, delay)).minimum < policy.min_age:
        line = (
            f"{policy.name} learned no age below {policy.min_age} steps, and delay {played.label()} shows younger ones"
        )
        warnings.warn(f"{line}; a Controller holds these back", DelayWarning, stacklevel=2)
    return _play(policy, task, policy.delay if delay is None else delay, episodes, seed)


def sweep(
    run: RunLike | Policy,
    episodes: int = 10,
    seed: int = 0,
    *,
    env: TaskLike | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: AgentLike | None = None,
) -> Iterator[AgeEvaluation]:
    """Evaluate a run, or a policy, at every constant delay from 0 to the longest age that its policy was trained for.

    Args:
        run: as `evaluate`.
        episodes: as `evaluate`, at each delay.
        seed: as `evaluate`.
        env: as `evaluate`.
        env_kwargs: as `evaluate`.
        agent: as `evaluate`.

    Raises:
        DelayRLError: as `evaluate`.
    """
    _check_sample(episodes, seed)
    policy, task = _loaded(run, env, env_kwargs, agent)
    return (
        {**_play(policy, task, delay, episodes, seed), "learned": delay >= policy.min_age}
        for delay in range(policy.spec.delay + 1)
    )


def _check_sample(episodes: int, seed: int) -> None:
    """Raise DelayRLError unless there is an episode to play, and the seed is one."""
    if not isinstance(episodes, int | np.integer) or episodes < 1:
        raise DelayRLError(f"episodes must be a whole number, at least 1; got {episodes!r}")
    check_seed(seed)


def _loaded(
    run: RunLike | Policy, env: TaskLike | None, env_kwargs: Mapping[str, Any] | None, agent: AgentLike | None
) -> tuple[Policy, Task]:
    """Return the policy of a run, or the one given, and the task to play it on."""
    if not isinstance(run, Policy):
        run, env, env_kwargs = load(run, env, env_kwargs=env_kwargs, agent=agent), None, None
    elif agent is not None:
        raise DelayRLError("a policy is of its own agent: leave agent out, or give a run")
    task = run.task if env is None else env
    if task is None:
        raise DelayRLError("this policy does not say what its task is: give env, or a run")
    return run, as_task(task, env_kwargs)


def _play(policy: Policy, task: Task, delay: DelayLike, episodes: int, seed: int) -> Evaluation:
    parsed = delay_of(task, delay)
    states = jax.tree.map(lambda x: np.asarray(x)[None], policy.state)
    seeds = [reset_seed(seed, HELD_OUT, episode) for episode in range(episodes)]
    with (
        contextlib.closing(Evaluator(policy.agent, policy.spec, task, parsed, 1, episodes)) as evaluator,
        jax.default_matmul_precision("float32"),  # a GPU's own is coarser
    ):
        returns = evaluator(states, [seeds], jax.random.key(seed)[None]).returns[0]
    return {
        "agent": policy.name,
        "env": str(task),
        "delay": parsed.label(),
        "step": policy.step,
        "episodes": int(episodes),
        "mean_return": float(returns.mean()),
        "std_return": deviation(returns),
        "returns": returns.tolist(),
    }
