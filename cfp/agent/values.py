"""The scale of rewards, and what the outputs of critics mean: one value, or a distribution over atoms.

Distributions of values are from Bellemare et al. (C51, ICML 2017). As in Farebrother et al., "Stop Regressing" (ICML
2024), they are trained by cross-entropy with the two-hot encoding of the scalar target.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

ATOMS, LIMIT = 101, 5.0
"""Number of atoms, and the largest value among them; they are evenly spaced from -LIMIT."""


def expected_value(outputs: Tensor) -> Tensor:
    """Values (B, 1): ``outputs`` (B, 1) themselves, or the mean of the distribution with logits (B, ATOMS)."""
    if outputs.shape[1] == 1:
        return outputs
    return (
        outputs.softmax(1) @ torch.linspace(-LIMIT, LIMIT, ATOMS, device=outputs.device, dtype=outputs.dtype)[:, None]
    )


def value_loss(outputs: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of values, or cross-entropy of distributions, for scalar targets (B, 1)."""
    return F.mse_loss(outputs, target) if outputs.shape[1] == 1 else F.cross_entropy(outputs, two_hot(target))


def two_hot(values: Tensor) -> Tensor:
    """Probabilities (B, ATOMS) of the two atoms around each value (B, 1), whose mean it is.

    Values beyond the atoms belong to the outermost one, as in C51.
    """
    position = (values.clamp(-LIMIT, LIMIT) + LIMIT) * ((ATOMS - 1) / (2 * LIMIT))
    return (1 - (position - torch.arange(ATOMS, device=values.device)).abs()).clamp_min(0)


class RewardStatistics(nn.Module):
    """Running mean and variance of raw rewards, updated with each batch before it is normalised.

    ``M <- m M + (1 - m) mean(r)``, ``V <- m V + (1 - m) var(r)`` (unbiased), starting at 0 and 1;
    ``normalised r = (r - M) / (sqrt(V) + 1e-8)``.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, momentum: float) -> None:
        super().__init__()
        self.momentum = momentum
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("variance", torch.ones(()))

    def observe(self, rewards: np.ndarray, ended: np.ndarray) -> None:
        """Do nothing with the rewards of a step: the statistics are those of batches."""

    @torch.no_grad()
    def forward(self, rewards: Tensor) -> Tensor:
        """Update the statistics with raw rewards of any shape and return them normalised."""
        self.mean.lerp_(rewards.mean(), 1 - self.momentum)
        self.variance.lerp_(rewards.var(), 1 - self.momentum)
        return (rewards - self.mean) / (self.variance.sqrt() + 1e-8)

    def scalars(self) -> dict[str, Tensor]:
        """Values to log."""
        return {"reward_mean": self.mean, "reward_std": self.variance.sqrt()}


class ReturnScale(nn.Module):
    """Rewards divided by a running scale of the discounted return, but not centred.

    An episode that goes on keeps its worth, and targets move only while returns grow. As in SimbaV2 (Lee et al., ICML
    2025) no return so far exceeds the range of the critics' atoms: the scale is the largest ``|G|`` over
    `LIMIT`, with ``G <- gamma G + r`` along every training episode.
    """

    returns: Tensor
    largest: Tensor

    def __init__(self, num_envs: int, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.register_buffer("returns", torch.zeros(num_envs))
        self.register_buffer("largest", torch.zeros(()))

    @torch.no_grad()
    def observe(self, rewards: np.ndarray, ended: np.ndarray) -> None:
        """Take the raw rewards (n,) of a step of all robots, and whether their episodes ended."""
        self.returns.mul_(self.gamma).add_(torch.as_tensor(rewards, device=self.returns.device))
        torch.maximum(self.largest, self.returns.abs().max(), out=self.largest)
        self.returns[torch.as_tensor(ended, device=self.returns.device)] = 0

    def forward(self, rewards: Tensor) -> Tensor:
        """Scaled rewards, or sums of rewards."""
        return rewards * (LIMIT / (self.largest + 1e-8))

    def scalars(self) -> dict[str, Tensor]:
        """Values to log."""
        return {"reward_scale": self.largest / LIMIT}
