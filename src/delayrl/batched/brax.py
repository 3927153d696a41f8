"""Delays for tasks of brax and MuJoCo Playground: `wrap` takes the place of their own wrapper for training."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from delayrl.batched.delay import BatchedLike, as_batched
from delayrl.batched.episodes import Episode, act, arrive, restart, start
from delayrl.batched.transit import Shown, augmented
from delayrl.errors import DelayRLError, one_line

with one_line("brax cannot be imported"):
    from brax.envs.base import State, Wrapper
    from brax.envs.wrappers import training

NAME = "delay"
"""Where `state.info` keeps the messages on their way."""
STREAM = 0xDE1A
"""Folded into an environment's key, so that its task has the random numbers that it has without a delay."""


class Messages(NamedTuple):
    """What `state.info["delay"]` holds."""

    episodes: Episode
    obs: Any  # the task's own observation, which its next step may read


def wrap(
    env: Any,
    delay: BatchedLike,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Callable[..., Any] | None = None,
    *,
    keys: Sequence[str] = (),
    augment: bool = True,
    step_seconds: float | None = None,
) -> "DelayWrapper":
    """Wrap a task for training, with delays: give `partial(wrap, delay=...)` as `wrap_env_fn` of brax's PPO.

    Args:
        env: a task of brax or MuJoCo Playground, not wrapped for training.
        delay: what `as_batched` takes: steps, a text ("uniform:1:3+action=2") and so on. A step is one decision.
        episode_length: time limit, in steps of the task.
        action_repeat: steps of the task for each decision.
        randomization_fn: as for brax's wrapper.
        keys: as for `DelayWrapper`.
        augment: as for `DelayWrapper`.
        step_seconds: the length of a decision, for delays in time; None for the task's `dt` times `action_repeat`.

    Raises:
        DelayRLError: no task of brax, or one that is wrapped for training; a bad delay, or one that is longer than an
            episode.
    """
    if not all(hasattr(env, name) for name in ("reset", "step", "action_size")):
        got = type(env).__name__
        raise DelayRLError(f"wrap takes a task with brax's interface (reset, step, action_size); got {got}")
    for layer in _wrappers(env):
        if "episode_length" in vars(layer) or isinstance(layer, DelayWrapper):
            line = "wrap takes a task that is not wrapped for training, because it does that itself"
            raise DelayRLError(f"{line}; got {type(layer).__name__}. Around such environments put DelayWrapper")
    seconds = getattr(env, "dt", None)
    if step_seconds is None and seconds is not None:
        step_seconds = float(seconds) * action_repeat
    delay = as_batched(delay, step_seconds)
    longest, decisions = max(delay.maximum, delay.reward.maximum), -(-episode_length // action_repeat)
    if longest > decisions:
        raise DelayRLError(f"a delay of {longest} steps is longer than an episode ({decisions} decisions)")
    options = {"episode_length": episode_length, "action_repeat": action_repeat, "randomization_fn": randomization_fn}
    return DelayWrapper(_training_wrap(env)(env, **options), delay, keys=keys, augment=augment)


def _wrappers(env: Any) -> Iterator[Any]:
    """Yield the wrappers around a task, from outside to inside."""
    while "env" in getattr(env, "__dict__", {}):
        yield env
        env = env.env


def _training_wrap(env: Any) -> Callable[..., Any]:
    """Return the wrapper for training of the library that the task is from."""
    if any(kind.__module__.startswith("mujoco_playground.") for kind in type(getattr(env, "unwrapped", env)).__mro__):
        from mujoco_playground import wrapper

        return wrapper.wrap_for_brax_training
    return training.wrap


class DelayWrapper(Wrapper):  # type: ignore[misc]  # brax has no types
    """Delay the observations and actions of environments that reset themselves; `wrap` makes it.

    It goes around what a wrapper for training returns. A flat observation s_t of the task becomes a dict:
      state             x_t: the observation that has arrived, the actions since, and their number divided by Δ
      privileged_state  s_t: for the value function
    Of a task whose observation is a dict, `keys` are delayed and the other entries stay as they are. The actions and
    the age are appended to the first of `keys`, and `privileged_state` is added if the task has none.

    The messages on their way are in `state.info["delay"]`. Their times come from the environments' keys. The messages
    of an episode end with it, and the next one shows its first observation at once.

    Args:
        env: environments with a leading axis that reset themselves, such as `brax.envs.training.wrap` returns.
        delay: as for `wrap`. A law whose arrays have a leading axis gives each environment its own.
        keys: the entries that are delayed, of an observation that is a dict. `privileged_state` has them in this order.
        augment: whether `state` has the actions and the age; False shows what an agent that knows no delay sees.
        step_seconds: the length of a decision, for delays in time.

    Raises:
        DelayRLError: a bad delay, or one of the rewards; and, at the first reset, environments that do not reset
            themselves, observations that are no flat arrays, or laws for another number of environments.
    """

    def __init__(
        self,
        env: Any,
        delay: BatchedLike,
        *,
        keys: Sequence[str] = (),
        augment: bool = True,
        step_seconds: float | None = None,
    ) -> None:
        super().__init__(env)
        self.delay, self._augment = as_batched(delay, step_seconds), augment
        self._keys = (keys,) if isinstance(keys, str) else tuple(keys)
        if len(set(self._keys)) < len(self._keys) or "privileged_state" in self._keys:
            raise DelayRLError(f"keys are different entries, and not privileged_state, which is the truth; got {keys}")
        if self.delay.reward.maximum:
            line = "rewards travel with terminations, and environments that reset themselves cannot wait for one"
            raise DelayRLError(f"{line}: delay observations and actions, or write the loop with delayrl.batched")
        self._axes = self.delay.axes()

    def reset(self, rng: jax.Array) -> State:
        """Start all episodes; `rng` has one key for each environment."""
        if jax.random.key_data(rng).ndim != 2 or not any(_wrappers(self.env)):
            line = "a delay goes around the wrapper for training, not inside"
            raise DelayRLError(f"{line}: give wrap_env_fn=partial(wrap, delay=...) to the training")
        state = self.env.reset(rng)
        self._check(state, len(rng))
        keys = jax.vmap(jax.random.fold_in, (0, None))(rng, STREAM)
        begin = jax.vmap(start, (self._axes, 0, 0, None))
        return self._shown(state, *begin(self.delay, keys, self._late(state.obs), jnp.zeros(self.action_size)))

    def step(self, state: State, action: jax.Array) -> State:
        """Issue actions, [N, A]. Where an episode ends, the next one is shown, as brax's own wrapper does it."""
        info = dict(state.info)
        messages = info.pop(NAME)
        episodes, acting = jax.vmap(act, (self._axes, 0, 0))(self.delay, messages.episodes, action)
        state = self.env.step(state.replace(obs=messages.obs, info=info), acting)
        obs, done = self._late(state.obs), state.done > 0
        receive = jax.vmap(arrive, (self._axes, 0, 0, 0, 0, 0))
        episodes, shown = receive(self.delay, episodes, obs, state.reward, done, jnp.zeros_like(done))
        again = jax.vmap(restart, (self._axes, 0, 0, 0, 0))
        return self._shown(state, *again(self.delay, episodes, shown, done, obs))

    @property
    def observation_size(self) -> dict[str, Any]:
        """The shape of each entry of one environment's observation."""
        obs = jax.eval_shape(self.env.unwrapped.reset, jax.random.PRNGKey(0)).obs
        own = {key: obs[key].shape for key in self._keys} if self._keys else {"state": obs.shape}
        sizes = {"privileged_state": (sum(size for (size,) in own.values()),)}
        if self._augment and self.delay.maximum:
            (first, (size,)), numbers = next(iter(own.items())), 1 if self.delay.action.rule == "wait" else 2
            own[first] = (size + self.delay.maximum * self.action_size + numbers,)
        others = {name: entry.shape for name, entry in obs.items()} if self._keys else {}
        return {**sizes, **others, **own}

    def _late(self, obs: Any) -> jax.Array:
        """Return what is delayed of the task's observation, [N, S]."""
        return jnp.concatenate([obs[key] for key in self._keys], -1) if self._keys else obs

    def _shown(self, state: State, episodes: Episode, shown: Shown) -> State:
        """Return the state with the observation that the agent sees, and keep the task's own."""
        own = {key: state.obs[key] for key in self._keys} if self._keys else {"state": state.obs}
        ends = np.cumsum([entry.shape[-1] for entry in own.values()])[:-1]
        late = dict(zip(own, jnp.split(shown.obs, ends, axis=-1), strict=True))
        if self._augment:
            vectors = jax.vmap(augmented, (self._axes, 0))(self.delay, shown)
            first = next(iter(late))
            late[first] = jnp.concatenate([late[first], vectors[:, shown.obs.shape[-1] :]], -1)
        others = state.obs if self._keys else {}
        obs = {"privileged_state": shown.truth, **others, **late}
        return state.replace(obs=obs, info={**state.info, NAME: Messages(episodes, state.obs)})

    def _check(self, state: State, count: int) -> None:
        """Raise DelayRLError unless the environments can be delayed."""
        if not any(name.endswith("first_obs") for name in state.info):  # as all wrappers that reset name it
            raise DelayRLError("a delay goes around environments that reset themselves: use delayrl.batched.brax.wrap")
        if NAME in state.info:
            raise DelayRLError(f"the task has a delay already, or uses info[{NAME!r}] for something else")
        entries = dict(state.obs) if isinstance(state.obs, Mapping) else {"": state.obs}
        if set(self._keys or [""]) - set(entries):
            given = f"a dict of {', '.join(entries)}" if "" not in entries else "one array"
            line = "keys names what is delayed of an observation that is a dict"
            raise DelayRLError(f"{line}; here it is {given}; got keys={self._keys}")
        for key in self._keys or [""]:
            if getattr(entries[key], "ndim", None) != 2:
                got = f"the shape {entries[key].shape[1:]}" if hasattr(entries[key], "shape") else "several parts"
                raise DelayRLError(f"observations must be flat vectors; {key or 'the task'} has {got}")
        trees = self._axes, self.delay
        laws = zip(*(jax.tree.leaves(tree, is_leaf=lambda x: x is None) for tree in trees), strict=True)
        for axis, array in laws:
            if axis == 0 and len(array) != count:
                raise DelayRLError(f"the delay has laws for {len(array)} environments; there are {count}")
