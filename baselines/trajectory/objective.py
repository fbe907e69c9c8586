"""What the optimisation of a whole trajectory minimises: smooth losses of every step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.observation.image import soft_silhouette


class Objective(Protocol):
    """A loss of the environment after a step."""

    def phase(self, progress: float) -> int:
        """Index of the form of the loss at a fraction of the training, 0 to 1. Losses compare within a phase only."""

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the environment after a step with rewards (B,)."""


def make_objective(env: TorchEnv, blur: tuple[float, ...]) -> Objective:
    """Choose the objective of a task: the silhouette where there is a target picture, otherwise the reward."""
    if env.spec.target is None:
        return NegativeReward()
    target = torch.as_tensor(env.spec.target, device=env.device, dtype=env.dtype)
    return SilhouetteLoss(target, tuple(gaussian_matrix(sigma, len(target)).to(target) for sigma in blur))


class NegativeReward:
    """The negative reward of the task."""

    def phase(self, progress: float) -> int:
        """Always 0."""
        return 0

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,)."""
        return -reward


@dataclass(frozen=True, eq=False)
class SilhouetteLoss:
    """Mean absolute difference of the soft silhouette and a target, both blurred.

    A wide blur pulls matter towards a target that it does not touch, a narrow one shapes the outline.
    """

    target: Tensor  # (64, 64), 1 inside the shape
    blurs: tuple[Tensor, ...]  # matrices of `gaussian_matrix`, each used for the same fraction of the training

    def phase(self, progress: float) -> int:
        """Index of the blur."""
        return min(int(progress * len(self.blurs)), len(self.blurs) - 1)

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the present state; the reward counts pixels and has no gradient."""
        blur = self.blurs[self.phase(progress)]
        difference = soft_silhouette(env.soft_observation()) - self.target
        return (blur @ difference @ blur.T).abs().mean((1, 2))


def gaussian_matrix(sigma: float, size: int) -> Tensor:
    """Gaussian blur along one axis as a matrix (size, size), float64, with zeros beyond the borders."""
    if sigma == 0:
        return torch.eye(size, dtype=torch.float64)
    offset = torch.arange(-4 * size, 4 * size + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (offset / sigma) ** 2)
    distance = torch.arange(size)[:, None] - torch.arange(size)
    return weight[4 * size + distance] / weight.sum()
