"""The steps that a plant has gone through, and the action that it was given in each.

Steps are numbered from the start of the episode. Only the newest ones are remembered.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

Action = NDArray[np.float32]


class History:
    """Keep the steps, when they begin, and their actions. Only this class rounds time to steps.

    Args:
        period: nominal length of a step; 1 if time is counted in steps.
        lead: steps from a command to its effect.
        capacity: how many steps are remembered.
        idle: the action of a step without a command, [A]; None to go on with the action before.
        first: the action before any other, [A].
        counts: the counters `missed` and `replaced`, which `record` updates.
    """

    def __init__(
        self, period: float, lead: int, capacity: int, idle: Action | None, first: Action, counts: dict[str, int]
    ) -> None:
        self._period, self.lead, self._capacity = period, lead, capacity
        self._idle, self._first, self._counts = idle, first, counts
        self._begins: deque[float] = deque(maxlen=capacity)
        self._actions: deque[Action] = deque(maxlen=capacity)
        self.length = 0

    @property
    def last(self) -> Action:
        """What the plant does if it gets no other command."""
        return self._actions[-1] if self._actions else self._uncommanded()

    def age(self, stamp: float, now: float, elapsed: int) -> tuple[int, int, list[Action]]:
        """Locate an observation, for a command at `now`.

        Args:
            stamp: when the observation was made.
            now: when the command is given.
            elapsed: steps before `now`; used only if there has been no command yet.

        Returns:
            The step of the observation; its age, which is the number of steps from there to the step of the command;
            and the actions of these steps, oldest first. There are fewer actions than the age says if the oldest are
            no longer remembered.
        """
        gap, added = self._gap(now, elapsed), self._begins_up_to(now, elapsed)
        begins, actions = [*self._begins, *added], [*self._actions, *[self._uncommanded()] * (len(added) - 1)]
        if gap == 0:
            actions = actions[:-1]
        elif gap - 1 > self._capacity:  # the added steps alone fill the history
            begins, actions = added, actions[1 - len(added) :]
        commanded = self.length - 1 + gap
        first = commanded + 1 - len(begins)
        i = len(begins) - 1
        while i > 0 and stamp < (begins[i - 1] + begins[i]) / 2:
            i -= 1
        if i == 0 and first > 0:  # no longer remembered: count back one period at a time
            i = min(0, math.floor((stamp - begins[0]) / self._period + 0.5))
        step = min(max(0, first + i), commanded - self.lead)
        return step, commanded - step, actions[max(0, step - first) :]

    def record(self, action: Action, now: float, elapsed: int) -> None:
        """Add a command given at `now`, and the steps without a command before it."""
        gap, added = self._gap(now, elapsed), self._begins_up_to(now, elapsed)
        if gap == 0:
            self._actions[-1] = action
            self._counts["replaced"] += 1
            return
        self._counts["missed"] += gap - 1 if self.length else elapsed
        self._actions.extend([*[self._uncommanded()] * (len(added) - 1), action])
        self._begins.extend(added)
        self.length += gap

    def correct(self, action: Action, step: int) -> bool:
        """Replace the action of a step. Returns False if the step is no longer remembered."""
        position = step - (self.length - len(self._actions))
        if position >= 0:
            self._actions[position] = action
        return position >= 0

    def _gap(self, now: float, elapsed: int) -> int:
        """Return the steps from the newest step to that of a command at `now`; 0 if they are the same."""
        if not self._begins:
            return elapsed + self.lead + 1
        return math.floor((now + self.lead * self._period - self._begins[-1]) / self._period + 0.5)

    def _begins_up_to(self, now: float, elapsed: int) -> list[float]:
        """Return when the steps after the newest begin, up to that of a command at `now`; long gaps are cut."""
        begin, gap = now + self.lead * self._period, self._gap(now, elapsed)
        uncommanded = min(gap - 1, self._capacity)
        if uncommanded < 0:
            return []
        if self._begins:  # without a command the plant went on, a period at a time
            last = self._begins[-1]
            return [last + (gap - uncommanded + i) * self._period for i in range(uncommanded)] + [begin]
        return [begin - (uncommanded - i) * self._period for i in range(uncommanded)] + [begin]

    def _uncommanded(self) -> Action:
        """Return the action of a step that has no command."""
        if self._idle is not None:
            return self._idle
        return self._actions[-1] if self._actions else self._first
