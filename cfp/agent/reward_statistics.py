"""Rewards centred and scaled by running statistics, as in the reference implementation."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class RewardStatistics(nn.Module):
    """Running mean and variance of raw rewards, updated with each batch before it is normalised.

    ``M <- m M + (1 - m) mean(r)``, ``V <- m V + (1 - m) var(r)`` (unbiased), starting at 0 and 1;
    ``normalised r = (r - M) / (sqrt(V) + 1e-8)``.

    Where r is a sum over n steps, some sums end early, at the end of an episode or of the memory. Such a sum counts as
    ``r / w`` in the statistics, and ``w M`` is subtracted from it, where w is the part of the discount factors that it
    has; otherwise the mean of the missing rewards would be a penalty for the last states of an episode.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, momentum: float) -> None:
        super().__init__()
        self.momentum = momentum
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("variance", torch.ones(()))

    @torch.no_grad()
    def forward(self, rewards: Tensor, part: Tensor | float = 1.0) -> Tensor:
        """Update the statistics with raw rewards of any shape and return them normalised; ``part`` is w."""
        whole = rewards / part
        self.mean.lerp_(whole.mean(), 1 - self.momentum)
        self.variance.lerp_(whole.var(), 1 - self.momentum)
        return (rewards - part * self.mean) / (self.variance.sqrt() + 1e-8)

    def scalars(self) -> dict[str, Tensor]:
        """Values to log."""
        return {"reward_mean": self.mean, "reward_std": self.variance.sqrt()}
