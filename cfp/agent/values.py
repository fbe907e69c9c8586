"""What the outputs of critics mean: one value, or a distribution over atoms.

Distributions of values are from Bellemare et al. (C51, ICML 2017). As in Farebrother et al., "Stop Regressing" (ICML
2024), they are trained by cross-entropy with the two-hot encoding of the scalar target.
"""

from __future__ import annotations

import torch
from torch import Tensor
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
