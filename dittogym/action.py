"""From an action image to an actuation field on the nodes of the window."""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from torchmpm.tree import cached_tensors, transforming

#: How an action array is laid out: as the observation (row from the top, column), or as the grid (x, y).
ActionLayout = Literal["image", "grid"]


def to_grid_layout(action: Tensor, layout: ActionLayout) -> Tensor:
    """Bring actions to the layout ``"grid"``, which :func:`dittogym.core.step` takes.

    Args:
        action: (..., R, R), such as (B, 2, R, R).
        layout: The layout of ``action``: with ``"image"`` the last two indices are row, from the top, and column; with
            ``"grid"`` they are x, to the right, and y, upwards.

    Returns:
        The same action, indexed (..., x, y); a view of it.
    """
    return action.flip(-2).transpose(-1, -2) if layout == "image" else action


def from_grid_layout(action: Tensor, layout: ActionLayout) -> Tensor:
    """Undo :func:`to_grid_layout`, for an action (..., R, R) laid out (x rightwards, y upwards)."""
    return action.transpose(-1, -2).flip(-2) if layout == "image" else action


def trained_layout(policy: Any) -> ActionLayout | None:
    """The layout of a trained policy's actions, such as :func:`cfp.load` returns it; ``None`` if it does not say."""
    description = getattr(policy, "description", None)
    trained_in = description.get("environment") if isinstance(description, Mapping) else None
    if trained_in is None:
        return None
    return trained_in.get("action_layout") or "image"


def patch_field(action: Tensor, patch: int, max_actuation: float | Tensor) -> Tensor:
    """Upsample an action (B, 2, R, R) to the patch and scale it to muscle stress (B, 2, P, P), Pa.

    The result is clipped to the muscles' limit, because bicubic interpolation overshoots.
    """
    upsampled = bicubic(action, patch)
    scale = max_actuation.view(-1, 1, 1, 1) if isinstance(max_actuation, Tensor) else max_actuation
    return scale * upsampled.clamp(-1.0, 1.0)


def bicubic(image: Tensor, size: int, align_corners: bool = False) -> Tensor:
    """Bicubic interpolation (a = -0.75) of square images (..., R, R) to (..., size, size).

    As two small matrix products, several times faster on a CPU than ``torch.nn.functional.interpolate``.
    """
    matrix = bicubic_matrix(image.shape[-1], size, align_corners, image.dtype, image.device)
    if not torch.is_autocast_enabled(image.device.type):  # to enter the context takes longer than the products
        return matrix @ image @ matrix.T
    with torch.autocast(image.device.type, enabled=False):  # its result is executed, so precision matters
        return matrix @ image @ matrix.T


@cached_tensors
def bicubic_matrix(before: int, after: int, align_corners: bool, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (after, before) of one-dimensional interpolation, from ``interpolate`` of unit vectors."""
    basis = torch.eye(before, dtype=torch.float64, device="cpu")[:, None, :, None].expand(-1, -1, -1, before)
    image = interpolate(basis, size=(after, before), mode="bicubic", align_corners=align_corners)
    return image[:, 0, :, 0].T.contiguous().to(device, dtype)


def patch_corner(centre: Tensor, patch: int, nodes: int) -> Tensor:
    """First node (B, 2) int64 of a patch around ``centre`` (B, 2) in the window, m, kept whole inside the window."""
    # The conversion truncates, as in the reference.
    return (nodes * centre.detach() - patch / 2).to(torch.int64).clamp(0, nodes - patch)


def place(actuation: Tensor, centre: Tensor, nodes: int) -> Tensor:
    """Put the actuation (B, 2, P, P) of patches around ``centre`` (B, 2) on all nodes of the window, (B, 2, G, G)."""
    batch, _, patch, _ = actuation.shape
    corner = patch_corner(centre, patch, nodes)
    if batch == 1 and corner.device.type == "cpu" and not transforming():  # a third of the time of the general case
        i, j = corner[0].tolist()
        return pad(actuation, (j, nodes - patch - j, i, nodes - patch - i))
    i, j = corner.split(1, dim=1)
    ids = i * nodes + j + _patch_ids(patch, nodes, actuation.device)
    result = actuation.new_zeros(batch, 2, nodes * nodes)
    return result.scatter(2, ids[:, None].expand(-1, 2, -1), actuation.flatten(2)).view(batch, 2, nodes, nodes)


@cached_tensors
def _patch_ids(patch: int, nodes: int, device: torch.device) -> Tensor:
    """Indices (P * P,) among all nodes of a patch in the corner of the window."""
    along = torch.arange(patch, device="cpu")  # a copy to the device is there for all of its streams
    return (along[:, None] * nodes + along).flatten().to(device)
