"""Exploration noise that moves matter: equal over cells of the action grid, and over some steps.

Independent noise averages out over the body and over time. Noise that is held for a random number of steps is from
Dabney et al., "Temporally-extended epsilon-greedy exploration" (ICLR 2021), and is used so by FlashSAC (2026); pink
noise (Eberhard et al., ICLR 2023) is a relative. Another scale for each robot is from Ape-X (Horgan et al., ICLR 2018).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfp.errors import ConfigError

#: Of the zeta distribution of the number of steps for which noise is held: its exponent, and its largest value.
EXPONENT, LONGEST = 2.0, 16


class CellNoise:
    """Gaussian noise for actions (n, 2, R, R), equal in each of ``cells`` x ``cells`` blocks, and held for some steps.

    Args:
        num_envs: n.
        resolution: R.
        cells: Blocks along each side; at most R.
        scale: Standard deviations of the first and of the last robot; those between are spaced geometrically.
        seed: Of the generator.
    """

    def __init__(
        self, num_envs: int, resolution: int, cells: int, scale: tuple[float, float], seed: int | None
    ) -> None:
        if cells > resolution:
            raise ConfigError(f"noise_cells must be at most {resolution}, the action grid, got {cells}")
        self.block = resolution // cells
        self.scale = np.geomspace(*scale, num_envs, dtype=np.float32)[:, None, None, None]
        self.values = np.zeros((num_envs, 2, cells, cells), np.float32)
        self.left = np.zeros(num_envs, np.int64)
        self.generator = np.random.default_rng(seed)

    def __call__(self) -> Tensor:
        """The noise (n, 2, R, R) of the next step."""
        due = np.flatnonzero(self.left == 0)
        self.values[due] = self.generator.standard_normal((len(due), *self.values.shape[1:]), np.float32)
        self.left[due] = np.minimum(self.generator.zipf(EXPONENT, len(due)), LONGEST)
        self.left -= 1
        blocks = (self.scale * self.values).repeat(self.block, axis=2).repeat(self.block, axis=3)
        return torch.from_numpy(blocks)

    def state_dict(self) -> dict[str, Any]:
        """Noise, steps left, and state of the generator."""
        generator = self.generator.bit_generator.state
        return {"values": torch.from_numpy(self.values), "left": torch.from_numpy(self.left), "generator": generator}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.values, self.left = (state[name].numpy().copy() for name in ("values", "left"))
        self.generator.bit_generator.state = state["generator"]
