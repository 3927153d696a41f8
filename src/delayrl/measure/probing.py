"""The delay that an environment really has, found by pushing it.

An episode is played twice from one seed; the second time one action, that of step k, is another. Whatever differs
afterwards differs because of that action. With the pushes k = 0, 1, 2, … of one episode beside each other,

    what t shows was made t - 1 - max{k : the observation at t differs after push k} steps too late:

the age of the newest action whose effect is in the observation, for every step t, hence a distribution where the
delay is random (the same seed draws the same delays). Convention: t counts observations, 0 is that of `reset`; the
delay is 0 when the observation that `step(a)` returns reacts to that a already.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from delayrl.errors import DelayRLError
from delayrl.measure.pushes import Array, Env, Pushes, Roll, actions, differs, play, push

Counts = dict[int, int]  # steps of delay: how often

SCALES = (1.0, 0.1, 0.01, 0.001)  # of the push: a smaller one where the largest ends the episode before it is seen
SCOUTS = 8  # first pushes of an episode, with which the rough delay is found
SPARE = 32  # steps that are looked at beyond the longest delay
STARTS = 4  # episodes tried for each scale of the push


@dataclass(frozen=True)
class Probed:
    """Delays in environment steps, each as {steps: how often}.

    Attributes:
        total: for each step, the age of the newest action whose effect is in the observation.
        action: for each action, steps until the state (or, see `action_from`, the reward) reacts; None if unknown.
        observation: for each step, steps since the shown state; None if unknown.
        reaction: for each action, steps until an observation first reacts.
        action_from: what showed that an action had acted.
        lost: share of the actions that changed nothing at all (overtaken, held, saturated).
        components: for each component of the observation the fewest steps until it reacts; None: never.
        echoes: components that repeat the action itself, and are not counted as observing anything.
        episodes, length, seed: how many episodes of how many steps, from which seed on.
        scale: size of the push as a share of the largest.
        environment: its name.
    """

    environment: str
    total: Counts
    action: Counts | None
    observation: Counts | None
    reaction: Counts
    action_from: str
    lost: float
    components: tuple[int | None, ...]
    echoes: tuple[int, ...]
    episodes: int
    length: int
    seed: int
    scale: float

    @property
    def maximum(self) -> int:
        """The longest total delay: the number of actions that an agent has to remember."""
        return max(self.total)

    def json(self) -> dict[str, Any]:
        """For `json.dumps`."""
        return {"kind": "environment", **asdict(self), "maximum": self.maximum}


def probe(
    env: str | Env | Callable[[], Env],
    episodes: int = 8,
    seed: int = 0,
    longest: int = 200,
    wrap: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Probed:
    """Measure the delay of an environment.

    Args:
        env: an id of Gymnasium's registry, an environment, or a function without arguments that makes one. Its actions
            must be a `Box`; observations may be any space that Gymnasium can flatten.
        episodes: how many, from seeds `seed`, `seed + 1`, …
        seed: the first of them.
        longest: the longest delay that is looked for, in steps.
        wrap: goes around the episodes, e.g. a progress bar.

    Raises:
        DelayRLError: the environment does not repeat itself, or nothing ever reacts; other actions than a `Box`.
    """
    if episodes < 1 or longest < 1:
        raise DelayRLError(f"episodes and longest count from 1; got {episodes} and {longest}")
    made = not isinstance(env, gym.Env)
    task = _make(env)
    try:
        return _probe(task, episodes, seed, longest, wrap)
    except DelayRLError:
        raise
    except Exception as error:  # an environment may raise anything
        raise DelayRLError(f"{task} failed while it was played: {_line(error)}") from error
    finally:
        if made:
            task.close()


def _probe(env: Env, episodes: int, seed: int, longest: int, wrap: Callable[[Iterable[int]], Iterable[int]]) -> Probed:
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    if not isinstance(env.action_space, Box) or not np.issubdtype(env.action_space.dtype, np.floating):
        raise DelayRLError(f"{name}: only real-valued Box actions can be probed; got {env.action_space}")
    scale, delay = _scout(env, name, seed, longest)
    steps = 0
    while steps < delay + SPARE:
        steps = delay + SPARE
        found = [push(env, seed + e, scale, steps) for e in wrap(range(episodes))]
        ages = [_total(pushes.obs) for pushes in found]
        delay = min(max(delay, *(int(age.max()) for age in ages)), longest)  # random ones may be longer than the first
    return _gather(name, found, ages, delay, steps, episodes, seed, scale)


def _gather(
    name: str, found: list[Pushes], ages: list[Array], oldest: int, steps: int, episodes: int, seed: int, scale: float
) -> Probed:
    oldest = max((int(age.max()) for age in ages if (age >= 0).any()), default=oldest)
    # the first steps of an episode cannot show old actions, there are none: they would make delays look shorter
    total = Counter(int(a) for age in ages for t, a in enumerate(age) if a >= 0 and t > oldest)
    late = [p.channel("obs") - 1 - np.arange(len(p.obs)) for p in found]
    reaction = Counter(int(d) for p, delays in zip(found, late, strict=True) for d in _settled(p, delays, oldest))
    if not total and not reaction:
        raise DelayRLError(f"{name}: its episodes end too early to see a delay of about {oldest} steps")
    lost = [(p.obs[k, 1:] != 1).all() for p in found for k in range(len(p.obs)) if _watched(p, k, oldest)]
    action_from, channel = _acts(found)
    action: Counts | None = None
    observation: Counts | None = None
    if channel:
        delays = [p.channel(channel) - 1 - np.arange(len(p.obs)) for p in found]
        action = Counter(int(d) for p, each in zip(found, delays, strict=True) for d in _settled(p, each, oldest))
        shown = [_shown(p.obs, p.channel(channel)) for p in found]
        observation = Counter(int(a) for age in shown for t, a in enumerate(age) if a >= 0 and t > oldest)
    echo = np.any([p.echo.any(0) for p in found], axis=0)
    each = np.concatenate(
        [np.where(p.components > 0, p.components - 1 - np.arange(len(p.obs))[:, None], -1) for p in found]
    )
    least = np.where(each >= 0, each, np.iinfo(int).max).min(0)
    return Probed(
        environment=name,
        total=_ordered(total or reaction),
        action=_ordered(action) if action else None,
        observation=_ordered(observation) if observation else None,
        reaction=_ordered(reaction),
        action_from=action_from,
        lost=float(np.mean(lost)) if lost else 0.0,
        components=tuple(None if (each[:, c] < 0).all() else int(least[c]) for c in range(each.shape[1])),
        echoes=tuple(int(c) for c in np.flatnonzero(echo)),
        episodes=episodes,
        length=steps,
        seed=seed,
        scale=scale,
    )


def _scout(env: Env, name: str, seed: int, longest: int) -> tuple[float, int]:
    """A size of the push whose effect is seen before the episode ends, and roughly after how many steps it is."""
    steps = longest + SCOUTS
    best: tuple[int, float, int] | None = None
    played = 0
    for scale in SCALES:
        for start in range(seed, seed + STARTS):
            chosen = actions(env, start, steps, scale)
            base = play(env, start, chosen)
            _check_repeats(name, base, play(env, start, chosen))
            played = max(played, len(base.obs) - 1)
            pushes = push(env, start, scale, steps, SCOUTS, base)
            delays = pushes.channel("obs") - 1 - np.arange(len(pushes.obs))
            if (delays >= 0).any():
                delay = int(delays.max())
                followed = int(np.median((pushes.obs >= 0).sum(1)))  # steps until an episode ends after a push
                spare = followed - delay - SPARE
                if spare >= 0:
                    return scale, delay
                if best is None or spare > best[0]:
                    best = spare, scale, delay
    if best is None:
        ended = "" if played == steps else f" (no episode was longer than {played} steps)"
        raise DelayRLError(
            f"{name}: no observation reacted to an action within {min(played, longest)} steps{ended}: the delay is "
            "longer, or what is observed does not depend on actions"
        )
    return best[1], best[2]


def _check_repeats(name: str, one: Roll, two: Roll) -> None:
    length = min(len(one.obs), len(two.obs))
    same = np.ones(length, bool)
    for a, b in ((one.obs, two.obs), (one.state, two.state), (one.rest, two.rest)):
        same &= ~differs(a[:length], b[:length]).any(1)
    if not same.all() or len(one.obs) != len(two.obs):
        step = int(np.argmin(same)) if not same.all() else length
        raise DelayRLError(
            f"{name} does not repeat itself: two roll-outs with the same seed and actions differ at step {step}. "
            "Let reset(seed=…) fix all its random numbers (draw them from self.np_random, wrappers too), or probe it "
            "without its noise"
        )


def _acts(found: list[Pushes]) -> tuple[str, str]:
    """By what an action is seen to act: the state, or else the first reward (or end of the episode) that differs."""
    for channel, label in (
        ("state", found[0].state_from),
        ("rest", "the first reward that differs (no state is visible)"),
    ):
        pairs = [(a, o) for p in found for a, o in zip(p.channel(channel), p.channel("obs"), strict=True) if o > 0]
        acted = [a > 0 and a <= o for a, o in pairs]
        if label and acted and all(acted):
            return label, channel
    return "nothing: no state is visible and rewards do not react before observations", ""


def _total(seen: Array) -> Array:
    """Age at each step t of the newest action that has an effect, [T+1]; -1 where it is not known."""
    count, length = seen.shape
    ages = np.full(length, -1)
    for t in range(1, length):
        if t > count:
            break
        column = seen[:t, t]
        newest = np.flatnonzero(column == 1)
        if newest.size and (column[newest[-1] + 1 :] == 0).all():
            ages[t] = t - 1 - newest[-1]
    return ages


def _shown(seen: Array, acted: Array) -> Array:
    """Age at each step t of the shown state, [T+1]; -1 where the pushes leave more than one possibility."""
    count, length = seen.shape
    ages = np.full(length, -1)
    for t in range(1, min(length, count + 1)):
        column = seen[:t, t]
        reached = acted[:t][(column == 1) & (acted[:t] > 0)]
        if not reached.size:
            continue
        later = (acted[:t] > reached.max()) & (acted[:t] <= t)
        if (column[later] != 0).any() or (column[acted[:t] < 0] == -1).any():
            continue
        above = acted[:t][later].min() if later.any() else t + 1
        if above - reached.max() == 1:  # state `reached` is shown and the next one is not
            ages[t] = t - reached.max()
    return ages


def _watched(pushes: Pushes, k: int, longest: int) -> bool:
    """Whether push k was followed for so long that any effect would have been seen."""
    t = k + 1 + longest
    return t < pushes.obs.shape[1] and bool(pushes.obs[k, t] != -1)


def _settled(pushes: Pushes, delays: Array, longest: int) -> list[int]:
    return [int(d) for k, d in enumerate(delays) if d >= 0 and k + 1 + longest < pushes.obs.shape[1]]


def _ordered(counts: Counts) -> Counts:
    return {steps: counts[steps] for steps in sorted(counts)}


def _make(env: str | Env | Callable[[], Env]) -> Env:
    if isinstance(env, gym.Env):
        return env
    if isinstance(env, str):
        from delayrl.envs import make

        return make(env).env
    try:
        made = env()
    except Exception as error:
        raise DelayRLError(f"{getattr(env, '__name__', env)}() failed: {_line(error)}") from error
    if not isinstance(made, gym.Env):
        raise DelayRLError(
            f"{getattr(env, '__name__', env)}() must return a Gymnasium environment; got {type(made).__name__}"
        )
    return made


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).strip() or '-'}".splitlines()[0]
