"""Episodes up to a saved moment, to which one can go back, and their actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dittogym.action import bicubic
from dittogym.model import Snapshot
from dittogym.render.recording import Recording


class SavedEpisode(NamedTuple):
    """An episode up to a moment: its state, and how it came there."""

    snapshot: Snapshot
    total: float  # Return
    terminated: bool
    truncated: bool
    success: bool
    invalid: bool
    memory: Any  # Of the policy
    seed: int  # Of the particles
    actions: list[np.ndarray]
    recording: Recording
    touched: list[str]

    def copy(self) -> SavedEpisode:
        """The same, with lists that do not grow with those of an episode that goes on."""
        shots, rewards = self.recording.shots.copy(), self.recording.rewards.copy()
        recording = replace(self.recording, shots=shots, rewards=rewards)
        return self._replace(actions=self.actions.copy(), recording=recording, touched=self.touched.copy())


def stacked(actions: list[np.ndarray], patch: int) -> np.ndarray:
    """Actions (T, 2, R, R); those of several resolutions as executed, on a patch of so many nodes."""
    if len({action.shape for action in actions}) == 1:
        return np.stack(actions)
    return np.stack([bicubic(torch.from_numpy(each), patch).numpy() for each in actions])


def same_physics(values: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    """Whether constants of the matter, by name, are the same."""
    return values.keys() == others.keys() and all(torch.equal(values[name], others[name]) for name in values)
