"""Rewards centred and scaled by running statistics, as in the reference implementation."""

from __future__ import annotations

import torch
from torch import Tensor, nn


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

    @torch.no_grad()
    def forward(self, rewards: Tensor) -> Tensor:
        """Update the statistics with raw rewards of any shape and return them normalised."""
        self.mean.lerp_(rewards.mean(), 1 - self.momentum)
        self.variance.lerp_(rewards.var(), 1 - self.momentum)
        return (rewards - self.mean) / (self.variance.sqrt() + 1e-8)

    def scalars(self) -> dict[str, Tensor]:
        """Values to log."""
        return {"reward_mean": self.mean, "reward_std": self.variance.sqrt()}
