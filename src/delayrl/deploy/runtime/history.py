"""The list of steps that a plant has gone through, and the action that it was given in each.

Numbers are those of steps from the start of the episode on; what is remembered is their newest end.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float32]


class History:
    """Steps, when they begin, and their actions; the rounding of time to steps is here and nowhere else.

    Args:
        period: nominal length of a step; 1 if time is counted in steps.
        lead: steps from a command to its effect.
        kept: how many steps are remembered.
        idle: the action of a step without a command; None to go on with the action before.
        first: the action before any other.
    """

    def __init__(self, period: float, lead: int, kept: int, idle: Action | None, first: Action) -> None:
        self._period, self._lead, self._kept = period, lead, kept
        self._idle, self._first = idle, first
        self._begins: deque[float] = deque(maxlen=kept)
        self._actions: deque[Action] = deque(maxlen=kept)
        self.length = 0
        self.missed = self.replaced = 0

    @property
    def last(self) -> Action:
        """What the plant does if it gets no other command."""
        return self._actions[-1] if self._actions else self._nothing()

    def age(self, stamp: float, now: float, elapsed: int) -> tuple[int, int, list[Action]]:
        """Where an observation lies, for a command at `now`.

        Args:
            stamp: when the observation was made.
            now: when the command is given.
            elapsed: steps before `now`, if there has been no command yet.

        Returns:
            The step of the observation; its age, the steps from it to the one that the command is for; and the actions
            of these, oldest first: fewer than the age if the oldest are forgotten.
        """
        gap, fresh = self._gap(now, elapsed), self._fresh(now, elapsed)
        begins, actions = [*self._begins, *fresh], [*self._actions, *[self._nothing()] * (len(fresh) - 1)]
        if gap == 0:
            actions = actions[:-1]
        elif gap - 1 > self._kept:  # the fresh ones alone fill the memory
            begins, actions = fresh, actions[1 - len(fresh) :]
        commanded = self.length - 1 + gap
        first = commanded + 1 - len(begins)
        i = len(begins) - 1
        while i > 0 and stamp < (begins[i - 1] + begins[i]) / 2:
            i -= 1
        if i == 0 and first > 0:  # forgotten: as if the steps before had been a period apart
            i = min(0, math.floor((stamp - begins[0]) / self._period + 0.5))
        step = min(max(0, first + i), commanded - self._lead)
        return step, commanded - step, actions[max(0, step - first) :]

    def record(self, action: Action, now: float, elapsed: int) -> None:
        """Take down a command given at `now`."""
        gap, fresh = self._gap(now, elapsed), self._fresh(now, elapsed)
        if gap == 0:
            self._actions[-1] = action
            self.replaced += 1
            return
        self.missed += gap - 1 if self.length else elapsed
        self._actions.extend([*[self._nothing()] * (len(fresh) - 1), action])
        self._begins.extend(fresh)
        self.length += gap

    def correct(self, action: Action, step: int) -> bool:
        """Put another action in a step's place; False if the step is forgotten."""
        position = step - (self.length - len(self._actions))
        if position >= 0:
            self._actions[position] = action
        return position >= 0

    def _gap(self, now: float, elapsed: int) -> int:
        """Steps from the newest one to the one of a command at `now`; 0 if they are the same."""
        if not self._begins:
            return elapsed + self._lead + 1
        return math.floor((now + self._lead * self._period - self._begins[-1]) / self._period + 0.5)

    def _fresh(self, now: float, elapsed: int) -> list[float]:
        """When the steps after the newest one begin, up to the one of a command at `now`; no more than are kept."""
        begin, gap = now + self._lead * self._period, self._gap(now, elapsed)
        fill = min(gap - 1, self._kept)
        if fill < 0:
            return []
        if self._begins:  # without a command the plant went on, a period at a time
            return [self._begins[-1] + (gap - fill + i) * self._period for i in range(fill)] + [begin]
        return [begin - (fill - i) * self._period for i in range(fill)] + [begin]

    def _nothing(self) -> Action:
        if self._idle is not None:
            return self._idle
        return self._actions[-1] if self._actions else self._first
