"""Composed actions: the blend of coarse and residual actions, and its parts as a compact form for the replay buffer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cfp.agent.networks import upsample
from cfp.agent.spec import ActorSpec, Interpolation


def blend(coarse: Tensor, residual: Tensor, gate: Tensor, enlarge: Callable[[Tensor], Tensor]) -> Tensor:
    """``up(g) up(a_res) + (1 - up(g)) a_coarse`` for a coarse action that is upsampled already (paper, Section 4.2)."""
    weight = enlarge(gate)
    return weight * enlarge(residual) + (1 - weight) * coarse


@dataclass(frozen=True)
class Composition:
    """Structure of a vector that holds the parts of a composed action, which together are smaller than the action.

    They are the action of the first stage, then residual action and gate of each further one, on its action grid.
    """

    resolutions: tuple[int, ...]  # Action grid R of each stage, coarsest first
    size: int  # Rows and columns A of the composed action
    interpolation: Interpolation

    @classmethod
    def of(cls, spec: ActorSpec) -> Composition | None:
        """Composition of an actor; None if its parts are no smaller than its actions, or are blended on their grids."""
        if spec.patch is None:
            return None
        composition = cls(spec.resolutions, spec.action_size, spec.interpolation)
        return composition if composition.length < 2 * spec.action_size**2 else None

    @property
    def grids(self) -> tuple[int, ...]:
        """Action grid R of each part."""
        return (self.resolutions[0], *(grid for grid in self.resolutions[1:] for _ in range(2)))

    @property
    def length(self) -> int:
        """Number of entries of a vector."""
        return sum(2 * grid**2 for grid in self.grids)

    def join(self, parts: Sequence[Tensor]) -> Tensor:
        """Concatenate parts (B, 2, R, R) to vectors (B, length)."""
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def split(self, vectors: Tensor) -> list[Tensor]:
        """Undo `join`."""
        pieces = vectors.split([2 * grid**2 for grid in self.grids], dim=1)
        return [piece.unflatten(1, (2, grid, grid)) for piece, grid in zip(pieces, self.grids, strict=True)]

    def from_finest(self, action: Tensor) -> Tensor:
        """Vectors (B, length) for actions (B, 2, R, R) of the last stage with fully open gates."""
        coarser = action.new_zeros(len(action), self.length - 2 * action[0].numel())
        return self.join([coarser, action, torch.ones_like(action)])

    def rebuild(self, vectors: Tensor) -> Tensor:
        """Compose actions (B, 2, A, A) from vectors (B, length) as the actor does, up to rounding."""
        coarsest, *rest = self.split(vectors)
        action = self._enlarge(coarsest)
        for residual, gate in zip(rest[::2], rest[1::2], strict=True):
            action = blend(action, residual, gate, self._enlarge)
        return action

    def _enlarge(self, image: Tensor) -> Tensor:
        return upsample(image, self.size, self.interpolation)
