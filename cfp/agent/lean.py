"""The lean networks: one encoder for actor and critics, and actions that join its features (DrQ-v2).

After Yarats et al., "Mastering Visual Continuous Control" (ICLR 2022): the critics alone train the encoder, and the
actor reads its features without a gradient. `cfp.agent.policies.CFPPolicy` puts the two together.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent import fused
from cfp.agent.networks import IMAGE_SIZE, LATENT, Encoder, initialise, perceptron

#: Channels of the encoder's features (B, 16, 4, 4), and of those of an action.
WIDTH = 16


class Encoded(NamedTuple):
    """Observations that have been encoded already, for networks that share the encoder."""

    image: Tensor  # `halved`, (B, 3, 32, 32)
    features: Tensor  # (B, 16, 4, 4)

    def detach(self) -> Encoded:
        """The same without a gradient to the encoder."""
        return self._replace(features=self.features.detach())


NetworkInput: TypeAlias = Tensor | Encoded


def image_of(observation: NetworkInput) -> Tensor:
    """The images of observations."""
    return observation.image if isinstance(observation, Encoded) else observation


def halved(image: Tensor) -> Tensor:
    """Normalised images (B, 3, 32, 32): means of 2 x 2 pixels of uint8 or normalised ones; others are done already."""
    if image.shape[-1] < IMAGE_SIZE:
        return image
    pixels = image if image.is_floating_point() else image.short()
    rows = pixels[..., ::2, :] + pixels[..., 1::2, :]
    sums = rows[..., ::2] + rows[..., 1::2]
    if image.is_floating_point():
        return sums / 4
    return fused.channels_last(sums).float().mul_(2.0 / (4 * 255.0)).sub_(1.0)


class LeanEncoder(nn.Module):
    """`Encoder` of half the size and width: 2 x 2 pixels are averaged, and features are (B, 16, 4, 4)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = Encoder(3, WIDTH, IMAGE_SIZE // 2)

    def forward(self, observation: NetworkInput) -> Tensor:
        """Features of uint8, normalised or `halved` images; those of `Encoded` observations are known."""
        if isinstance(observation, Encoded):
            return observation.features
        features: Tensor = self.layers(halved(observation))
        return features


class ActionEncoder(nn.Module):
    """Features (B, channels, 4, 4) of actions (B, 2, R, R): one layer on each of 4 x 4 tiles of the action grid.

    Larger actions are averaged over the cells of the grid. On the size of the environment's patch hundreds of weights
    would see nearly the same value, and an update of Adam would move their sum by as many steps.
    """

    def __init__(self, resolution: int, channels: int) -> None:
        super().__init__()
        self.resolution, self.side = resolution, resolution // 4
        self.layer = nn.Linear(2 * self.side**2, channels)

    def forward(self, action: Tensor) -> Tensor:
        """Encode actions."""
        if action.shape[-1] != self.resolution:
            action = F.adaptive_avg_pool2d(action, self.resolution)
        tiles = action.unflatten(3, (4, self.side)).unflatten(2, (4, self.side))  # (B, 2, rows, y, columns, x)
        return F.elu(self.layer(tiles.permute(0, 2, 4, 1, 3, 5).flatten(3))).movedim(-1, 1)


class Trunk(nn.Module):
    """The actor's own layer: from the encoder's features, and those of a coarse action, to a latent (B, 32, 4, 4).

    Args:
        resolution: Action grid R of the stage; None for the first stage, which reads no coarse actions.
    """

    def __init__(self, resolution: int | None = None) -> None:
        super().__init__()
        self.action = ActionEncoder(resolution, WIDTH) if resolution else None
        channels = LATENT // 16
        self.mix = nn.Conv2d(2 * WIDTH if resolution else WIDTH, channels, 3, padding=1)
        self.norm = nn.GroupNorm(1, channels)

    def forward(self, features: Tensor, coarse: Tensor | None = None) -> Tensor:
        """The latent for features (B, 16, 4, 4) and coarse actions (B, 2, R, R)."""
        if self.action is not None:
            assert coarse is not None
            features = torch.cat([features, self.action(coarse)], dim=1)
        return F.elu(self.norm(self.mix(features)))


class LeanCritics(nn.Module):
    """Two critics of actions (2, R, R) on the features of the shared encoder.

    Layers are normalised, which bounds the values of actions that were never tried (Ball et al., "Efficient Online
    Reinforcement Learning with Offline Data", ICML 2023).

    Args:
        resolution: Action grid R of the actor.
    """

    optimizer: torch.optim.Optimizer

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.actions = ActionEncoder(resolution, 2 * WIDTH)  # half of the channels for each critic
        self.heads = nn.ModuleList(perceptron(LATENT, 256, 256, 1, norm=True) for _ in range(2))
        initialise(self)

    def forward(self, observation: Encoded, action: Tensor) -> tuple[Tensor, ...]:
        """Values (B, 1) of both critics for encoded observations and actions (B, 2, R, R) or (B, 2 R R), or larger."""
        size = math.isqrt(action[0].numel() // 2)
        features = self.actions(action.reshape(-1, 2, size, size))
        latents = torch.stack([torch.cat([observation.features, part], dim=1) for part in features.chunk(2, dim=1)])
        heads: list[nn.Sequential] = list(self.heads)  # type: ignore[arg-type]
        return tuple(fused.multilayer_perceptrons(heads, latents))
