"""Drivers that stand for a GPU: tensors on the CPU go through the launcher of the CUDA kernels."""

import ctypes
import functools
import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from torchmpm.native import kernels
from torchmpm.native.cuda import compiler, plan
from torchmpm.native.cuda.arguments import Arguments, Kernel
from torchmpm.native.cuda.driver import Card, Driver, Launch
from torchmpm.native.cuda.launcher import Launcher
from torchmpm.native.library import build

H100 = Card(multiprocessors=132, shared_bytes=232_448)
RTX_4090 = Card(multiprocessors=128, shared_bytes=101_376)


class Recorded(NamedTuple):
    """A launch as a driver was asked for it."""

    kernel: Kernel
    launch: Launch
    arguments: Arguments
    device: torch.device


class Recorder:
    """Launches nothing, and keeps what it was to launch."""

    def __init__(self, card: Card = H100, blocks: int = 1) -> None:
        self._card, self.blocks = card, blocks  # blocks that a multiprocessor holds at once
        self.launches: list[Recorded] = []

    def card(self, device: torch.device) -> Card:
        return self._card

    def load(self, kernel: Kernel, device: torch.device) -> Kernel:
        return kernel

    def resident(self, function: Kernel, threads: int, shared_bytes: int, device: torch.device) -> int:
        return self.blocks * self._card.multiprocessors * (shared_bytes <= self._card.shared_bytes)

    def launch(self, function: Kernel, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        self.launches.append(Recorded(function, launch, Arguments.from_buffer_copy(arguments), device))


class Imitation:
    """Runs the kernels on the CPU, each CUDA thread as a fibre, on blocks so small that several work together."""

    def card(self, device: torch.device) -> Card:
        return Card(multiprocessors=3, shared_bytes=200_000)

    def load(self, kernel: Kernel, device: torch.device) -> tuple[ctypes.CDLL, bool]:
        """One library serves all materials and all numbers of particles."""
        kernel = kernel._replace(kinds=7, per_thread=max(kernel.per_thread, plan.PER_THREAD))
        return _library(kernel._replace(adjoint=False)), kernel.adjoint

    def resident(self, function: Any, threads: int, shared_bytes: int, device: torch.device) -> int:
        return self.card(device).multiprocessors

    def launch(
        self, function: tuple[ctypes.CDLL, bool], launch: Launch, arguments: ctypes.Structure, device: torch.device
    ) -> None:
        library, adjoint = function
        sizes = launch.blocks, ctypes.c_size_t(launch.shared_bytes)
        outcome = library.launch(ctypes.byref(arguments), adjoint, *sizes, ctypes.c_uint64(0), -1, -1)
        if outcome != 0:
            raise RuntimeError(f"the imitation of a GPU ended with {outcome}")


@functools.cache
def _library(kernel: Kernel) -> ctypes.CDLL:
    here = Path(__file__).with_name("imitation")
    folders = (*compiler.FOLDERS, here)
    text = b"".join(file.read_bytes() for folder in folders for file in sorted(folder.iterdir()) if file.is_file())
    macros = kernel.macros | {"DIGEST": hashlib.sha256(text).hexdigest()[:16]}
    options = (*(f"-D{name}={value}" for name, value in macros.items()), *(f"-I{folder}" for folder in folders))
    return build(here / "imitation.cpp", "-O1", *options)


@contextmanager
def in_use(driver: Driver) -> Iterator[Any]:
    """Meanwhile, the native backend runs kernels of this driver on tensors of the CPU."""
    launcher = Launcher(driver)
    with pytest.MonkeyPatch.context() as patch:
        if isinstance(driver, Imitation):
            patch.setattr(plan, "SHARED_THREADS", 32)
            patch.setattr(plan, "TEAM_THREADS", 16)
        patch.setattr(kernels, "forward", launcher.forward)
        patch.setattr(kernels, "backward", launcher.backward)
        yield driver
