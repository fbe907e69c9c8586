"""What the launcher hands to the CUDA kernels, and how much memory they need; mirrors ``arguments.cuh``.

There are four kernels, each compiled from a source of its own (:class:`Kernel`): forward and adjoint, with the nodes of
a robot in shared memory or in global memory.

- **Shared**: one block of threads advances one robot through all substeps, on a window of ``rows`` x ``columns`` nodes
  that follows it. Any number of blocks can be launched (``team`` is 1): blocks take robots in turn. A robot that does
  not fit the window, or whose numbers leave the range of the fixed-point sums, is given up: its ``status`` is not 0.
- **Global**: ``team`` blocks advance one robot together, on nodes in their scratch memory. They wait for each other, so
  all blocks must be resident: launch cooperatively, ``team`` times any number of teams. With ``status``, they take the
  robots that the kernel before gave up.

A forward kernel keeps ``per_thread`` particles of each thread in registers, so ``team * threads * per_thread`` must
suffice; with 0 it keeps them in the result, as many as there are. So does an adjoint kernel, on its tape, in any case.

The launcher never needs to look at the status: it launches the global kernel after the shared one on the same stream.
"""

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

from torchmpm.grid import PAD
from torchmpm.native.tables import COTANGENTS, members

#: 32-bit counters of a team, which must be zero before a launch of a global kernel.
COUNTERS = 64
#: Components of a particle's state.
COMPONENTS = 13
#: Threads share the work of a sum in so many parts.
SHARES = 16
#: Numbers of a summary of a substep.
SUMMARY = 8


class Arguments(ctypes.Structure):
    """The only argument of each kernel, as ``struct Arguments``.

    ``bodies`` and ``rules`` are the bytes of :class:`torchmpm.native.tables.BodyTable` and ``RuleTable`` on the device.
    """

    _fields_ = [
        *members(ctypes.c_int64, "batch", "particles", "substeps", "resolution", "num_bodies", "num_rules"),
        *members(ctypes.c_int64, "rows", "columns", "team", "values_batch", "value_columns", "scratch_bytes"),
        *members(ctypes.c_double, "h", "dt", "margin", "extent", "damping", "mass_epsilon", "stretch_floor"),
        *members(ctypes.c_void_p, "bodies", "rules"),
        *members(ctypes.c_void_p, "components", "field", "origin", "shift", "gravity", "values"),
        *members(ctypes.c_void_p, "result", "result_bar"),
        *members(ctypes.c_void_p, *COTANGENTS),
        *members(ctypes.c_void_p, "status", "counters", "scratch"),
    ]


class Kernel(NamedTuple):
    """What a kernel is compiled for."""

    adjoint: bool
    shared: bool  # nodes in shared memory
    real: str  # "float" or "double"
    threads: int  # of a block
    per_thread: int  # particles that a thread keeps in registers, 0: any number in global memory
    kinds: int  # bit k is set if a body has material KINDS[k]
    muscles: bool  # whether there is a field and a body with muscles

    @property
    def source(self) -> str:
        """The file of this folder that holds it; it includes headers of this folder and of ``native/common``."""
        return "adjoint.cu" if self.adjoint else "forward.cu"

    @property
    def name(self) -> str:
        """Its name in the compiled module."""
        return "torchmpm_adjoint" if self.adjoint else "torchmpm_forward"

    @property
    def macros(self) -> dict[str, str]:
        """What the compiler must define."""
        return {
            "TORCHMPM_REAL": self.real,
            "TORCHMPM_SHARED": str(int(self.shared)),
            "TORCHMPM_THREADS": str(self.threads),
            "TORCHMPM_PER_THREAD": str(self.per_thread),
            "TORCHMPM_KINDS": str(self.kinds),
            "TORCHMPM_MUSCLES": str(int(self.muscles)),
        }

    @property
    def real_bytes(self) -> int:
        """Bytes of a number."""
        return 8 if self.real == "double" else 4

    @property
    def node_bytes(self) -> int:
        """Bytes of a node."""
        real = self.real_bytes
        sums = 3 * real if self.shared else 4 * 8  # mass and momentum in fixed point
        if self.adjoint:
            sums = max(sums, 5 * real)  # derivatives in velocity, momentum and mass
        fields = (2 if self.adjoint else 1) if self.muscles else 0  # actuation, and the derivative in it
        return sums + 2 * real * (1 + fields)

    def shared_bytes(self, rows: int, columns: int, bodies: int, rules: int) -> int:
        """Dynamic shared memory of a block."""
        real = self.real_bytes
        pieces = [
            3 * 4 * SUMMARY + 4 * SHARES * real,
            bodies * (24 + 13 * real),
            rules * (36 if real == 4 else 48),
        ]
        return sum(map(_aligned, pieces)) + (rows * columns * self.node_bytes if self.shared else 0)

    def scratch_bytes(self, rows: int, columns: int, resolution: int, particles: int, substeps: int) -> int:
        """Global memory of a team. With nodes there, ``rows`` and ``columns`` are those of the whole grid."""
        nodes, real = rows * columns, self.real_bytes
        pieces = [4 * (resolution + 2 * PAD) ** 2]  # which rules hold on each node
        if not self.shared:
            pieces += [nodes * self.node_bytes, 3 * 4 * SUMMARY]
        if self.adjoint:  # the tape
            pieces += [substeps * COMPONENTS * particles * real, substeps * 3 * nodes * real, substeps * 32]
        return sum(map(_aligned, pieces))


def _aligned(size: int) -> int:
    return (size + 255) // 256 * 256


def kinds_of(bodies: Sequence[Any]) -> int:
    """The materials among tables of bodies, a bit for each."""
    return sum({1 << body.kind for body in bodies})
