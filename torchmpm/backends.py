"""Names of the backends, and what they need."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import torch

from torchmpm.native.cpu.compiler import find_compiler
from torchmpm.native.cpu.library import NO_COMPILER, provenance

BACKENDS = ("auto", "eager", "compile", "native")
_logger = logging.getLogger(__name__)


def compiler_found() -> bool:
    """Whether there is a C++ compiler ($CXX, g++ or clang++), which ``"compile"`` needs on the CPU."""
    return find_compiler() is not None


def missing(backend: str) -> str | None:
    """The end of the message "backend 'native' ..." if it cannot run on this machine's CPU; ``None`` if it can."""
    if backend == "native":
        return None if provenance() else NO_COMPILER
    return NO_COMPILER if backend == "compile" and not compiler_found() else None


@functools.cache
def warn_eager(what: str, reason: str) -> None:
    """Log once for each reason that ``what``, such as the physics, runs eagerly although that was not asked for."""
    _logger.warning("%s runs operator by operator, many times slower than it could: %s", what, reason)


@functools.cache
def compiled(substep: Callable[..., Any]) -> Callable[..., Any]:
    """A substep through ``torch.compile``, for devices without native kernels; where there are any, they are faster.

    It compiles for about ten seconds for each new combination of solver and shapes in a process (less with
    TorchInductor's cache on disk). More than eight combinations in one process run eagerly again.
    """
    return torch.compile(substep, dynamic=False)
