"""The host's side of one seed: its environment, and where it is in its current episode."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delayrl.core.types import Seen, Transition
from delayrl.core.views import seen_now
from delayrl.errors import DelayRLError
from delayrl.play.evaluation import TRAINING, reset_seed
from delayrl.wrappers import Delayed


@dataclass
class Actor:
    """One seed's environment, and where it is in its current episode."""

    env: Delayed
    seed: int
    privileged: bool
    official: bool = False
    episode: int = 0
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    seen: Seen = None  # type: ignore[assignment]
    truth: NDArray[np.float32] = None  # type: ignore[assignment]

    def reset(self) -> None:
        """Start the next episode, from its own seed (official protocol: always from the same)."""
        self.actions = []
        seed = self.seed if self.official else reset_seed(self.seed, TRAINING, self.episode)
        shown = self.env.reset(seed=seed)
        if self.official:  # one start state, but not one sequence of travel times
            self.env.draw_from(reset_seed(self.seed, TRAINING, self.episode))
        self._see(*shown)

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Act; start the next episode where this one ends."""
        if not np.isfinite(action).all():
            raise DelayRLError(f"the policy of seed {self.seed} gives actions that are not finite: training diverged")
        before, age = self.truth, self.seen.age
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.actions.append(action)
        self._see(obs, info)
        reward = float(reward)
        if not np.isfinite(reward):
            self._refuse("a reward")
        done = terminated or truncated
        step = Transition(
            before,  # type: ignore[arg-type]
            age,
            action,  # type: ignore[arg-type]
            np.float32(reward),  # type: ignore[arg-type]
            np.bool_(done if self.official else terminated),  # type: ignore[arg-type]
            np.bool_(done),  # type: ignore[arg-type]
            self.truth,  # type: ignore[arg-type]
            self.seen.age,
        )
        if done:
            self.episode += 1
            self.reset()
        return step

    def replay_episode(self, episode: int, actions: NDArray[np.float32]) -> None:
        """Come back to the middle of an episode: the same seed and actions lead to the same state."""
        self.episode = episode
        self.reset()
        for action in actions:
            obs, _, _, _, info = self.env.step(action)
            self.actions.append(action)
            self._see(obs, info)

    def _see(self, obs: NDArray[Any], info: dict[str, Any]) -> None:
        self.seen = seen_now(obs, info, self.env.history, privileged=self.privileged)
        self.truth = np.asarray(info["truth"], np.float32)
        if not np.isfinite(self.truth).all():
            self._refuse("an observation")

    def _refuse(self, what: str) -> None:
        raise DelayRLError(
            f"the environment gave {what} that is not finite: step {len(self.actions)}, episode {self.episode}"
        )
