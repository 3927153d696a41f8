"""One episode under a delay: what is on its way, what has arrived, and what is shown. It knows no environment.

At step t the agent has issued u_0 .. u_{t-1} and has seen those of s_0 .. s_t that have arrived. It is shown an
observation, its age, and the actions that may not have acted when it was made. This makes the delayed task Markov again
where that is possible; docs/delays.md says where it is not.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from delayrl.delays import Channel, Delay

Fill = Literal["first", "zeros"]
"""What is shown before anything has arrived: s_0 without a delay, or zeros."""


class MessageQueue:
    """Messages 0, 1, … on one channel, and which of those that have arrived counts; -1 before any has."""

    def __init__(self, channel: Channel):
        self._law, self._constant, self._maximum = channel.law, channel.constant, channel.maximum
        self._raw, self._fifo, self._slots = channel.rule == "raw", channel.rule == "fifo", channel.maximum + 1
        self._settles = channel.steady and not channel.constant
        self.start()

    def start(self, newest: int = -1) -> None:
        """Empty the queue; message `newest` has arrived."""
        # by arrival time, modulo; older entries have lower numbers than what has arrived, so they need not be cleared
        self._due = [-1] * self._slots
        self._newest, self._law_state, self._latest = newest, 0, 0

    def settle(self, random: np.random.Generator) -> int:
        """Return the longest delay of this episode, and draw it if the law keeps one for an episode."""
        if not self._settles:
            return self._maximum
        travel, self._law_state = self._law.draw(0, random)
        return travel

    def send(self, number: int, random: np.random.Generator) -> int:
        """Send message `number` at time `number`. Returns the message that counts now."""
        if self._constant:  # a shortcut for the most common law
            return max(number - self._maximum, self._newest)
        travel, self._law_state = self._law.draw(self._law_state, random)
        if self._raw:
            return max(number - travel, -1)
        arrival = number + travel
        if self._fifo:
            self._latest = arrival = max(arrival, self._latest)
        self._due[arrival % self._slots] = number
        self._newest = max(self._newest, self._due[number % self._slots])
        return self._newest


class RewardQueue:
    """Rewards on their way. Each arrives once."""

    def __init__(self, channel: Channel):
        self._law, self._fifo, self._slots = channel.law, channel.rule == "fifo", channel.maximum + 1
        self._waits = channel.rule == "wait"
        self.start()

    def start(self) -> None:
        """Empty the queue."""
        self._due = [0.0] * self._slots
        self._law_state = self._latest = 0

    def send(self, reward: float, now: int, random: np.random.Generator) -> int:
        """Send the reward of the step that ended at `now`. Returns when it arrives."""
        travel = self._slots - 1
        if not self._waits:
            travel, self._law_state = self._law.draw(self._law_state, random)
        arrival = now + travel
        if self._fifo:
            self._latest = arrival = max(arrival, self._latest)
        self._due[arrival % self._slots] += reward
        return arrival

    def receive(self, now: int) -> float:
        """Remove what arrives at `now` from the queue, and return its sum."""
        slot = now % self._slots
        reward, self._due[slot] = self._due[slot], 0.0
        return reward

    def flush(self) -> float:
        """Remove all that is still on its way, and return its sum."""
        total = sum(self._due)
        self._due = [0.0] * self._slots
        return total


class Transit:
    """The delayed side of one environment.

    Attributes:
        time: steps since the start of the episode.
        over: whether the episode has ended, but the agent has not been told yet. Actions then have no effect.
        lag: the longest delay of the actions in this episode, in steps. It is part of the age.
        random: the generator of travel times.

    Args:
        delay: the delay of observations, actions and rewards.
        history: rows of the shown action history, at least `delay.maximum`.
        fill: what is shown before the first observation has arrived.
        idle: the action in force before the first one has arrived, [A], in the type of all actions.
    """

    def __init__(self, delay: Delay, history: int, fill: Fill, idle: NDArray[Any]):
        self._fill, self.idle = fill, idle
        self._observations, self._rewards = MessageQueue(delay.observation), RewardQueue(delay.reward)
        self._actions = MessageQueue(delay.action)
        self._max_action_delay, self._max_reward_delay = delay.action.maximum, delay.reward.maximum
        # each action lies twice in a ring of double length, so that any stretch of it is one slice
        self._rows = max(history, 1)
        self._ring = np.zeros((2 * self._rows, len(idle)), idle.dtype)
        self._action_age = 0  # of the action that acts now: steps since it was issued
        # by step, modulo: the true observations, and the age of the action that led to each
        self._slots = delay.observation.maximum + 1
        self._truths: list[Any] = [None] * self._slots
        self._applied = [0] * self._slots
        self._shown = 0
        self._end: int | None = None  # once the episode is over: when the agent is told
        self.time, self.over, self.lag = 0, False, self._max_action_delay
        self.random = np.random.default_rng()

    def reset(self, truth: NDArray[Any], seed: int | None = None) -> None:
        """Start an episode with the true s_0, [S]. A seed fixes the delays apart from the environment's randomness."""
        self.time, self._end, self.over = 0, None, False
        self._ring[:] = self.idle
        self._rewards.start()
        self._actions.start()
        self._truths[0], self._applied[0] = np.array(truth), 0
        self.draw_from(seed)

    def draw_from(self, seed: int | None) -> None:
        """Draw the delays of an episode that has just begun from this seed; None goes on with the generator."""
        if seed is not None:
            self.random = np.random.default_rng([seed, 1])
        self.lag = self._actions.settle(self.random)
        if self._fill == "first":
            self._observations.start(0)
            self._shown = 0
        else:
            self._observations.start()
            self._shown = self._observations.send(0, self.random)

    def act(self, action: NDArray[Any]) -> NDArray[Any]:
        """Issue an action. Returns the one that acts now: the same array if it has no delay."""
        acting, now, rows = action, self.time, self._rows
        if self._max_action_delay:
            self._action_age = min(now - self._actions.send(now, self.random), self._max_action_delay)
            if self._action_age:  # the ring holds the idle action where none has been issued
                acting = self._ring[(now - self._action_age) % rows].copy()
        row = now % rows
        self._ring[row] = self._ring[row + rows] = action
        return acting

    def step(self, truth: NDArray[Any], reward: float, terminated: bool, truncated: bool) -> tuple[float, bool, bool]:
        """Take in the outcome of a step, and return the reward, termination and truncation that arrive now.

        Once the episode is `over`, the outcome is the last true observation again, without a reward.
        """
        self.time += 1
        slot = self.time % self._slots
        self._truths[slot], self._applied[slot] = np.array(truth), self._action_age
        self._shown = self._observations.send(self.time, self.random)
        if self._shown < 0 and self._fill == "first":
            self._shown = 0
        if not self._max_reward_delay:
            return reward, terminated, truncated
        if not self.over:
            arrival = self._rewards.send(float(reward), self.time, self.random)
            if terminated:
                self._end, self.over = arrival, True
        reward = self._rewards.receive(self.time)
        # the learner knows of a time limit at once, so it ends the waiting
        terminated = self.over and (truncated or self._end == self.time)
        if terminated or truncated:
            reward += self._rewards.flush()
        return reward, terminated, truncated

    def shown(self) -> tuple[NDArray[Any], int, NDArray[Any], int]:
        """Return what the agent sees now, as views: copy them before the next step.

        Returns:
            obs: the observation, [S].
            age: how many actions may not have acted on it: its own age plus `lag`.
            actions: these actions as they were issued, oldest first, [age, A].
            applied: the age of the action that led to the observation.
        """
        nothing_arrived = self._shown < 0
        made = 0 if nothing_arrived else self._shown
        age = self.time - made + self.lag
        first, slot = (self.time - age) % self._rows, made % self._slots
        actions = self._ring[first : first + age]
        if nothing_arrived:
            return np.zeros_like(self._truths[0]), age, actions, 0
        return self._truths[slot], age, actions, self._applied[slot]
