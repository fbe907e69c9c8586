"""How an action is made of the images that the levels of a ladder draw on their own grids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cfp.agent.networks import upsample
from cfp.agent.spec import ActorSpec, Interpolation


def blend(coarse: Tensor, residual: Tensor, gate: Tensor, enlarge: Callable[[Tensor], Tensor]) -> Tensor:
    """``up(g) up(a_res) + (1 - up(g)) a_coarse``, with the coarse action enlarged already (paper, Section 4.2)."""
    weight = enlarge(gate)
    return weight * enlarge(residual) + (1 - weight) * coarse


@dataclass(frozen=True)
class Composition:
    """Parts of a blended action, one vector for each: a small form from which it can be made again.

    The parts are the coarsest action, then residual action and gate of each further level, all on the grids of their
    levels. Blending is not linear, so that the patch itself cannot be brought back to a grid.

    Attributes:
        resolutions: Action grid R of every level, coarsest first.
        size: Rows and columns A of the blended action.
        interpolation: How images are enlarged to it.
    """

    resolutions: tuple[int, ...]
    size: int
    interpolation: Interpolation

    @classmethod
    def of(cls, spec: ActorSpec) -> Composition | None:
        """That of an actor; None if its parts are no smaller than the action, or levels blend on their own grids."""
        if spec.patch is None:
            return None
        composition = cls(spec.resolutions, spec.action_size, spec.interpolation)
        return composition if composition.length < 2 * spec.action_size**2 else None

    @property
    def grids(self) -> tuple[int, ...]:
        """R of every part."""
        return (self.resolutions[0], *(grid for grid in self.resolutions[1:] for _ in range(2)))

    @property
    def length(self) -> int:
        """Numbers in a vector."""
        return sum(2 * grid**2 for grid in self.grids)

    def join(self, parts: Sequence[Tensor]) -> Tensor:
        """Vectors (B, length) of parts (B, 2, R, R)."""
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def split(self, vectors: Tensor) -> list[Tensor]:
        """Undo `join`."""
        pieces = vectors.split([2 * grid**2 for grid in self.grids], dim=1)
        return [piece.unflatten(1, (2, grid, grid)) for piece, grid in zip(pieces, self.grids, strict=True)]

    def alone(self, action: Tensor) -> Tensor:
        """Vectors (B, length) of actions (B, 2, R, R) of the finest level behind an open gate."""
        coarser = action.new_zeros(len(action), self.length - 2 * action[0].numel())
        return self.join([coarser, action, torch.ones_like(action)])

    def rebuild(self, vectors: Tensor) -> Tensor:
        """The actions (B, 2, A, A) of vectors (B, length), to rounding as the actor blended them."""
        coarsest, *rest = self.split(vectors)
        action = self._enlarge(coarsest)
        for residual, gate in zip(rest[::2], rest[1::2], strict=True):
            action = blend(action, residual, gate, self._enlarge)
        return action

    def _enlarge(self, image: Tensor) -> Tensor:
        return upsample(image, self.size, self.interpolation)
