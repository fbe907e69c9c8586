"""Options of algorithms that act on one grid, and of those that simulate more cheaply than they are evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cfp.config import Particles, RunConfig
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


def long_dt(task: str) -> float | None:
    """Duration of a substep, s, for gradient methods and planners; None: as in the environment.

    Twice the usual one where that changes no more than another layout of particles does (docs/concepts/fidelity.md).
    """
    return 2e-4 if task == "run" else None


@dataclass(frozen=True, kw_only=True)
class GridConfig(RunConfig):
    """Options of a run on one action grid."""

    grid: Grid = "coarse"
    """Action grid R: coarse or fine (the task's), or a number."""

    def resolution(self, stage: int) -> int:
        """Action grid R."""
        return find_grid("grid", self.task, self.grid)

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        for stage in range(1, len(self.ends()) + 1):
            self.resolution(stage)


@dataclass(frozen=True, kw_only=True)
class OptimisationConfig(GridConfig):
    """Options of a run that optimises actions in simulations that are cheaper than those of evaluations."""

    train_particles: Particles | None = None
    """Particles of the simulations in training, at most the environment's; None: as many."""
    train_dt: float | None = None
    """Duration of a substep in training, s; None: as in the environment."""
