"""From an action image to an actuation field on the nodes of the window."""

from __future__ import annotations

import functools
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import interpolate

Layout = Literal["image", "grid"]


def to_grid_layout(action: Tensor, layout: Layout) -> Tensor:
    """Bring an action (B, 2, R, R) to the index order (component, x rightwards, y upwards).

    In the layout ``"image"`` the last indices are row from the top and column, as in the observation, so a pixel of the
    action acts where the same pixel of the observation looks. The reference implementation indexes actions as
    ``"grid"`` and observations as images, a quarter turn apart.
    """
    return action.flip(-2).transpose(-1, -2) if layout == "image" else action


def from_grid_layout(action: Tensor, layout: Layout) -> Tensor:
    """Undo `to_grid_layout`: an action (..., R, R) indexed (x rightwards, y upwards) in a layout."""
    return action.transpose(-1, -2).flip(-2) if layout == "image" else action


def patch_field(action: Tensor, patch: int, max_actuation: float | Tensor) -> Tensor:
    """Upsample an action in grid layout to the patch and scale it to muscle stress.

    Bicubic interpolation (a = -0.75) with half-pixel centres; the result is clipped to the muscles' limit, because the
    interpolation overshoots.

    Args:
        action: (B, 2, R, R), 1 is the full actuation.
        patch: Width P of the patch in nodes.
        max_actuation: Muscle stress limit, Pa; a number or (B,).

    Returns:
        (B, 2, P, P), Pa.
    """
    upsampled = bicubic(action, patch)
    scale = max_actuation.view(-1, 1, 1, 1) if isinstance(max_actuation, Tensor) else max_actuation
    return scale * upsampled.clamp(-1.0, 1.0)


def bicubic(image: Tensor, size: int, align_corners: bool = False) -> Tensor:
    """Bicubic interpolation (a = -0.75) of square images (..., R, R) to (..., size, size).

    Written as two small matrix products, which are several times faster on a CPU than PyTorch's own, forward and
    backward.
    """
    matrix = bicubic_matrix(image.shape[-1], size, align_corners, image.dtype, image.device)
    with torch.autocast(image.device.type, enabled=False):  # makes what is executed, not only what a network reads
        return matrix @ image @ matrix.T


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)  # what is kept must serve gradients later
def bicubic_matrix(before: int, after: int, align_corners: bool, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (after, before) of one-dimensional interpolation, read off PyTorch's own on unit vectors."""
    basis = torch.eye(before, dtype=torch.float64, device="cpu")[:, None, :, None].expand(-1, -1, -1, before)
    image = interpolate(basis, size=(after, before), mode="bicubic", align_corners=align_corners)
    return image[:, 0, :, 0].T.contiguous().to(device, dtype)


def patch_corner(centre: Tensor, patch: int, nodes: int) -> Tensor:
    """First node along x and y, (B, 2) int64, of a patch that is kept whole inside the window.

    Args:
        centre: (B, 2) where its centre belongs, in window coordinates, m (the window is 1 m wide).
        patch: Its width in nodes.
        nodes: Nodes per axis of the window.
    """
    # The conversion truncates, as in the reference.
    return (nodes * centre.detach() - patch / 2).to(torch.int64).clamp(0, nodes - patch)


def place(field: Tensor, centre: Tensor, nodes: int) -> Tensor:
    """Put patches on the nodes of the window.

    Args:
        field: (B, 2, P, P) actuation on the patch.
        centre: (B, 2) where its centre belongs, in window coordinates, m (the window is 1 m wide).
        nodes: Nodes per axis of the window.

    Returns:
        (B, 2, nodes, nodes); zero off the patch, which is kept whole inside the window.
    """
    batch, _, patch, _ = field.shape
    i, j = patch_corner(centre, patch, nodes).split(1, dim=1)
    ids = i * nodes + j + _patch_ids(patch, nodes, field.device)
    result = field.new_zeros(batch, 2, nodes * nodes)
    return result.scatter(2, ids[:, None].expand(-1, 2, -1), field.flatten(2)).unflatten(2, (nodes, nodes))


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def _patch_ids(patch: int, nodes: int, device: torch.device) -> Tensor:
    """Where a patch in the corner of the window has its nodes among all of them, (P P)."""
    along = torch.arange(patch, device=device)
    return (along[:, None] * nodes + along).flatten()
