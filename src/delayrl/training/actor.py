"""The host's side of one seed: its environment, and where it is in its current episode."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.core.protocol import CORRECTED, Protocol
from delayrl.core.types import Seen, Transition
from delayrl.core.views import seen_now
from delayrl.errors import DelayRLError
from delayrl.play import stepping
from delayrl.play.evaluation import TRAINING, reset_seed
from delayrl.wrappers import Delayed


class Actor:
    """One seed's environment, the number of its current episode, and the actions taken in that so far."""

    seen: Seen
    truth: NDArray[np.float32]  # the true observation now, [S]
    total: float  # the return of the current episode so far
    finished: list[dict[str, Any]]  # number, return and length of episodes that ended, until somebody takes them

    def __init__(self, env: Delayed, seed: int, privileged: bool, protocol: Protocol = CORRECTED) -> None:
        self.env, self.seed, self.privileged, self.protocol = env, seed, privileged, protocol
        self.finished = []
        self.start_episode(0)

    def start_episode(self, episode: int) -> None:
        """Start an episode from its own seed, or under protocol `official` from the run's."""
        self.episode, self.actions, self.total = episode, list[NDArray[np.float32]](), 0.0
        own_seed = reset_seed(self.seed, TRAINING, episode)
        if self.protocol.start_states == "same":
            stepping.reset(self.env, self.seed)
            shown = self.env.draw_from(own_seed)  # one start state, but not one sequence of travel times
        else:
            shown = stepping.reset(self.env, own_seed)
        self._see(*shown)

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Act, and start the next episode if this one ends. Returns the true step."""
        if not (np.abs(action) <= 1).all():
            wrong = "beyond [-1, 1]" if np.isfinite(action).all() else "that are not finite: training diverged"
            raise DelayRLError(f"the policy of seed {self.seed} gives actions {wrong}")
        truth, age = self.truth, self.seen.age
        obs, reward, terminated, truncated, info = stepping.step(self.env, action)
        self.actions.append(action)
        self._see(obs, info)
        done = terminated or truncated
        if not np.isfinite(reward):
            self._refuse("a reward")
        self.total += reward
        ends = np.bool_(done if self.protocol.time_limit == "terminates" else terminated)
        outcome: tuple[Any, ...] = (np.float32(reward), ends, np.bool_(done), self.truth, self.seen.age)
        transition = Transition(truth, age, action, *outcome)  # type: ignore[arg-type]
        if done:
            self.finished.append({"episode": self.episode, "return": self.total, "length": len(self.actions)})
            self.start_episode(self.episode + 1)
        return transition

    def replay_episode(self, episode: int, actions: NDArray[np.float32]) -> None:
        """Come back to the middle of an episode: the same seed and actions lead to the same state."""
        self.start_episode(episode)
        for action in actions:
            obs, reward, _, _, info = stepping.step(self.env, action)
            self.actions.append(action)
            self.total += reward
            self._see(obs, info)

    def _see(self, obs: NDArray[Any], info: dict[str, Any]) -> None:
        self.seen = seen_now(obs, info, self.env.history, privileged=self.privileged)
        self.truth = np.asarray(info["truth"], np.float32)
        if not np.isfinite(self.truth).all():
            self._refuse("an observation")

    def _refuse(self, what: str) -> None:
        at = f"step {len(self.actions)}, episode {self.episode} of seed {self.seed}"
        raise DelayRLError(f"the environment gave {what} that is not finite: {at}")
