"""Launches the CUDA kernel of the observation, ``picture.cu``."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmpm.native.cuda.driver import Driver, Launch
from torchmpm.native.tables import members

_SOURCE = Path(__file__).with_name("picture.cu")
#: Threads of a block, the blocks that share an image, and the fine pixels of each.
THREADS, BANDS, FINE_PIXELS = 256, 16, 32 * 512
#: Four sums of whole numbers in each image pixel of a block.
SUMS = 4 * 4 * 64


class Arguments(ctypes.Structure):
    """The only argument of the kernel, as ``struct Arguments`` in ``picture.cu``."""

    _fields_ = [
        *members(ctypes.c_int64, "batch", "particles", "pixels", "bodies", "boxes"),
        *members(ctypes.c_void_p, "body", "box"),
        ("view", ctypes.c_double * 2),
        *members(ctypes.c_double, "margin", "extent", "clip", "saturation", "unit", "speed_unit"),
        *members(ctypes.c_void_p, "x", "v", "origin", "centre", "image"),
    ]


@dataclass(frozen=True)
class Kernel:
    """What the kernel is compiled for, as :class:`torchmpm.native.cuda.arguments.Kernel` says it of those there."""

    source: ClassVar[str] = str(_SOURCE)
    name: ClassVar[str] = "dittogym_draw"

    real: str  # "float" or "double"
    threads: int

    @classmethod
    def of(cls, dtype: torch.dtype) -> Kernel:
        """That for positions in a dtype."""
        return cls({torch.float32: "float", torch.float64: "double"}[dtype], THREADS)

    @property
    def macros(self) -> dict[str, str]:
        """What the compiler must define."""
        return {"TORCHMPM_REAL": self.real, "TORCHMPM_THREADS": str(self.threads), "TORCHMPM_SHARED": "1"}


def draw(driver: Driver, kernel: Any, arrays: Mapping[str, Tensor], full: float, **constants: Any) -> None:
    """Draw the images of a batch, on the current stream.

    Args:
        driver: Where the kernel runs.
        kernel: The :class:`Kernel`.
        arrays: The tensors of :class:`Arguments`, all contiguous.
        full: Full-size particles of all bodies; sums in an image pixel are at most as large.
        constants: All other members of :class:`Arguments`.
    """
    unit = 2.0 ** (math.ceil(math.log2(max(full, 1.0))) - 30)
    _, batch, particles = arrays["x"].shape
    pointers = {name: array.data_ptr() for name, array in arrays.items()}
    speed_unit = unit * 2.0 ** math.ceil(math.log2(constants["clip"]))
    sizes = {"batch": batch, "particles": particles, "unit": unit, "speed_unit": speed_unit}
    arguments = Arguments(**pointers, **sizes, **constants)
    launch = Launch(batch * BANDS, kernel.threads, 4 * (FINE_PIXELS if constants["pixels"] else SUMS))
    device = arrays["x"].device
    driver.launch(driver.load(kernel, device), launch, arguments, device)
