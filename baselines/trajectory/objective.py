"""Smooth losses of a step, for gradients through the simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.observation.image import soft_silhouette


class Objective(Protocol):
    """What is minimised."""

    def phase(self, progress: float) -> int:
        """Number of the form that the loss has at a progress of training (0 to 1); between forms losses differ."""

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the environment after a step with its reward (B,)."""


def make_objective(env: TorchEnv, blur: tuple[float, ...]) -> Objective:
    """Choose what to minimise in a task.

    Args:
        env: The environment.
        blur: For a task with a target picture, see `SilhouetteLoss`.
    """
    if env.spec.target is None:
        return NegativeReward()
    target = torch.as_tensor(env.spec.target, device=env.device, dtype=env.dtype)
    return SilhouetteLoss(target, tuple(gaussian(sigma, len(target)).to(target) for sigma in blur))


class NegativeReward:
    """The task's own reward, where it is smooth enough."""

    def phase(self, progress: float) -> int:
        """The same from beginning to end."""
        return 0

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,)."""
        return -reward


@dataclass(frozen=True, eq=False)
class SilhouetteLoss:
    """Mean absolute difference of the soft silhouette and a target, both blurred.

    Much blur pulls matter towards a target that it does not touch, little blur shapes the outline.

    Attributes:
        target: (64, 64), 1 inside the shape.
        blurs: Matrices of `gaussian`, used one after the other, each for the same share of the training.
    """

    target: Tensor
    blurs: tuple[Tensor, ...]

    def phase(self, progress: float) -> int:
        """Which blur is used."""
        return min(int(progress * len(self.blurs)), len(self.blurs) - 1)

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the present state; the reward counts pixels and has no gradient."""
        blur = self.blurs[self.phase(progress)]
        silhouette = soft_silhouette(env.soft_observation())
        return (blur @ (silhouette - self.target) @ blur.T).abs().mean((1, 2))


def gaussian(sigma: float, size: int) -> Tensor:
    """Blur along one axis as a matrix (size, size), float64; what is beyond the ends counts as zero.

    Args:
        sigma: Standard deviation in pixels; 0 is no blur.
        size: Pixels.
    """
    if sigma == 0:
        return torch.eye(size, dtype=torch.float64)
    place = torch.arange(-4 * size, 4 * size + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (place / sigma) ** 2)
    distance = torch.arange(size)[:, None] - torch.arange(size)
    return weight[4 * size + distance] / weight.sum()
