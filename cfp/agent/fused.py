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


def channels_last(image: Tensor) -> Tensor:
    """An image (B, c, H, W) with its channels next to each other in memory, in which format convolutions are fastest.

    For few channels, stacking them takes half as long as ``image.contiguous(memory_format=torch.channels_last)``.
    """
    if image.is_contiguous(memory_format=torch.channels_last):
        return image
    return torch.stack(image.unbind(1), dim=-1).movedim(-1, 1)


def encode(encoders: Sequence[EncoderLayers], *images: Tensor) -> Tensor:
    """Evaluate n encoders of the same shape on the same images (B, c, size, size); returns latents (B, n w, 4, 4).

    The first layer is linear in its channels, so it is evaluated for each image separately and summed: this avoids
    stacking the images with a batch of constant coordinates, and the gradients of images that need none.
    """
    sizes, stride = [image.shape[1] for image in images], encoders[0].first.stride[0]
    weight, bias = _concatenated([encoder.first for encoder in encoders])
    *weights, position = weight.split([*sizes, 2], dim=1)
    coordinates = torch.addmm(bias, encoders[0].patches, position.flatten(1).T).flatten()
    hidden, *others = (
        (_folded_conv if image.requires_grad else F.conv2d)(channels_last(image), part, stride=stride)
        for image, part in zip(images, weights, strict=True)
    )
    # Expanded before it is brought to the format of the images: its gradient is then the sum of contiguous rows.
    hidden += coordinates.expand(len(hidden), -1).unflatten(1, (15, 15, -1)).movedim(-1, 1)
    for other in others:
        hidden += other
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
    values = F.conv_transpose2d(channels_last(latent), *_concatenated(first, dim=1), first[0].stride, first[0].padding)
    for layers in rest:
        if isinstance(layers[0], nn.ELU):
            values = layers[0](values)
        else:
            weights, biases = _parameters(layers)
            blocks = torch.block_diag(*(weight.flatten(1) for weight in weights))
            weight = blocks.unflatten(1, (-1, *weights[0].shape[2:]))
            values = F.conv_transpose2d(values, weight, torch.cat(biases), layers[0].stride, layers[0].padding)
    return [part.contiguous() for part in values.chunk(len(heads), dim=1)]


def multilayer_perceptrons(perceptrons: Sequence[nn.Sequential], values: Tensor) -> Tensor:
    """Evaluate n perceptrons, each on its own input (n, B, ...), which is flattened; returns (n, B, out)."""
    values = values.flatten(2)
    for layers in zip(*perceptrons, strict=True):
        if isinstance(layers[0], nn.Linear):
            weight, bias = map(torch.stack, _parameters(layers))
            values = torch.baddbmm(bias[:, None], values, weight.transpose(1, 2))
        elif not isinstance(layers[0], nn.Flatten):
            values = layers[0](values)  # it has no weights
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
    tiles = image.movedim(1, -1).unflatten(2, (-1, stride)).unflatten(1, (-1, stride))  # (B, rows, y, columns, x, c)
    kernels = weight.view(out, channels, 2, stride, 2, stride).permute(0, 3, 5, 1, 2, 4)
    return F.conv2d(tiles.transpose(2, 3).flatten(3).movedim(-1, 1), kernels.reshape(out, -1, 2, 2))
