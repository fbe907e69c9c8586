"""The convolutional networks of the coarse-to-fine policy: encoder, heads, critics (paper, Section 4.2, Appendix B).

Observations are images (3, 64, 64), actions are images (2, R, R) whose channels drive the x- and the y-muscles.
"""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent import fused
from cfp.agent.spec import Interpolation
from dittogym.action import bicubic
from dittogym.observation import SIZE

#: Rows and columns of the observation, and of actions as input of the paper's encoders.
IMAGE_SIZE = SIZE

#: Number of entries of a latent image.
LATENT = 32 * 4 * 4

_DOUBLE, _KEEP = (4, 2, 1), (3, 1, 1)  # (kernel, stride, padding) that double or keep the size
_DECODERS: dict[int, tuple[tuple[tuple[int, int, int], ...], tuple[int, ...]]] = {
    8: ((_DOUBLE, _KEEP, _KEEP), (32, 16, 8, 2)),
    16: ((_DOUBLE, _DOUBLE, _KEEP), (32, 16, 8, 2)),
    32: ((_DOUBLE, _DOUBLE, _DOUBLE), (32, 16, 8, 2)),
    64: ((_DOUBLE, _DOUBLE, _DOUBLE, _DOUBLE), (32, 16, 8, 4, 2)),
}


def upsample(action: Tensor, size: int, interpolation: Interpolation) -> Tensor:
    """Bicubic interpolation (kernel parameter -0.75) of an action image (B, 2, R, R) to (B, 2, size, size).

    ``"half_pixel"`` is the environment's rule, with which a closed gate reproduces the coarse force field; the
    reference implementation aligns corners here.
    """
    if action.shape[-1] == size:
        return action
    return bicubic(action, size, align_corners=interpolation == "aligned")


def normalise_image(observation: Tensor) -> Tensor:
    """Map uint8 pixels to [-1, 1] by ``s / 255 * 2 - 1``; floating-point images are returned as they are."""
    if observation.is_floating_point():
        return observation
    return fused.channels_last(observation).float().mul_(2.0 / 255.0).sub_(1.0)


def initialise(module: nn.Module) -> nn.Module:
    """Initialise linear layers Xavier-uniform with zero bias; convolutions keep PyTorch's default."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return module


class Encoder(nn.Module):
    """Three convolutions from (B, C, size, size) to a latent image (B, w, 4, 4), with w, 2w and w channels.

    Two constant channels, (row - 32)/32 and (column - 32)/32 if the size is 64, are appended to the input (the paper's
    "position embedding channel"); they are neither trained nor saved.
    """

    patches: Tensor
    """Coordinate channels in the receptive fields of the first layer, unfolded to (225, 2 kernel^2)."""

    def __init__(self, channels: int, width: int, size: int = IMAGE_SIZE) -> None:
        super().__init__()
        kernel, stride = size // 8, size // 16
        self.first = nn.Conv2d(channels + 2, width, kernel, stride)
        self.rest = nn.Sequential(
            nn.ELU(inplace=True),
            nn.Conv2d(width, 2 * width, 4, stride=2),
            nn.ELU(inplace=True),
            nn.Conv2d(2 * width, width, 3),
            nn.ELU(inplace=True),
        )
        line = (torch.arange(size) - size / 2) / (size / 2)
        grid = torch.stack(torch.meshgrid(line, line, indexing="ij"))
        self.register_buffer("patches", F.unfold(grid[None], kernel, stride=stride)[0].T.contiguous(), persistent=False)

    def forward(self, *images: Tensor) -> Tensor:
        """Encode images (B, c, size, size) with values about [-1, 1], stacked along their channels, to (B, w, 4, 4)."""
        return fused.encode([self], *images)


class PairEncoder(nn.Module):
    """Encode observation and action together, to a latent of (B, 32, 4, 4).

    With ``split``, two encoders of half the width are used, for tasks in which the images show different places.
    """

    def __init__(self, split: bool) -> None:
        super().__init__()
        widths = ((3, 16), (2, 16)) if split else ((5, 32),)
        self.encoders = nn.ModuleList(Encoder(channels, width) for channels, width in widths)

    def forward(self, image: Tensor, patch: Tensor) -> Tensor:
        """Encode a normalised observation (B, 3, 64, 64) and an upsampled action (B, 2, 64, 64)."""
        if len(self.encoders) == 1:
            latent: Tensor = self.encoders[0](image, patch)
            return latent
        return torch.cat([self.encoders[0](image), self.encoders[1](patch)], dim=1)


def make_head(resolution: int) -> nn.Sequential:
    """Decoder from the latent (B, 32, 4, 4) to an image (B, 2, R, R), without a final activation."""
    if resolution == 4:
        return nn.Sequential(*perceptron(LATENT, 128, 128, 2 * 4 * 4), nn.Unflatten(1, (2, 4, 4)))
    shapes, channels = _DECODERS[resolution]
    layers: list[nn.Module] = []
    for (kernel, stride, padding), (before, after) in zip(shapes, pairwise(channels), strict=True):
        layers += [nn.ConvTranspose2d(before, after, kernel, stride, padding), nn.ELU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def perceptron(*sizes: int, norm: bool = False) -> nn.Sequential:
    """Linear layers of these sizes on a flattened input, with ELUs between them, and ``norm`` before each ELU."""
    layers: list[nn.Module] = [nn.Flatten()]
    for before, after in pairwise(sizes[:-1]):
        normalisation = [nn.LayerNorm(after, elementwise_affine=False)] if norm else []
        layers += [nn.Linear(before, after), *normalisation, nn.ELU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


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
        action = action.reshape(-1, 2, self.resolution, self.resolution)
        patch = upsample(action, IMAGE_SIZE, self.interpolation)
        critics = cast(list[Critic], list(self.critics))
        encoders = list(zip(*(critic.encoder.encoders for critic in critics), strict=True))
        inputs = [(image, patch)] if len(encoders) == 1 else [(image,), (patch,)]
        parts = [
            fused.encode(pair, *images).unflatten(1, (len(pair), -1))
            for pair, images in zip(encoders, inputs, strict=True)
        ]
        latents = torch.cat(parts, dim=2).transpose(0, 1)  # (2, B, 32, 4, 4)
        return tuple(fused.multilayer_perceptrons([critic.value for critic in critics], latents))
