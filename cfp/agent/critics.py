"""The critics of soft actor-critic: pairs of action-value networks, of the paper's or of the small kind."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import cast

import torch
from torch import Tensor, nn

from cfp.agent.actor import (
    IMAGE_SIZE,
    LATENT,
    SMALL_WIDTH,
    ActionEncoder,
    Encoded,
    Interpolation,
    PairEncoder,
    encode,
    initialise,
    normalise_image,
    perceptron,
    upsample,
)


class Critic(nn.Module):
    """Parameters of an action-value network: an encoder of its own and a 512-256-256-1 perceptron."""

    def __init__(self, split: bool) -> None:
        super().__init__()
        self.encoder = PairEncoder(split)
        self.value = perceptron(LATENT, 256, 256, 1)
        initialise(self)


class TwinCritic(nn.Module):
    """Two critics of actions (2, R, R) that share no parameters with each other or with the actor."""

    optimizer: torch.optim.Optimizer

    def __init__(self, resolution: int, split: bool, interpolation: Interpolation) -> None:
        super().__init__()
        self.resolution, self.interpolation = resolution, interpolation
        self.critics = nn.ModuleList(Critic(split) for _ in range(2))

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """Values (B, 1) of both critics for images (B, 3, 64, 64) and actions (B, 2, R, R) or (B, 2 R R)."""
        image = normalise_image(observation)
        patch = upsample(action.reshape(-1, 2, self.resolution, self.resolution), IMAGE_SIZE, self.interpolation)
        critics = cast(list[Critic], list(self.critics))
        encoders = list(zip(*(critic.encoder.encoders for critic in critics), strict=True))
        inputs = [(image, patch)] if len(encoders) == 1 else [(image,), (patch,)]
        parts = [encode(pair, *seen).unflatten(1, (2, -1)) for pair, seen in zip(encoders, inputs, strict=True)]
        latents = torch.cat(parts, dim=2).transpose(0, 1)  # (2, B, 32, 4, 4)
        return _values([critic.value for critic in critics], latents)


class SmallCritics(nn.Module):
    """Two critics of actions (2, R, R) on the features of the encoder that they share with the actor.

    Layers are normalised, which bounds the values of actions that were never tried (Ball et al., "Efficient Online
    Reinforcement Learning with Offline Data", ICML 2023).

    Args:
        resolution: Action grid R of the actor.
    """

    optimizer: torch.optim.Optimizer

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.actions = ActionEncoder(resolution, 2 * SMALL_WIDTH)  # half of the channels for each critic
        self.heads = nn.ModuleList(perceptron(LATENT, 256, 256, 1, norm=True) for _ in range(2))
        initialise(self)

    def forward(self, observation: Encoded, action: Tensor) -> tuple[Tensor, ...]:
        """Values (B, 1) of both critics for encoded observations and actions (B, 2, R, R) or (B, 2 R R), or larger."""
        size = math.isqrt(action[0].numel() // 2)
        features = self.actions(action.reshape(-1, 2, size, size))
        latents = torch.stack([torch.cat([observation.features, part], dim=1) for part in features.chunk(2, dim=1)])
        return _values(self.heads, latents)


def _values(perceptrons: Iterable[nn.Module], latents: Tensor) -> tuple[Tensor, ...]:
    """Evaluate perceptrons, each on its own latents (n, B, ...); returns (B, 1) each.

    One product a layer for all of them makes a training with the paper's networks a twentieth faster on a CPU.
    """
    values = latents.flatten(2)
    for layers in zip(*(network.children() for network in perceptrons), strict=True):
        if isinstance(layers[0], nn.Linear):
            weight = torch.stack([layer.weight for layer in layers])
            bias = torch.stack([layer.bias for layer in layers])
            values = torch.baddbmm(bias[:, None], values, weight.transpose(1, 2))
        elif not isinstance(layers[0], nn.Flatten):
            values = layers[0](values)  # it has no weights
    return tuple(values)
