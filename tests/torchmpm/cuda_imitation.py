"""Runs the CUDA kernels on the CPU, through the launcher: see ``imitation/cuda_imitation.hpp``."""

import ctypes
import functools
import hashlib
import os
import struct
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from torchmpm.native.cuda.arguments import COMPONENTS, COUNTERS, Arguments, Kernel
from torchmpm.native.cuda.compiler import FOLDERS, digest_of_sources
from torchmpm.native.cuda.driver import Card, Launch
from torchmpm.native.cuda.launcher import Launcher
from torchmpm.native.cuda.plan import Call, Pass
from torchmpm.native.library import build, cache_folder, find_compiler
from torchmpm.native.tables import BodyTable, RuleTable

HERE = Path(__file__).with_name("imitation")
#: Threads of a block, and particles that each of them keeps.
THREADS, PER_THREAD = 32, 4
#: Bytes beyond the scratch memory that must stay as they are.
MARGIN = 4096
#: The imitation runs one launch at a time, while programs may launch from several threads.
_one_machine = threading.Lock()


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

    def load(self, kernel: Kernel, device: torch.device) -> tuple[ctypes.CDLL, Kernel]:
        """The library with a kernel."""
        return library(*kernel[1:]), kernel

    def resident(self, function: Any, threads: int, shared_bytes: int, device: torch.device) -> int:
        """One block on each multiprocessor."""
        return self.card(device).multiprocessors

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        """Run all threads to their end.

        Raises:
            Broken: Threads of a block came to different barriers, wait for ever, or wrote out of bounds.
        """
        kernels, kernel = function
        assert isinstance(arguments, Arguments)
        size = launch.blocks // arguments.team * arguments.scratch_bytes
        scratch = ctypes.create_string_buffer(b"\xcb" * (size + MARGIN), size + MARGIN)
        arguments.scratch = ctypes.addressof(scratch)
        if arguments.result and (kernel.shared or not arguments.status):
            numbers = COMPONENTS * arguments.batch * arguments.particles
            ctypes.memset(arguments.result, 0xFF, numbers * kernel.real_bytes)  # NaN where nothing is written
        with _one_machine:
            outcome = kernels.launch(
                ctypes.byref(arguments), kernel.adjoint, launch.blocks, ctypes.c_size_t(launch.shared_bytes),
                ctypes.c_uint64(self.seed), self.missing_barrier, self.plain_atomic,
            )  # fmt: skip
        if outcome:
            raise Broken(("threads diverged", "threads wait for ever", "shared memory is too small")[outcome - 1])
        if scratch.raw[size:] != b"\xcb" * MARGIN:
            raise Broken("scratch memory is too small")


@functools.cache
def library(shared: bool, real: str, threads: int, per_thread: int, kinds: int, muscles: bool) -> ctypes.CDLL:
    """The kernels of given properties, see :class:`torchmpm.native.cuda.arguments.Kernel`."""
    macros = Kernel(False, shared, real, threads, per_thread, kinds, muscles).macros
    kernels = build(HERE / "imitation.cpp", "-O1", *options(macros))
    assert kernels.bytes_of_arguments() == ctypes.sizeof(Arguments)
    return kernels


def options(macros: dict[str, str]) -> list[str]:
    """What the compiler needs; changes with the sources."""
    own = b"".join(file.read_bytes() for file in sorted(HERE.iterdir()))
    named = macros | {"DIGEST": hashlib.sha256(digest_of_sources().encode() + own).hexdigest()[:16]}
    folders = (*FOLDERS, HERE)
    return [*(f"-D{name}={value}" for name, value in named.items()), *(f"-I{folder}" for folder in folders)]


