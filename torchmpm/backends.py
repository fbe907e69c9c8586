"""Ways to run the same substep."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchmpm.solver import Scene, Solver

Planes = tuple[Tensor, ...]

#: ``"auto"`` stands for ``"eager"`` until a faster backend starts without a wait.
BACKENDS = ("auto", "eager", "compile")


def compiler_found() -> bool:
    """Whether ``"compile"`` can work on the CPU: TorchInductor needs a C++ compiler (``$CXX``, g++ or clang++)."""
    return shutil.which(os.environ.get("CXX", "g++")) is not None or shutil.which("clang++") is not None


def substep_function(solver: Solver, scene: Scene) -> Callable[[Planes], Planes]:
    """The substep of ``solver`` in ``scene`` as a function of the component planes.

    ``"eager"`` runs operator by operator. ``"compile"`` runs the same code through ``torch.compile``: several times
    faster, after about ten seconds of compilation for each new combination of solver and shapes in a process (less with
    TorchInductor's cache on disk). More than eight combinations in one process run eagerly again.
    """
    run = _compiled() if solver.backend == "compile" else type(solver).substep
    return lambda planes: run(solver, scene, planes)


@functools.cache
def _compiled() -> Callable[[Solver, Scene, Planes], Planes]:
    from torchmpm.solver import Solver  # not at the top: the solver imports this module

    return torch.compile(Solver.substep, dynamic=False)
