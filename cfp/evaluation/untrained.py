"""Policies that are compared with what was learned: no action, and random action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from cfp.agent.actor_policy import Memory, Observation, Start


@dataclass(frozen=True)
class UntrainedPolicy:
    """Slack muscles, or actions uniform in [-1, 1], independent in every cell and step, from torch's generator."""

    kind: Literal["zero", "random"]
    resolution: int  # rows and columns R of its actions

    uses_image = False

    @property
    def deterministic_by_default(self) -> bool:
        """Whether it always does the same."""
        return self.kind == "zero"

    @property
    def description(self) -> dict[str, Any]:
        """It comes from no training."""
        return {}

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Actions (B, 2, R, R), or (2, R, R) for a single image; ``deterministic`` changes nothing."""
        single = isinstance(observation, np.ndarray) and observation.ndim == 3
        shape = (*(() if single else (len(observation),)), 2, self.resolution, self.resolution)
        actions = torch.zeros(shape) if self.kind == "zero" else 2.0 * torch.rand(shape) - 1.0
        return actions.numpy(), state
