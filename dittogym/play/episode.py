"""An episode that is played, and its actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dittogym.action import bicubic
from dittogym.render.recording import Recording


@dataclass
class Episode:
    """What happened since the last reset."""

    seed: int  # Of the particles
    recording: Recording
    touched: list[str]  # Changes that replaying the actions does not reproduce
    actions: list[np.ndarray] = field(default_factory=list)
    total: float = 0.0  # Return
    terminated: bool = False
    truncated: bool = False
    success: bool = False
    invalid: bool = False
    memory: Any = None  # Of the policy

    def copy(self) -> Episode:
        """The same, with lists that do not grow with those of an episode that goes on."""
        shots, rewards = self.recording.shots.copy(), self.recording.rewards.copy()
        recording = replace(self.recording, shots=shots, rewards=rewards)
        return replace(self, recording=recording, touched=self.touched.copy(), actions=self.actions.copy())

    def note(self, change: str) -> None:
        """Remember a change that replaying the actions does not reproduce."""
        if change not in self.touched:
            self.touched.append(change)


def stacked(actions: list[np.ndarray], patch: int) -> np.ndarray:
    """Actions (T, 2, R, R); those of several resolutions as executed, on a patch of so many nodes."""
    if len({action.shape for action in actions}) == 1:
        return np.stack(actions)
    return np.stack([bicubic(torch.from_numpy(each), patch).numpy() for each in actions])


def same_physics(values: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    """Whether constants of the matter, by name, are the same."""
    return values.keys() == others.keys() and all(torch.equal(values[name], others[name]) for name in values)
