"""Where the simulated window lies, and where in it the robot looks and acts."""

from __future__ import annotations

import torch
from torch import Tensor

from dittogym.spec import Centre, TaskSpec


def window_origin(spec: TaskSpec, com: Tensor) -> Tensor:
    """Lower left corner (B, 2) of the window for a robot centred on ``com`` (B, 2)."""
    follow = spec.window.follow
    left = torch.full_like(com[:, 0], spec.window.left) if follow is None else com[:, 0] - follow
    return torch.stack((left, torch.zeros_like(left)), dim=1)


def in_window(centre: Centre, com: Tensor, origin: Tensor) -> Tensor:
    """A centre rule in window coordinates, (B, 2), m."""
    relative = com - origin
    if centre == (None, None):
        return relative
    return torch.stack(
        [relative[:, i] if c is None else torch.full_like(relative[:, i], c) for i, c in enumerate(centre)], dim=1
    )
