"""From an action image to an actuation field on the nodes of the window."""

from __future__ import annotations

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
    upsampled = interpolate(action, size=(patch, patch), mode="bicubic", align_corners=False)
    scale = max_actuation.view(-1, 1, 1, 1) if isinstance(max_actuation, Tensor) else max_actuation
    return scale * upsampled.clamp(-1.0, 1.0)


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
    base = torch.trunc(nodes * centre.detach() - patch / 2).to(torch.int64).clamp(0, nodes - patch)
    along = torch.arange(patch, device=field.device)
    i, j = ((base[:, axis : axis + 1] + along) for axis in (0, 1))
    which = torch.arange(batch, device=field.device)
    result = field.new_zeros(batch, nodes, nodes, 2)
    result[which[:, None, None], i[:, :, None], j[:, None, :]] = field.permute(0, 2, 3, 1)
    return result.permute(0, 3, 1, 2)
