"""Copies between the host and the device: up without waiting for a GPU, down in one piece, for which it waits once."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmpm.tree import cached_tensors


def to_device(array: np.ndarray, device: torch.device) -> Tensor:
    """A new array as a tensor on a device, of the array's memory where that is the CPU; does not wait for a GPU."""
    host = torch.from_numpy(array)
    return host if device.type == "cpu" else host.pin_memory().to(device, non_blocking=True)


def constant(values: Any, like: Tensor) -> Tensor:
    """Return a tensor of constant values, which is kept and shared by all calls; do not write to it.

    It is for reward functions, where ``like.new_tensor(values)`` would copy the values to a GPU in every step, and wait
    for that.

    Args:
        values: Numbers or an array, of any shape.
        like: A tensor whose dtype and device the result has.

    Returns:
        A tensor of the shape of ``values``.
    """
    array = np.asarray(values)
    return _kept(array.tobytes(), array.dtype.str, array.shape, like.dtype, like.device)


@cached_tensors
def _kept(content: bytes, kind: str, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    array = np.frombuffer(content, kind).reshape(shape)
    return torch.tensor(array, dtype=dtype, device=device)  # waits for the copy: other streams may read it


def to_host(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Copies of tensors as arrays, by name, which the caller may write to; from a GPU all of them in one piece."""
    if all(tensor.device.type == "cpu" for tensor in tensors.values()):
        return {name: tensor.detach().numpy().copy() for name, tensor in tensors.items()}
    return unpack(pack(tensors).cpu().numpy(), tensors)


def pack(tensors: Mapping[str, Tensor]) -> Tensor:
    """The bytes of tensors, one after the other."""
    return torch.cat([tensor.detach().reshape(-1).contiguous().view(torch.uint8) for tensor in tensors.values()])


def unpack(content: np.ndarray, like: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """The arrays whose bytes :func:`pack` put together, with types and shapes of the tensors ``like``."""
    ends = np.cumsum([0, *(tensor.numel() * tensor.element_size() for tensor in like.values())])
    pieces = (content[start:end].copy() for start, end in pairwise(ends.tolist()))  # copies are aligned
    return {
        name: piece.view(torch.empty(0, dtype=tensor.dtype).numpy().dtype).reshape(tuple(tensor.shape))
        for (name, tensor), piece in zip(like.items(), pieces, strict=True)
    }
