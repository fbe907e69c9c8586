"""Options of algorithms that act on one grid."""

from dataclasses import dataclass
from typing import Literal

from cfp.config import COUNTED_LAYOUTS, RunConfig
from dittogym import make_spec

#: Action grid R: coarse, fine (the task's), or a number.
Grid = int | Literal["coarse", "fine"]


def grid_size(task: str, grid: Grid) -> int:
    """Rows and columns of an action grid in a task."""
    spec = make_spec(task)
    return {"coarse": spec.coarse, "fine": spec.fine}[grid] if isinstance(grid, str) else grid


@dataclass(frozen=True)
class GridConfig(RunConfig):
    """Options of a run on one action grid."""

    grid: Grid = "coarse"
    """Action grid R: coarse, fine (the task's), or a number."""

    def resolution(self, stage: int) -> int:
        """Action grid R."""
        return grid_size(self.task, self.grid)

    def ineffective(self) -> dict[str, str]:
        """Layouts are counted from the seed."""
        return super().ineffective() | COUNTED_LAYOUTS
