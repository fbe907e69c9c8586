"""The cost in training of robots that begin to tear."""

from torch import Tensor


def split_cost(split: Tensor, limit: float, margin: float, weight: float) -> Tensor:
    """Cost (B,) of robots' spread (B,), m, beyond a fraction ``margin`` of the ``limit`` at which they are torn."""
    return weight * (split / limit - margin).clamp_min(0.0).square()