@dataclass(frozen=True, eq=False)
class Threads(Gpu):
    """A driver that runs each CUDA thread as a thread of the system, and lets ThreadSanitizer watch them."""

    def load(self, kernel: Kernel, device: torch.device) -> tuple[Path, bool]:
        """The program with the kernel, and whether it is the adjoint."""
        flags = ["-std=c++20", "-O1", "-g", "-fsanitize=thread", "-pthread", *options(kernel.macros)]
        path = Path(cache_folder()) / f"threads-{hashlib.sha256(' '.join(flags).encode()).hexdigest()[:16]}"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            command = [*(find_compiler() or ()), *flags, str(HERE / "threads.cpp"), "-o", f"{path}-{os.getpid()}"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                pytest.skip(f"the compiler has no ThreadSanitizer: {done.stderr[-500:]}")
            os.replace(f"{path}-{os.getpid()}", path)
        return path, kernel.adjoint

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        """Run all threads to their end, on a copy of all memory.

        Raises:
            Broken: Two threads access the same number without order, and one of them writes.
        """
        program, adjoint = function
        assert isinstance(arguments, Arguments)
        ctypes.memset(arguments.scratch, 0, launch.blocks // arguments.team * arguments.scratch_bytes)
        content = struct.pack("qqq", adjoint, launch.blocks, launch.shared_bytes) + bytes(arguments)
        for name, size in _sizes(arguments, launch.blocks).items():
            address = getattr(arguments, name)
            content += struct.pack("q", size if address else 0) + (ctypes.string_at(address, size) if address else b"")
        done = subprocess.run([str(program)], input=content, capture_output=True, check=False)
        if b"unexpected memory mapping" in done.stderr:
            pytest.skip("this system's addresses are too random for ThreadSanitizer")
        if done.returncode:
            raise Broken(done.stderr.decode()[:4000])


def _sizes(given: Arguments, blocks: int) -> dict[str, int]:
    """Bytes that each pointer points to, for float32."""
    state, nodes = 4 * 13 * given.batch * given.particles, 4 * 2 * given.batch * given.resolution**2
    values, teams = 4 * 8 * given.values_batch * given.value_columns, blocks // given.team
    sizes = {
        "bodies": ctypes.sizeof(BodyTable) * given.num_bodies,
        "rules": ctypes.sizeof(RuleTable) * given.num_rules,
        "components": state,
        "field": nodes,
        "origin": 8 * given.batch,
        "shift": 16 * given.batch,
        "gravity": 8 * given.batch,
        "values": values,
        "result": state,
        "result_bar": state,
        "components_bar": state,
        "field_bar": nodes,
        "origin_bar": 8 * given.batch,
        "gravity_bar": 8 * given.batch,
        "values_bar": 4 * 8 * given.batch * given.particles,
        "status": 4 * given.batch,
        "counters": 4 * COUNTERS * teams,
        "scratch": given.scratch_bytes * teams,
    }
    names = [name for name, kind in Arguments._fields_ if kind is ctypes.c_void_p]
    return {name: sizes[name] for name in names}


@dataclass(frozen=True)
class Plan:
    """How calls are launched: with nodes in shared memory, in global memory, or in both, one after the other."""

    shared: bool = True
    team: int = 0  # blocks for each robot, with nodes in global memory; 0: these are not used
    teams: int = 2  # robots at a time
    window: tuple[int, int] = (10**6, 10**6)  # nodes in shared memory, at most
    muscles: bool = True  # kernels for muscles, also where no body has any
    sizes: tuple[int, int] = (THREADS, PER_THREAD)


#: Nodes in shared memory, all of them or those in a window; in global memory with one block or two for each robot; and
#: robots that do not fit the window, which are given up and taken by two blocks.
PLANS = {
    "shared": Plan(),
    "window": Plan(window=(16, 14)),
    "one block": Plan(shared=False, team=1),
    "team": Plan(shared=False, team=2, teams=1),
    "given up": Plan(window=(6, 6), team=2),
}


class PlannedLauncher(Launcher):
    """The launcher with small blocks, on the CPU."""

    def __init__(self, gpu: Gpu, plan: Plan) -> None:
        super().__init__(gpu)
        self.plan = plan

    def _make_plan(self, call: Call, device: torch.device) -> list[tuple[Pass, Any]]:
        passes, plan = [], self.plan
        for shared, team in ((True, 1), (False, plan.team)):
            if not (plan.shared if shared else team):
                continue
            kernel = Kernel(call.adjoint, shared, call.real, *plan.sizes, kinds=7, muscles=plan.muscles)
            rows, columns = (min(n, call.width) if shared else call.width for n in plan.window)
            shared_bytes = kernel.shared_bytes(rows, columns, call.bodies, call.rules)
            scratch_bytes = kernel.scratch_bytes(rows, columns, call.resolution, call.particles, call.substeps)
            one = Pass(kernel, rows, columns, team, plan.teams, shared_bytes, scratch_bytes)
            passes.append((one, self.driver.load(kernel, device)))
        return passes
