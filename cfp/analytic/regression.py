"""The second half of the update: the actor learns the improved actions from images (PODS; Mora et al., ICML 2021).

As in D.Va (NeurIPS 2025) no gradient passes through the rendering: images are inputs only.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from cfp.agent.actor import Actor
from cfp.analytic.critic import descend
from cfp.learner import Resumable, compress, decompress

#: Of Adam.
BETAS = (0.9, 0.95)


class ImageMemory(Resumable):
    """The latest pairs of an image (3, 64, 64) uint8 and the location (C, R, R) of the action to take there.

    Args:
        capacity: Number of pairs; older ones are overwritten.
        example: An image and a location, for shapes, types and device.
    """

    values = ("locations", "count")

    def __init__(self, capacity: int, example: tuple[Tensor, Tensor]) -> None:
        self.images, self.locations = (part.new_zeros(capacity, *part.shape) for part in example)
        self.count = 0

    def add(self, images: Tensor, locations: Tensor) -> None:
        """Store a batch of pairs."""
        index = torch.arange(self.count, self.count + len(images), device=images.device) % len(self.images)
        self.images[index], self.locations[index] = images, locations
        self.count += len(images)

    def sample(self, size: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A random batch of pairs, with replacement."""
        stored = min(self.count, len(self.images))
        index = torch.randint(stored, (size,), generator=generator).to(self.images.device)
        return self.images[index], self.locations[index]

    def state_dict(self) -> dict[str, Any]:
        """All pairs, the images compressed."""
        return super().state_dict() | {"images": compress(self.images)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state)
        self.images = decompress(state["images"], self.images.shape[1:]).to(self.images.device)


class Regression(Resumable):
    """Regression of an actor onto locations of actions, and the running average of its weights, which is the policy.

    Args:
        actor: Composed or plain; its standard deviation is not trained.
        learning_rate: Adam's step size.
        decay: Of the exponential average of the weights.
        max_grad_norm: Largest norm of a gradient.
    """

    parts = ("actor", "average", "adam")

    def __init__(self, actor: Actor, learning_rate: float, decay: float, max_grad_norm: float) -> None:
        self.actor, self.max_grad_norm = actor, max_grad_norm
        self.average = AveragedModel(actor, multi_avg_fn=get_ema_multi_avg_fn(decay))
        self.adam = torch.optim.Adam(actor.trainable_parameters(), learning_rate, BETAS)

    def update(self, images: Tensor, locations: Tensor, learning_rate: float) -> Tensor:
        """Take one step of Adam towards the ``locations`` of actions for ``images``; returns the mean squared error."""
        self.adam.param_groups[0]["lr"] = learning_rate
        self.adam.zero_grad()
        loss = F.mse_loss(self.actor.outputs(images, deterministic=True).location, locations)
        loss.backward()
        descend(self.adam, self.max_grad_norm, "actor's regression")
        self.average.update_parameters(self.actor)
        return loss.detach()
