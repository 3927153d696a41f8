"""Measure the delay that an environment really has, by changing one action at a time.

An episode is played twice from one seed. The second time, a *push* changes one action, that of step k. Whatever differs
afterwards differs because of that action. Over the pushes k = 0, 1, 2, … of one episode, the delay at step t is

    t - 1 - max{k : the observation at t differs after push k},

the age of the newest action whose effect is in the observation. If delays are random this gives their distribution,
because the same seed repeats them. t counts observations, from that of `reset` at 0. The delay is 0 if the observation
that `step(a)` returns reacts to that a.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from operator import itemgetter
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from delayrl.envs.making import name_of
from delayrl.envs.task import TaskLike, as_task, closing_quietly
from delayrl.errors import DelayRLError, one_line
from delayrl.measure.pushes import Array, Env, Pushes, Rollout, actions, differs, play, push, repeating

Counts = dict[int, int]  # {steps of delay: how often}

SCALES = (1.0, 0.1, 0.01, 0.001)  # of a push; smaller ones are tried if larger ones end the episode too early
SCOUTS = 8  # pushes at the start of an episode that give a rough delay
SPARE = 32  # steps that are examined beyond the longest delay
STARTS = 4  # episodes tried for each scale


@dataclass(frozen=True)
class Probed:
    """The delays of an environment, in its steps, each as {steps: how often}."""

    environment: str  # its name
    total: Counts  # for each step, the age of the newest action whose effect is in the observation
    action: Counts | None  # for each action, steps until the state (or see `action_from`) reacts; None if unknown
    observation: Counts | None  # for each step, the age of the shown state; None if unknown
    reaction: Counts  # for each action, steps until an observation first reacts
    action_from: str  # what shows that an action has acted
    lost: float  # share of the actions that changed nothing (overtaken, held, saturated)
    components: tuple[int | None, ...]  # fewest steps until each component of the observation reacts; None if never
    echoes: tuple[int, ...]  # components that repeat the action itself, and do not count as a reaction
    episodes: int
    length: int  # steps of an episode, at most
    seed: int  # of the first episode
    scale: float  # size of the push, relative to the largest

    @property
    def maximum(self) -> int:
        """The longest total delay, which is the number of actions that an agent must remember."""
        return max(self.total)

    def json(self) -> dict[str, Any]:
        """Return a dict for `json.dumps`."""
        return {"kind": "environment", **asdict(self), "maximum": self.maximum}


def probe(
    env: TaskLike | Env,
    episodes: int = 8,
    seed: int = 0,
    longest: int = 200,
    wrap: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Probed:
    """Measure the delay of an environment.

    Args:
        env: an environment, or what makes one: an id of Gymnasium's registry, `module:object`, a class or function.
            Its actions must be a `Box`; observations may be any space that Gymnasium can flatten.
        episodes: how many to play, from the seeds `seed`, `seed + 1`, …
        seed: of the first episode.
        longest: the longest delay to look for, in steps.
        wrap: wraps the episodes, for example in a progress bar.

    Raises:
        DelayRLError: no such task, the actions are not a `Box`, the environment does not repeat itself, or no
            observation reacts.
    """
    if episodes < 1 or longest < 1:
        raise DelayRLError(f"episodes and longest count from 1; got {episodes} and {longest}")
    made = nullcontext(env) if isinstance(env, gym.Env) else closing_quietly(as_task(env).make())
    with made as task, one_line(f"{name_of(task)} failed while it was played"):
        return _probe(task, episodes, seed, longest, wrap)


def _probe(env: Env, episodes: int, seed: int, longest: int, wrap: Callable[[Iterable[int]], Iterable[int]]) -> Probed:
    name = name_of(env)
    if not isinstance(env.action_space, Box) or not np.issubdtype(env.action_space.dtype, np.floating):
        raise DelayRLError(f"{name}: only real-valued Box actions can be probed; got {env.action_space}")
    scale, delay = _scout(env, name, seed, longest)
    steps = 0
    while steps < delay + SPARE:
        steps = delay + SPARE
        pushes = [push(env, seed + e, scale, steps) for e in wrap(range(episodes))]
        ages = [_shown(p.obs, np.arange(len(p.obs)) + 1) for p in pushes]  # as if each action acted at once
        delay = min(max(delay, *(int(age.max()) for age in ages)), longest)  # random delays may exceed the first
    oldest = max((int(age.max()) for age in ages if (age >= 0).any()), default=delay)
    total = _count_ages(ages, oldest)
    reaction = _count(d for p in pushes for d in _settled(p, "obs", oldest))
    if not total and not reaction:
        raise DelayRLError(f"{name}: its episodes end too early to see a delay of about {oldest} steps")
    # only pushes that enough steps follow to show any effect
    lost = [(row[1:] != 1).all() for p in pushes for k, row in enumerate(p.obs) if (row >= 0).sum() > k + 1 + oldest]
    action_from, channel = _action_channel(pushes)
    action: Counts = {}
    observation: Counts = {}
    if channel:
        action = _count(d for p in pushes for d in _settled(p, channel, oldest))
        observation = _count_ages([_shown(p.obs, p.channel(channel)) for p in pushes], oldest)
    echo = np.any([repeating(p.echo) for p in pushes], 0)
    reactions = np.concatenate([p.components - 1 - np.arange(len(p.obs))[:, None] for p in pushes])  # negative if none
    never = np.iinfo(int).max
    fewest = np.where(reactions >= 0, reactions, never).min(0)
    return Probed(
        environment=name,
        total=total or reaction,
        action=action or None,
        observation=observation or None,
        reaction=reaction,
        action_from=action_from,
        lost=float(np.mean(lost)) if lost else 0.0,
        components=tuple(None if steps == never else int(steps) for steps in fewest),
        echoes=tuple(int(c) for c in np.flatnonzero(echo)),
        episodes=episodes,
        length=steps,
        seed=seed,
        scale=scale,
    )


def _scout(env: Env, name: str, seed: int, longest: int) -> tuple[float, int]:
    """Return a scale whose effect shows before the episode ends, and the rough delay of that effect, in steps."""
    steps = longest + SCOUTS
    seen: list[tuple[int, float, int]] = []
    played = 0
    for scale in SCALES:
        for start in range(seed, seed + STARTS):
            chosen = actions(env, start, steps, scale)
            base = play(env, start, chosen)
            _check_repeats(name, base, play(env, start, chosen))
            played = max(played, len(base.obs) - 1)
            pushes = push(env, start, scale, steps, SCOUTS, base)
            delays = pushes.delays("obs")
            if (delays >= 0).any():
                delay = int(delays.max())
                followed = int(np.median((pushes.obs >= 0).sum(1)))  # steps until an episode ends after a push
                spare = followed - delay - SPARE
                if spare >= 0:
                    return scale, delay
                seen.append((spare, scale, delay))
    if not seen:
        ended = "" if played == steps else f" (no episode was longer than {played} steps)"
        unseen = f"no observation reacted to an action within {min(played, longest)} steps{ended}"
        raise DelayRLError(f"{name}: {unseen}: the delay is longer, or observations do not depend on actions")
    return max(seen, key=itemgetter(0))[1:]


def _check_repeats(name: str, played: Rollout, again: Rollout) -> None:
    length = min(len(played.obs), len(again.obs))
    same = np.ones(length, bool)
    for a, b in ((played.obs, again.obs), (played.state, again.state), (played.rest, again.rest)):
        same &= ~differs(a[:length], b[:length]).any(1)
    if not same.all() or len(played.obs) != len(again.obs):
        step = int(np.argmin([*same, False]))
        seen = f"two roll-outs with the same seed and actions differ at step {step}"
        hint = "Let reset(seed=…) fix all random numbers (from self.np_random, in wrappers too), or probe without noise"
        raise DelayRLError(f"{name} does not repeat itself: {seen}. {hint}")


def _action_channel(pushes: list[Pushes]) -> tuple[str, str]:
    """Return what shows that an action has acted, in words and as a channel: the state, or else the first reward."""
    labels = {"state": pushes[0].state_from, "rest": "the first reward that differs (no state is visible)"}
    for channel, label in labels.items():
        pairs = [(a, o) for p in pushes for a, o in zip(p.channel(channel), p.channel("obs"), strict=True) if o > 0]
        acted = [a > 0 and a <= o for a, o in pairs]
        if label and acted and all(acted):
            return label, channel
    return "nothing: no state is visible and rewards do not react before observations", ""


def _shown(effect: Array, acted: Array) -> Array:
    """Return the age at each step of the shown state, [T+1]; -1 if the pushes leave more than one possibility."""
    count, length = effect.shape
    ages = np.full(length, -1)
    for t in range(1, min(length, count + 1)):
        column = effect[:t, t]
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


def _settled(pushes: Pushes, channel: str, longest: int) -> list[int]:
    """Return the delays of the pushes that enough steps follow."""
    delays = pushes.delays(channel)
    return [int(d) for k, d in enumerate(delays) if d >= 0 and k + 1 + longest < pushes.obs.shape[1]]


def _count_ages(ages: list[Array], oldest: int) -> Counts:
    """Count the known ages, without the first steps of an episode, in which no action can be old."""
    return _count(int(a) for age in ages for t, a in enumerate(age) if a >= 0 and t > oldest)


def _count(steps: Iterable[int]) -> Counts:
    return dict(sorted(Counter(steps).items()))
