"""Networks of one shape evaluated together: their weights are put side by side, one operation for each layer.

A CPU computes one convolution with all their channels faster than several small ones. Every network keeps its own
parameters: they are joined anew in each evaluation, which costs little, and autograd hands every one its own gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

if TYPE_CHECKING:
    from cfp.agent.networks import Encoder


def encode(encoders: Sequence[Encoder], *images: Tensor) -> Tensor:
    """Latents (B, n w, 4, 4) of n encoders, one after the other along the channels, for the same images.

    The first layer is linear in its channels: it is evaluated image by image and added up, which spares the stacked
    copy, the batch of constant coordinates, and the gradient of images that need none.

    Args:
        encoders: The networks.
        images: (B, c, 64, 64) each, as in `cfp.agent.networks.Encoder`.
    """
    sizes = [image.shape[1] for image in images]
    weight, bias = _joined([encoder.first for encoder in encoders])
    *weights, position = weight.split([*sizes, 2], dim=1)
    place = torch.addmm(bias[:, None], position.flatten(1), encoders[0].patches).unflatten(1, (15, 15))
    parts = [
        (_folded_conv if image.requires_grad else F.conv2d)(image, part, stride=4)
        for image, part in zip(images, weights, strict=True)
    ]
    total = sum(parts[1:], parts[0] + place)
    for layers in zip(*(encoder.rest for encoder in encoders), strict=True):
        if isinstance(layers[0], nn.Conv2d):
            total = F.conv2d(total, *_joined(layers), stride=layers[0].stride, groups=len(encoders))
        else:
            total = layers[0](total)
    return total


def decode(heads: Sequence[nn.Sequential], latent: Tensor) -> list[Tensor]:
    """Outputs (B, 2, R, R) of heads from `cfp.agent.networks.make_head`, for the same latent (B, 32, 4, 4)."""
    if not isinstance(heads[0][0], nn.ConvTranspose2d):
        return [head(latent) for head in heads]
    first, *rest = zip(*heads, strict=True)
    values = F.conv_transpose2d(latent, *_joined(first, dim=1), first[0].stride, first[0].padding)
    for layers in rest:
        if isinstance(layers[0], nn.ELU):
            values = layers[0](values)
        elif layers[0].stride == (2, 2):
            values = _folded_conv_transpose(values, *_joined(layers), groups=len(heads))
        else:
            weight, bias = _joined(layers)
            values = F.conv_transpose2d(values, weight, bias, padding=layers[0].padding, groups=len(heads))
    return list(values.chunk(len(heads), dim=1))


def perceive(perceptrons: Sequence[nn.Sequential], values: Tensor) -> Tensor:
    """Outputs (n, B, out) of n perceptrons, each for its own values (n, B, ...), which are flattened."""
    values = values.flatten(2)
    for layers in zip(*perceptrons, strict=True):
        if isinstance(layers[0], nn.Linear):
            weight, bias = map(torch.stack, _parameters(layers))
            values = torch.baddbmm(bias[:, None], values, weight.transpose(1, 2))
        elif isinstance(layers[0], nn.ELU):
            values = layers[0](values)
    return values


def _joined(layers: Sequence[nn.Module], dim: int = 0) -> tuple[Tensor, Tensor]:
    """Weights and biases of alike layers, weights along one dimension."""
    weights, biases = _parameters(layers)
    return (weights[0], biases[0]) if len(layers) == 1 else (torch.cat(weights, dim), torch.cat(biases))


def _parameters(layers: Sequence[nn.Module]) -> tuple[list[Tensor], list[Tensor]]:
    return cast(list[Tensor], [layer.weight for layer in layers]), cast(list[Tensor], [layer.bias for layer in layers])


def _folded_conv(image: Tensor, weight: Tensor, stride: int) -> Tensor:
    """The same as ``conv2d`` with a kernel of twice the stride, written as a 2x2 kernel over stride x stride blocks.

    A CPU computes its gradient with respect to a two-channel image five times faster.
    """
    out, channels = weight.shape[:2]
    blocks = weight.view(out, channels, 2, stride, 2, stride).permute(0, 1, 3, 5, 2, 4)
    return F.conv2d(F.pixel_unshuffle(image, stride), blocks.reshape(out, channels * stride**2, 2, 2))


def _folded_conv_transpose(image: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
    """The same as ``conv_transpose2d`` with kernel 4, stride 2, padding 1, as a convolution that gives 2x2 blocks.

    With few channels on a large image a CPU computes it two to three times faster.
    """
    inner, out = weight.shape[0] // groups, weight.shape[1]
    blocks = weight.view(groups, inner, out, 2, 2, 2, 2).flip(3, 5).permute(0, 2, 4, 6, 1, 3, 5)
    kernel = blocks.reshape(groups * out * 4, inner, 2, 2)
    values = F.conv2d(image, kernel, bias.repeat_interleave(4), padding=1, groups=groups)
    return F.pixel_shuffle(values, 2)[..., 1:-1, 1:-1]
