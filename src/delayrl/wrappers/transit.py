"""One episode under a delay: what is on its way, what has arrived, and what is shown. It knows no environment.

At step t the agent has seen s_0 .. s_t as far as they have arrived, and issued u_0 .. u_{t-1}. What is shown makes the
delayed task Markov again where that is possible (docs/delays.md says where not): the observation, its age, and the
actions that may not have acted yet when it was made.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from delayrl.delays import Channel, Delay

Fill = Literal["first", "zeros"]
"""What is shown before anything has arrived: s_0, which then has no delay, or zeros."""


class Line:
    """Messages 0, 1, … on one channel; of those that have arrived, which counts. -1 before any has."""

    def __init__(self, channel: Channel):
        self._law, self._raw, self._fifo = channel.law, channel.rule == "raw", channel.rule == "fifo"
        self._slots = channel.maximum + 1
        self._constant = channel.maximum if channel.constant else None  # the short way, for what is most common
        self.start()

    def start(self, newest: int = -1) -> None:
        """Nothing is on its way; message `newest` is there."""
        self._due = [-1] * self._slots  # by arrival time, modulo: older entries are overtaken, so none is cleared
        self._newest, self._memory, self._latest = newest, 0, 0

    def send(self, number: int, random: np.random.Generator) -> int:
        """Send message `number`, at time `number`; which counts now. Numbers go up by one."""
        if self._constant is not None:
            return max(number - self._constant, self._newest)
        travel, self._memory = self._law.draw(self._memory, random)
        if self._raw:
            return max(number - travel, -1)
        arrival = number + travel
        if self._fifo:
            self._latest = arrival = max(arrival, self._latest)
        self._due[arrival % self._slots] = number
        newest = self._due[number % self._slots]
        if newest > self._newest:
            self._newest = newest
        return self._newest


class Rewards:
    """Rewards on their way: each arrives once; `flush` gives what is left."""

    def __init__(self, channel: Channel):
        self._law, self._fifo, self._slots = channel.law, channel.rule == "fifo", channel.maximum + 1
        self.start()

    def start(self) -> None:
        """Nothing is on its way."""
        self._due = [0.0] * self._slots
        self._memory = self._latest = 0

    def send(self, reward: float, now: int, random: np.random.Generator) -> int:
        """Send what was earned by the step that ended at `now`; when it arrives."""
        travel, self._memory = self._law.draw(self._memory, random)
        arrival = now + travel
        if self._fifo:
            self._latest = arrival = max(arrival, self._latest)
        self._due[arrival % self._slots] += reward
        return arrival

    def receive(self, now: int) -> float:
        """The sum of what arrives at `now`."""
        reward, self._due[now % self._slots] = self._due[now % self._slots], 0.0
        return reward

    def flush(self) -> float:
        """The sum of all that is still on its way."""
        total = sum(self._due)
        self._due = [0.0] * self._slots
        return total


class Transit:
    """The delayed side of one environment.

    Attributes:
        time: steps since the start of the episode.
        over: the episode has ended in truth, and the agent has not been told yet: nothing acts any more.
        random: where travel times are drawn from.

    Args:
        delay: of observations, actions and rewards.
        history: rows of the shown action buffer, at least `delay.maximum`.
        fill: what is shown before the first observation has arrived.
        size: of an action (A).
        dtype: of actions.
        idle: the action in force before the first one has arrived, [A].
    """

    def __init__(self, delay: Delay, history: int, fill: Fill, size: int, dtype: Any, idle: NDArray[Any]):
        self._fill, self._idle = fill, idle
        self._lines, self._rewards = Line(delay.observation), Rewards(delay.reward)
        self._acting = Line(delay.action) if delay.action.maximum else None
        self._late_rewards = delay.reward.maximum > 0
        self._lag = delay.action.maximum
        self._slots = delay.observation.maximum + 1
        # each action lies twice in a ring of double length, so that any stretch of it is one slice
        self._rows = max(history, 1)
        self._ring = np.zeros((2 * self._rows, size), dtype)
        self._lateness = 0  # of the action that acts now, in steps
        self._states: list[Any] = [None] * self._slots
        self._applied = [0] * self._slots  # by step: steps since the action was issued that led to this state
        self.random = np.random.default_rng()

    def reset(self, truth: NDArray[Any], seed: int | None = None) -> None:
        """Start an episode with the true s_0.

        A seed fixes the delays: a stream of their own, so that they do not disturb the environment's randomness.
        """
        if seed is not None:
            self.random = np.random.default_rng([seed, 1])
        self.time = 0
        self._end: int | None = None  # when the agent is told that the episode is over, once it is
        self.over = False
        self._ring[:] = self._idle
        self._rewards.start()
        if self._acting:
            self._acting.start()
        self._states[0], self._applied[0] = np.array(truth), 0
        if self._fill == "first":
            self._lines.start(0)
            self._shown = 0
        else:
            self._lines.start()
            self._shown = self._lines.send(0, self.random)

    def act(self, action: NDArray[Any]) -> NDArray[Any]:
        """Issue an action; the one that acts now, which is the same array if nothing is late."""
        applied, now, rows = action, self.time, self._rows
        if self._acting:
            self._lateness = min(now - self._acting.send(now, self.random), self._lag)
            if self._lateness:  # before the first has arrived, the idle action that the ring was filled with
                applied = self._ring[(now - self._lateness) % rows].copy()
        row = now % rows
        self._ring[row] = self._ring[row + rows] = action
        return applied

    def step(self, truth: NDArray[Any], reward: float, terminated: bool, truncated: bool) -> tuple[float, bool, bool]:
        """Take in the outcome of a step, or after the end (`over`) the last state again and 0; what arrives of it."""
        self.time += 1
        slot = self.time % self._slots
        self._states[slot], self._applied[slot] = np.array(truth), self._lateness
        shown = self._lines.send(self.time, self.random)
        self._shown = shown if shown >= 0 or self._fill == "zeros" else 0
        if self._late_rewards:
            if self._end is None:
                arrival = self._rewards.send(float(reward), self.time, self.random)
                self._end, self.over = (arrival, True) if terminated else (None, False)
            reward = self._rewards.receive(self.time)
            # a time limit is the learner's own: it ends the waiting
            terminated = self._end is not None and (truncated or self._end == self.time)
            if terminated or truncated:
                reward += self._rewards.flush()
        return reward, terminated, truncated

    def shown(self) -> tuple[NDArray[Any], int, NDArray[Any], int]:
        """What is seen now: views of what is kept here, to be copied before the next step.

        Returns:
            The observation; `age`; the `age` newest actions that were issued, oldest first; and how old the action was
            that led to the observation, whose own age is `age` less the longest action delay.
        """
        now, shown = self.time, self._shown
        age = (now - shown if shown >= 0 else now) + self._lag
        first = (now - age) % self._rows
        actions, slot = self._ring[first : first + age], shown % self._slots
        if shown < 0:
            return np.zeros_like(self._states[0]), age, actions, 0
        return self._states[slot], age, actions, self._applied[slot]
