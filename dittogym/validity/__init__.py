"""Which simulations can go on: all their numbers are finite, and some of the robot is in the window."""

import ctypes
import functools
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dittogym.window import GRID, contains
from torchmpm import ParticleState, diagnostics
from torchmpm.backends import transforming
from torchmpm.native.cpu.library import build

_SOURCE = Path(__file__).parent / "validity.cpp"


class Simulations(ctypes.Structure):
    """The arguments of one call, as ``struct Simulations`` in ``validity.cpp``."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("batch", "particles", "robot")),
        *((name, ctypes.c_double) for name in ("margin", "extent")),
        *((name, ctypes.c_void_p) for name in ("planes", "origin", "valid")),
    ]


def find_valid(particles: ParticleState, robot: int, origin: Tensor, native: bool) -> Tensor:
    """Which simulations can go on, (B,) bool.

    Args:
        particles: The state.
        robot: The robot's particles, which come first.
        origin: (B, 2) lower left corner of the window in the world, m.
        native: Whether to use one C++ function where that is possible, instead of several passes in torch.
    """
    function = _function(particles.dtype) if native and particles.device.type == "cpu" and not transforming() else None
    if function is None:
        inside = contains(particles.x[:, :robot].detach(), origin.detach()).any(1)
        return diagnostics.finite(particles) & inside
    planes, origin = particles.stack().detach().contiguous(), origin.detach().contiguous()
    _, batch, count = planes.shape
    valid = torch.empty(batch, dtype=torch.bool, device="cpu")
    pointers = (planes.data_ptr(), origin.data_ptr(), valid.data_ptr())
    function(ctypes.byref(Simulations(batch, count, robot, GRID.margin, GRID.extent, *pointers)))
    return valid


@functools.cache
def _function(dtype: torch.dtype) -> Callable[..., None] | None:
    """The C++ function; ``None`` where it cannot be built, of which the observation warns."""
    try:
        library = build(_SOURCE)
    except ValueError:
        return None
    function = getattr(library, {torch.float32: "dittogym_valid_float", torch.float64: "dittogym_valid_double"}[dtype])
    function.restype = None
    return function
