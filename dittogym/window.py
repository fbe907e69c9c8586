"""The simulated window of 1 m x 1 m: where it lies, what is inside, and where in it the robot looks and acts."""

from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from dittogym.geometry import NODES
from torchmpm import Grid, checks

#: The grid of every task.
GRID = Grid(NODES)
#: Centre (x, y), 0 to 1 m from the lower left corner of the window; ``None`` stands for the robot's centre.
Centre: TypeAlias = tuple[float | None, float | None]


@dataclass(frozen=True)
class Window:
    """Where the window lies in the world.

    Attributes:
        left: The left end of a fixed window, m.
        follow: Of a moving window, the distance of the robot's centre from its left end, m.

    Raises:
        ValueError: Both are given.
    """

    left: float = 0.0
    follow: float | None = None

    def __post_init__(self) -> None:
        checks.number("left", self.left)
        if self.follow is not None:
            checks.number("follow", self.follow)
            if self.left:
                raise ValueError(f"left must not be given with follow, got {self.left} and {self.follow}")

    @property
    def moves(self) -> bool:
        """Whether the window follows the robot."""
        return self.follow is not None

    def origin(self, com: Tensor) -> Tensor:
        """Lower left corner (B, 2) of the window for robots centred on ``com`` (B, 2), m."""
        left = torch.full_like(com[:, 0], self.left) if self.follow is None else com[:, 0] - self.follow
        return torch.stack((left, torch.zeros_like(left)), dim=1)


def contains(x: Tensor, origin: Tensor) -> Tensor:
    """Which of the points ``x`` (B, N, 2) lie in the windows at ``origin`` (B, 2): (B, N) bool; false for NaN."""
    height = x[..., 1] - origin[:, 1:2]
    return GRID.contains(x[..., 0], origin[:, 0:1]) & (height > 0) & (height < 1)


def centre_in_window(centre: Centre, robot: Tensor, origin: Tensor) -> Tensor:
    """A centre in window coordinates."""
    relative = robot - origin
    if centre == (None, None):
        return relative
    columns = [relative[:, i] if c is None else torch.full_like(relative[:, i], c) for i, c in enumerate(centre)]
    return torch.stack(columns, dim=1)
