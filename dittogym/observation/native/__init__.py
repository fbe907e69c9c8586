"""The observation as one C++ function, for CPUs with a compiler; elsewhere ``dittogym.observation.raster`` draws it.

It is compiled, kept and loaded like the kernels of ``torchmpm.native``. With the pixel raster it yields the same
bytes; splats are summed in another order, so that a byte may differ by one.
"""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dittogym.observation.raster import CLIP, SATURATION, SIZE
from torchmpm.native.cpu.library import POOL, build, thread_pool

if TYPE_CHECKING:
    from dittogym.core import EnvState, Model

_SOURCE = Path(__file__).parent / "picture.cpp"
_FUNCTIONS = {torch.float32: "dittogym_paint_float", torch.float64: "dittogym_paint_double"}


class Picture(ctypes.Structure):
    """The arguments of one call, as ``struct Picture`` in ``picture.cpp``."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("batch", "particles", "threads", "pixels")),
        *((name, ctypes.c_void_p) for name in POOL),
        *((name, ctypes.c_int64) for name in ("bodies", "boxes")),
        *((name, ctypes.c_void_p) for name in ("body", "box")),
        ("view", ctypes.c_double * 2),
        *((name, ctypes.c_double) for name in ("margin", "extent", "clip", "saturation")),
        *((name, ctypes.c_void_p) for name in ("x", "v", "origin", "centre", "image")),
    ]


class Painter:
    """What is the same in all pictures of a task.

    Args:
        model: The task.
    """

    def __init__(self, model: Model) -> None:
        spec, grid = model.spec, model.solver.grid
        bodies = zip(model.solver.bodies, model.shares, spec.bodies, strict=True)
        table = [(b.count, n, s.moves_visibly) for b, n, s in bodies]
        self._body = torch.tensor(table, dtype=torch.float64, device="cpu")
        boxes = [(b.left, b.right, b.bottom, b.top, b.closed) for b in spec.drawn]
        self._box = torch.tensor(boxes, dtype=torch.float64, device="cpu")
        self._constants = {
            "pixels": model.pixels,
            "bodies": len(spec.bodies),
            "boxes": len(boxes),
            "view": tuple(math.nan if c is None else c for c in spec.view),
            "margin": grid.margin,
            "extent": grid.resolution * grid.h - grid.margin,
            "clip": CLIP,
            "saturation": SATURATION,
        }

    def paint(self, state: EnvState) -> Tensor:
        """The image (B, 3, 64, 64) uint8 of a state on the CPU.

        Raises:
            ValueError: There is no compiler, or it failed.
            MemoryError: There was not enough memory.
        """
        x, v = (t.detach().movedim(-1, 0).contiguous() for t in (state.particles.x, state.particles.v))
        origin, centre = state.origin.detach().contiguous(), state.centre.detach().contiguous()
        image = torch.empty(x.shape[1], 3, SIZE, SIZE, dtype=torch.uint8, device="cpu")
        call = Picture(
            batch=x.shape[1],
            particles=x.shape[2],
            threads=torch.get_num_threads(),
            body=self._body.data_ptr(),  # not kept: a copy of this has tensors of its own
            box=self._box.data_ptr(),
            x=x.data_ptr(),
            v=v.data_ptr(),
            origin=origin.data_ptr(),
            centre=centre.data_ptr(),
            image=image.data_ptr(),
            **self._constants,
            **thread_pool(),
        )
        if getattr(build(_SOURCE, "-ffp-contract=off"), _FUNCTIONS[x.dtype])(ctypes.byref(call)):
            raise MemoryError("not enough memory to draw the observation")
        return image


def paints(model: Model, state: EnvState) -> bool:
    """Whether the observation of this state is one for :class:`Painter`: wherever the physics runs natively."""
    return state.particles.device.type == "cpu" and model.solver.runs_native(state.particles)
