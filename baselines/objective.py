"""Smooth losses of a step, for gradients through the simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.soft import soft_silhouette

Objective = Callable[[TorchEnv, Tensor, float], Tensor]
"""From the environment after a step, its reward (B,) and the progress of training (0 to 1) to a loss (B,)."""


def make_objective(env: TorchEnv, blur: tuple[float, ...]) -> Objective:
    """Choose what to minimise in a task.

    Args:
        env: The environment.
        blur: For a task with a target picture, see `SilhouetteLoss`.
    """
    if env.spec.target is None:
        return negative_reward
    target = torch.as_tensor(env.spec.target, device=env.device, dtype=env.dtype)
    return SilhouetteLoss(target, tuple(gaussian(sigma, len(target)).to(target) for sigma in blur))


def negative_reward(env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
    """The task's own reward, where it is smooth enough."""
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

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the present state; the reward counts pixels and has no gradient."""
        blur = self.blurs[min(int(progress * len(self.blurs)), len(self.blurs) - 1)]
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
