"""Runs the CUDA kernels on the CPU, through the launcher: see ``imitation/cuda_imitation.hpp``."""

import ctypes
import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchmpm.native.cuda.arguments import Arguments, Kernel
from torchmpm.native.cuda.compiler import FOLDERS
from torchmpm.native.cuda.driver import Card, Launch
from torchmpm.native.cuda.launcher import Launcher
from torchmpm.native.cuda.plan import Call, Pass
from torchmpm.native.library import build

HERE = Path(__file__).with_name("imitation")
#: Threads of a block, and particles that each of them keeps.
THREADS, PER_THREAD = 32, 2


class Broken(Exception):
    """A launch that did not end well."""


@dataclass(frozen=True, eq=False)
class Gpu:
    """A driver whose device is the CPU, and what is broken about it."""

    seed: int = 0  # of the order of threads
    missing_barrier: int = -1
    plain_atomic: int = -1

    def card(self, device: torch.device) -> Card:
        """See :class:`torchmpm.native.cuda.driver.Driver`."""
        return Card(multiprocessors=2, shared_bytes=100_000)

    def load(self, kernel: Kernel, device: torch.device) -> tuple[ctypes.CDLL, bool]:
        """The library with the kernel, and whether it is the adjoint."""
        return library(*kernel[1:]), kernel.adjoint

    def resident(self, function: Any, threads: int, shared_bytes: int, device: torch.device) -> int:
        """One block on each multiprocessor."""
        return self.card(device).multiprocessors

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        """Run all threads to their end.

        Raises:
            Broken: Threads of a block came to different barriers, wait for ever, or wrote out of bounds.
        """
        kernels, adjoint = function
        assert isinstance(arguments, Arguments)
        ctypes.memset(arguments.scratch, 0xCB, launch.blocks // arguments.team * arguments.scratch_bytes)
        outcome = kernels.launch(
            ctypes.byref(arguments), adjoint, launch.blocks, ctypes.c_size_t(launch.shared_bytes),
            ctypes.c_uint64(self.seed), self.missing_barrier, self.plain_atomic,
        )  # fmt: skip
        if outcome:
            raise Broken(("threads diverged", "threads wait for ever", "shared memory is too small")[outcome - 1])


@functools.cache
def library(shared: bool, real: str, threads: int, per_thread: int, kinds: int, muscles: bool) -> ctypes.CDLL:
    """The kernels of given properties, see :class:`torchmpm.native.cuda.arguments.Kernel`."""
    macros = Kernel(False, shared, real, threads, per_thread, kinds, muscles).macros
    return build(HERE / "imitation.cpp", "-O1", *options(macros))


def options(macros: dict[str, str]) -> list[str]:
    """What the compiler needs; changes with the sources."""
    folders = (*FOLDERS, HERE)
    sources = sorted(file for folder in folders for file in folder.iterdir() if file.suffix in (".cu", ".cuh", ".hpp"))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sources)).hexdigest()[:16]
    named = macros | {"DIGEST": digest}
    return [*(f"-D{name}={value}" for name, value in named.items()), *(f"-I{folder}" for folder in folders)]


@dataclass(frozen=True)
class Plan:
    """How calls are launched: with nodes in shared memory, in global memory, or in both, one after the other."""

    shared: bool = True
    team: int = 0  # blocks for each robot, with nodes in global memory; 0: these are not used
    teams: int = 2  # robots at a time
    window: tuple[int, int] = (10**6, 10**6)  # nodes in shared memory, at most
    muscles: bool = True  # kernels for muscles, also where no body has any


class Imitation(Launcher):
    """The launcher with small blocks, on the CPU."""

    def __init__(self, gpu: Gpu, plan: Plan) -> None:
        super().__init__(gpu)
        self.plan = plan

    def _make_plan(self, call: Call, device: torch.device) -> list[tuple[Pass, Any]]:
        passes, plan = [], self.plan
        for shared, team in ((True, 1), (False, plan.team)):
            if not (plan.shared if shared else team):
                continue
            kernel = Kernel(call.adjoint, shared, call.real, THREADS, PER_THREAD, kinds=7, muscles=plan.muscles)
            rows, columns = (min(n, call.width) if shared else call.width for n in plan.window)
            shared_bytes = kernel.shared_bytes(rows, columns, call.bodies, 16)
            scratch_bytes = kernel.scratch_bytes(rows, columns, call.resolution, call.particles, call.substeps)
            one = Pass(kernel, rows, columns, team, plan.teams, shared_bytes, scratch_bytes)
            passes.append((one, self.driver.load(kernel, device)))
        return passes
