"""Drivers that stand for a GPU: tensors on the CPU go through the launcher of the CUDA kernels."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import pytest
import torch
from cuda_imitation import Gpu, Plan, PlannedLauncher

from torchmpm.native import kernels
from torchmpm.native.cuda import plan
from torchmpm.native.cuda.arguments import Arguments, Kernel
from torchmpm.native.cuda.driver import Card, Driver, Launch
from torchmpm.native.cuda.launcher import Launcher

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


class Imitation(Gpu):
    """The imitation of a GPU, with few libraries: one serves all materials and all numbers of particles."""

    def card(self, device: torch.device) -> Card:
        """Up to three robots are few."""
        return Card(multiprocessors=32, shared_bytes=100_000)

    def load(self, kernel: Kernel, device: torch.device) -> tuple[ctypes.CDLL, Kernel]:
        per_thread = plan.PER_THREAD if kernel.per_thread > 0 else 0
        return super().load(kernel._replace(kinds=7, per_thread=per_thread), device)


@contextmanager
def in_use(driver: Driver, by_plan: Plan | None = None) -> Iterator[Any]:
    """Meanwhile, the native backend runs kernels of this driver on tensors of the CPU, by a plan or by its own."""
    launcher = Launcher(driver) if by_plan is None else PlannedLauncher(driver, by_plan)
    with pytest.MonkeyPatch.context() as patch:
        if isinstance(driver, Imitation):
            patch.setattr(plan, "SHARED_THREADS", 32)
            patch.setattr(plan, "ADJOINT_THREADS", 32)
            patch.setattr(plan, "TEAM_THREADS", 32)
            patch.setattr(plan, "SMALL", 40)
        patch.setattr(kernels, "forward", launcher.forward)
        patch.setattr(kernels, "backward", launcher.backward)
        yield driver
