"""What happens between two rollouts of stable-baselines3's loop."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from cfp.agent.sac import CFP
from cfp.experiment.books import Books

ROLLOUT_METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the last training episodes (with action noise)",
    "rollout/length": "their mean length in environment steps",
    "rollout/success": "share of successes among them, where the task defines success",
    "rollout/episodes": "episodes finished in this stage",
}
"""Scalars logged beside `cfp.agent.sac.METRICS` and `cfp.experiment.books.BOOK_METRICS`."""


class StageCallback(BaseCallback):
    """Keeps the books of one level.

    Everything happens at the start of a rollout, when each step taken has been stored and learned from.

    Args:
        books: Of the level.
        offset: Environment steps of the levels before it.
    """

    def __init__(self, books: Books, offset: int) -> None:
        super().__init__()
        self.books, self.offset = books, offset

    @property
    def step(self) -> int:
        """Environment steps since the beginning of the run."""
        return self.offset + self.model.num_timesteps

    def _on_training_start(self) -> None:
        self.books.open(self.step)

    def _on_step(self) -> bool:
        self.books.advance(self.training_env.num_envs)
        return True

    def _on_rollout_start(self) -> None:
        self.books.turn(self.step, self._scalars)

    def _on_training_end(self) -> None:
        self.books.close(self.step, self._scalars)

    def _scalars(self) -> dict[str, float | None]:
        assert isinstance(self.model, CFP)
        scalars = {"rollout/return": self._recent("r"), "rollout/length": self._recent("l")}
        scalars["rollout/episodes"] = self.model._episode_num
        if self.model.ep_success_buffer:
            scalars["rollout/success"] = float(np.mean(self.model.ep_success_buffer))
        return scalars

    def _recent(self, key: str) -> float | None:
        episodes = self.model.ep_info_buffer
        return float(np.mean([float(episode[key]) for episode in episodes])) if episodes else None
