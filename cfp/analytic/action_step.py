"""The first half of the update: better actions, by the gradient of the window's return (PODS; Mora et al., ICML 2021).

PODS takes Gauss-Newton or plain gradient steps on the actions of whole trajectories. Here the gradient covers a window
that ends in a critic's value, its outliers are limited, and the step, which is taken before tanh, has a given size.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cfp.learner import Resumable

#: Gradients of single actions longer than this many running medians are shortened to it.
OUTLIER = 3.0
#: Latest norms that the median is taken of.
HISTORY = 2_000
#: Largest magnitude of an improved mean, whose tanh is 0.987, and of an improved gate logit before its bias.
BOUND = 2.5


class ActionStep(Resumable):
    """Normalised gradient descent on the actions of a window, before tanh.

    Attributes:
        norms: Latest finite norms of single actions' gradients.
        limited: How many gradients were shortened so far.
    """

    values = ("norms", "limited")

    def __init__(self) -> None:
        self.norms: list[float] = []
        self.limited = 0

    @torch.no_grad()
    def __call__(self, locations: Tensor, gradients: Tensor, size: float) -> Tensor:
        """Improved locations of the actions, see `cfp.agent.actor.Outputs.location`.

        Args:
            locations: (T, B, C, R, R).
            gradients: Of the loss, with the same shape and finite.
            size: Root mean square of the step.
        """
        gradients = gradients.double()  # squares of outliers overflow in single precision
        norms = gradients.flatten(2).norm(dim=2)
        self.norms = [*self.norms, *norms[norms > 0].tolist()][-HISTORY:]
        if not self.norms:
            return locations.clone()
        largest = OUTLIER * float(np.median(self.norms))
        self.limited += int((norms > largest).sum())
        gradients = gradients * (largest / norms.clamp_min(largest))[..., None, None, None]
        step = size * gradients / gradients.square().mean().sqrt().clamp_min(torch.finfo(torch.double).tiny)
        return (locations - step.to(locations)).clamp(-BOUND, BOUND)
