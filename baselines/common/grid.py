"""Options of algorithms that act on one grid."""

from dataclasses import dataclass
from typing import Literal

from cfp.config import RESAMPLE_NEEDS_SAC, RunConfig
from cfp.errors import ConfigError
from dittogym import make_spec
from dittogym.torch_env import find_resolution

#: Action grid R: coarse, fine (the task's), or a number.
Grid = int | Literal["coarse", "fine"]


def find_grid(option: str, task: str, grid: Grid) -> int:
    """Rows and columns of the action grid that an option chooses in a task; `ConfigError` if it is out of range."""
    try:
        return find_resolution(make_spec(task), grid, option)
    except ValueError as error:
        raise ConfigError(str(error)) from error


@dataclass(frozen=True)
class GridConfig(RunConfig):
    """Options of a run on one action grid."""

    grid: Grid = "coarse"
    """Action grid R: coarse, fine (the task's), or a number."""

    def resolution(self, stage: int) -> int:
        """Action grid R."""
        return find_grid("grid", self.task, self.grid)

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        for stage in range(1, len(self.ends()) + 1):
            self.resolution(stage)

    def ineffective(self) -> dict[str, str]:
        """Layouts are counted from the seed."""
        return super().ineffective() | RESAMPLE_NEEDS_SAC
