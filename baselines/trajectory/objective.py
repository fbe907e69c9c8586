"""The objective of trajectory optimisation: a loss of every step."""

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.observation import soft_silhouette
from dittogym.spec import TaskSpec
from dittogym.tasks.shapematch import reward_fn as overlap


class Objective:
    """The negative smooth reward; in SHAPE MATCH, whose reward has no gradient, the difference from the target picture.

    This is the mean absolute difference of the soft silhouette and the target, both blurred. A wide blur pulls matter
    towards a target that it does not touch, a narrow one shapes the outline.
    """

    def __init__(self, env: TorchEnv, blur: tuple[float, ...]) -> None:
        self.target: Tensor | None = None
        if matches_shape(env.spec):
            self.target = torch.as_tensor(env.spec.target, device=env.device, dtype=env.dtype)
            self.blurs = [gaussian_matrix(sigma, len(self.target)).to(self.target) for sigma in blur]

    def phase(self, progress: float) -> int:
        """Index of the blur at a fraction of the training, 0 to 1. Losses compare within a phase only."""
        return 0 if self.target is None else min(int(progress * len(self.blurs)), len(self.blurs) - 1)

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the environment after a step with rewards (B,)."""
        if self.target is None:
            return -reward
        blur = self.blurs[self.phase(progress)]
        difference = soft_silhouette(env.soft_observation()) - self.target
        return (blur @ difference @ blur.T).abs().mean((1, 2))


def matches_shape(spec: TaskSpec) -> bool:
    """Whether the reward of a task is the overlap with its target."""
    return spec.target is not None and spec.reward_fn is overlap


def gaussian_matrix(sigma: float, size: int) -> Tensor:
    """Gaussian blur along one axis as a matrix (size, size), float64, with zeros beyond the borders."""
    if sigma == 0:
        return torch.eye(size, dtype=torch.float64)
    offset = torch.arange(-4 * size, 4 * size + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (offset / sigma) ** 2)
    distance = torch.arange(size)[:, None] - torch.arange(size)
    return weight[4 * size + distance] / weight.sum()
