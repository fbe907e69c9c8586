"""The observation as one C++ function: the bytes of ``dittogym.observation.raster``, or for splats at most one off."""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from dittogym.geometry import Box
from dittogym.observation.image import CLIP, SATURATION, SHAPE
from dittogym.window import GRID, Centre
from torchmpm.native.cpu.library import POOL, build, thread_pool

_SOURCE = Path(__file__).parent / "picture.cpp"


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


@functools.lru_cache(maxsize=64)
def drawing(
    view: Centre, boxes: tuple[Box, ...], bodies: tuple[tuple[int, float, bool], ...], pixels: bool, dtype: torch.dtype
) -> Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]:
    """A function that draws what a :class:`dittogym.observation.camera.Camera` sees, for tensors on the CPU."""
    kind = {torch.float32: "float", torch.float64: "double"}[dtype]
    function = getattr(build(_SOURCE, "-ffp-contract=off"), f"dittogym_draw_{kind}")
    body = torch.tensor(list(bodies), dtype=torch.float64, device="cpu")
    edges = [(b.left, b.right, b.bottom, b.top, b.closed) for b in boxes]
    box = torch.tensor(edges, dtype=torch.float64, device="cpu")
    constants = {
        "pixels": pixels,
        "bodies": len(bodies),
        "boxes": len(boxes),
        "view": tuple(math.nan if c is None else c for c in view),
        "margin": GRID.margin,
        "extent": GRID.extent,
        "clip": CLIP,
        "saturation": SATURATION,
    }

    def draw(x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        x, v = (t.movedim(-1, 0).contiguous() for t in (x, v))
        origin, centre = origin.contiguous(), centre.contiguous()
        image = torch.empty(x.shape[1], *SHAPE, dtype=torch.uint8, device="cpu")
        arrays = {"body": body, "box": box, "x": x, "v": v, "origin": origin, "centre": centre, "image": image}
        pointers = {name: array.data_ptr() for name, array in arrays.items()}
        sizes = {"batch": x.shape[1], "particles": x.shape[2], "threads": torch.get_num_threads()}
        call = Picture(**sizes, **pointers, **constants, **thread_pool())
        if function(ctypes.byref(call)):
            raise MemoryError("there is not enough memory to draw the observation")
        return image

    return draw
