"""Composed actions: the blend of coarse and residual actions, and its parts as a compact form for the replay buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cfp.agent.networks import upsample
from cfp.agent.spec import ActorSpec, Interpolation


def blend(coarse: Tensor, residual: Tensor, gate: Tensor) -> Tensor:
    """``g a_res + (1 - g) a_coarse``, of actions and gates that are upsampled already (paper, Section 4.2)."""
    return gate * residual + (1 - gate) * coarse


def compose(parts: Sequence[Tensor], size: int, interpolation: Interpolation) -> Tensor:
    """Actions (B, 2, size, size) from their parts: the action of the first stage, then residual and gate of each."""

    def enlarge(image: Tensor) -> Tensor:
        return upsample(image, size, interpolation)

    action = enlarge(parts[0])
    for residual, gate in zip(parts[1::2], parts[2::2], strict=True):
        action = blend(action, enlarge(residual), enlarge(gate))
    return action


@dataclass(frozen=True)
class Composition:
    """Structure of a vector that holds the parts of a composed action, for the replay buffer.

    They are the action of the first stage, then residual action and gate of each further one, on its action grid.
    """

    resolutions: tuple[int, ...]  # Action grid R of each stage, coarsest first
    size: int  # Rows and columns of the composed action as critics take it
    interpolation: Interpolation

    @classmethod
    def of(cls, spec: ActorSpec) -> Composition | None:
        """Composition of an actor; None if critics take the executed action, and it is no larger than its parts."""
        if spec.patch is None:
            return None
        composition = cls(spec.resolutions, spec.critic_size, spec.interpolation)
        smaller = composition.length < 2 * spec.action_size**2
        return composition if smaller or spec.critic_size < spec.action_size else None

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
        """Compose actions (B, 2, size, size) from vectors (B, length) as the actor does, up to rounding."""
        return compose(self.split(vectors), self.size, self.interpolation)
