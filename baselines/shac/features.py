"""What a policy that sees the simulation's state is given to look at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.observation.window import in_window
from torchmpm.spline import quadratic_weights

RASTER = 16
"""Cells per axis of the raster."""
PERIODS = (8, 4, 2)
"""Periods of the clock, in control steps."""
_FRAME = 2


@dataclass(frozen=True)
class StateFeatures:
    """Rasters of the patch where the robot acts, and a clock, in one vector.

    Mass, momentum and mass-weighted ``F - I`` of the robot are spread over 16 x 16 cells by quadratic B-splines, and so
    are mass and momentum of the object where the task has one. Mass is in units of the body's own, spread evenly over
    the raster, so every particle count gives the same picture. All is differentiable in the particles; the place of the
    raster is not.

    Attributes:
        deformation: With the four channels of ``F - I``.
        clock: With cosine and sine of the episode's step, for each of `PERIODS`.
        displacement: With the robot's displacement since the reset, m.
    """

    deformation: bool = True
    clock: bool = True
    displacement: bool = False

    def size(self, objects: int) -> int:
        """Length D of the vector in a task with 0 or 1 objects."""
        channels = (7 if self.deformation else 3) + 3 * objects
        return channels * RASTER**2 + 2 * len(PERIODS) * self.clock + 2 * self.displacement

    def __call__(self, env: TorchEnv) -> Tensor:
        """Features (B, D) of the environment's present state, with its autograd graph."""
        state, robot = env.env_state, env.model.robot
        particles = state.particles
        cell = self._cells(env)
        columns = [torch.ones_like(particles.Jp)[:, :robot], *particles.v[:, :robot].unbind(-1)]
        if self.deformation:
            identity = torch.eye(2, dtype=env.dtype, device=env.device)
            columns += (particles.F[:, :robot] - identity).flatten(-2).unbind(-1)
        parts = [_raster(cell[:, :robot], torch.stack(columns, 1)).flatten(1)]
        if robot < env.num_particles:
            columns = [torch.ones_like(particles.Jp)[:, robot:], *particles.v[:, robot:].unbind(-1)]
            parts.append(_raster(cell[:, robot:], torch.stack(columns, 1)).flatten(1))
        if self.clock:
            parts.append(_clock(state.steps).to(particles.x))
        if self.displacement:
            parts.append(state.centre - state.start.com)
        return torch.cat(parts, 1)

    @staticmethod
    def _cells(env: TorchEnv) -> Tensor:
        """Positions (B, N, 2) in cells from the patch's lower left corner."""
        state, spec = env.env_state, env.spec
        width = spec.patch / env.model.solver.grid.resolution
        centre = in_window(spec.reach, state.centre, state.origin).detach().clamp(0.5 * width, 1.0 - 0.5 * width)
        corner = state.origin.detach() + centre - 0.5 * width
        return (state.particles.x - corner[:, None]) * (RASTER / width)


def _raster(cell: Tensor, values: Tensor) -> Tensor:
    """Spread values (B, K, N) at places (B, N, 2), in cells, over the raster (B, K, 16, 16), x first."""
    batch, channels, count = values.shape
    side = RASTER + 2 * _FRAME
    middle = 0.5 * RASTER
    near = ((cell.detach() - middle).abs() < middle + 1.0).all(-1)
    place = torch.where(near[..., None], cell, middle) - 0.5
    base = torch.floor(place.detach() - 0.5)
    wx, wy = (quadratic_weights((place - base)[..., axis]) for axis in (0, 1))
    weight = (wx[:, :, None] * wy[:, None]).flatten(1, 2) * near[:, None]
    first = ((base[..., 0] + _FRAME) * side + base[..., 1] + _FRAME).to(torch.int64)
    offset = torch.arange(3, device=cell.device)
    ids = (first[:, None] + (offset[:, None] * side + offset).view(9, 1)).flatten(1)
    spread = (weight[:, None] * values[:, :, None]).flatten(2)
    sums = values.new_zeros(batch, channels, side**2).scatter_add(2, ids[:, None].expand(-1, channels, -1), spread)
    return sums.view(batch, channels, side, side)[..., _FRAME:-_FRAME, _FRAME:-_FRAME] * (RASTER**2 / count)


def _clock(steps: Tensor) -> Tensor:
    """Cosine and sine of steps (B,) for every period, (B, 6)."""
    angle = steps[:, None] * (2.0 * math.pi / torch.tensor(PERIODS, device=steps.device))
    return torch.cat((angle.cos(), angle.sin()), 1)
