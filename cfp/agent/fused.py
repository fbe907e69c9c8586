"""Evaluation of several networks of the same shape at once: one operation per layer, with concatenated weights.

A CPU computes one convolution with all their channels faster than several small ones; concatenation costs little.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class EncoderLayers(Protocol):
    """The layers of `cfp.agent.networks.Encoder`."""

    first: nn.Conv2d
    rest: nn.Sequential
    patches: Tensor


def encode(encoders: Sequence[EncoderLayers], *images: Tensor) -> Tensor:
    """Evaluate n encoders of the same shape on the same images (B, c, 64, 64); returns latents (B, n w, 4, 4).

    The first layer is linear in its channels, so it is evaluated for each image separately and summed: this avoids
    stacking the images with a batch of constant coordinates, and the gradients of images that need none.
    """
    sizes = [image.shape[1] for image in images]
    weight, bias = _concatenated([encoder.first for encoder in encoders])
    *weights, position = weight.split([*sizes, 2], dim=1)
    coordinates = torch.addmm(bias[:, None], position.flatten(1), encoders[0].patches).unflatten(1, (15, 15))
    parts = [
        (_folded_conv if image.requires_grad else F.conv2d)(image, part, stride=4)
        for image, part in zip(images, weights, strict=True)
    ]
    hidden = sum(parts[1:], parts[0] + coordinates)
    for layers in zip(*(encoder.rest for encoder in encoders), strict=True):
        if isinstance(layers[0], nn.Conv2d):
            hidden = F.conv2d(hidden, *_concatenated(layers), stride=layers[0].stride, groups=len(encoders))
        else:
            hidden = layers[0](hidden)
    return hidden


def decode(heads: Sequence[nn.Sequential], latent: Tensor) -> list[Tensor]:
    """Evaluate heads of `cfp.agent.networks.make_head` on the same latent (B, 32, 4, 4); returns (B, 2, R, R) each."""
    if not isinstance(heads[0][0], nn.ConvTranspose2d):
        return [head(latent) for head in heads]
    first, *rest = zip(*heads, strict=True)
    values = F.conv_transpose2d(latent, *_concatenated(first, dim=1), first[0].stride, first[0].padding)
    for layers in rest:
        if isinstance(layers[0], nn.ELU):
            values = layers[0](values)
        elif layers[0].stride == (2, 2):
            values = _folded_conv_transpose(values, *_concatenated(layers), groups=len(heads))
        else:
            weight, bias = _concatenated(layers)
            values = F.conv_transpose2d(values, weight, bias, padding=layers[0].padding, groups=len(heads))
    return list(values.chunk(len(heads), dim=1))


def multilayer_perceptrons(perceptrons: Sequence[nn.Sequential], values: Tensor) -> Tensor:
    """Evaluate n perceptrons, each on its own input (n, B, ...), which is flattened; returns (n, B, out)."""
    values = values.flatten(2)
    for layers in zip(*perceptrons, strict=True):
        if isinstance(layers[0], nn.Linear):
            weight, bias = map(torch.stack, _parameters(layers))
            values = torch.baddbmm(bias[:, None], values, weight.transpose(1, 2))
        elif isinstance(layers[0], nn.ELU):
            values = layers[0](values)
    return values


def _concatenated(layers: Sequence[nn.Module], dim: int = 0) -> tuple[Tensor, Tensor]:
    """Weights and biases of layers of the same shape, weights concatenated along ``dim``."""
    weights, biases = _parameters(layers)
    return (weights[0], biases[0]) if len(layers) == 1 else (torch.cat(weights, dim), torch.cat(biases))


def _parameters(layers: Sequence[nn.Module]) -> tuple[list[Tensor], list[Tensor]]:
    return cast(list[Tensor], [layer.weight for layer in layers]), cast(list[Tensor], [layer.bias for layer in layers])


def _folded_conv(image: Tensor, weight: Tensor, stride: int) -> Tensor:
    """``conv2d`` with a kernel of twice the stride, computed as a 2x2 kernel on blocks of stride x stride pixels.

    On a CPU the gradient with respect to a two-channel image is five times faster.
    """
    out, channels = weight.shape[:2]
    blocks = weight.view(out, channels, 2, stride, 2, stride).permute(0, 1, 3, 5, 2, 4)
    return F.conv2d(F.pixel_unshuffle(image, stride), blocks.reshape(out, channels * stride**2, 2, 2))


def _folded_conv_transpose(image: Tensor, weight: Tensor, bias: Tensor, groups: int) -> Tensor:
    """``conv_transpose2d`` with kernel 4, stride 2, padding 1, computed as a convolution whose outputs are 2x2 blocks.

    On a CPU it is two to three times faster for few channels on a large image.
    """
    inner, out = weight.shape[0] // groups, weight.shape[1]
    blocks = weight.view(groups, inner, out, 2, 2, 2, 2).flip(3, 5).permute(0, 2, 4, 6, 1, 3, 5)
    kernel = blocks.reshape(groups * out * 4, inner, 2, 2)
    values = F.conv2d(image, kernel, bias.repeat_interleave(4), padding=1, groups=groups)
    return F.pixel_shuffle(values, 2)[..., 1:-1, 1:-1]
