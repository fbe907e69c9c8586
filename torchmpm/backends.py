"""Names of the backends, and what can and cannot go through them."""

import functools
import logging
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.native.cpu.compiler import find_compiler
from torchmpm.native.cpu.library import NO_COMPILER, provenance

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
BACKENDS = ("auto", "eager", "compile", "native")
#: Results that a function of :func:`cached_tensors` keeps.
LARGEST_CACHE = 64
_logger = logging.getLogger(__name__)


def compiler_found() -> bool:
    """Whether there is a C++ compiler ($CXX, g++ or clang++), which ``"compile"`` needs on the CPU."""
    return find_compiler() is not None


def missing(backend: str) -> str | None:
    """The end of the message "backend 'native' ..." if it cannot run on this machine's CPU; ``None`` if it can."""
    if backend == "native":
        return None if provenance() else NO_COMPILER
    return NO_COMPILER if backend == "compile" and not compiler_found() else None


def transforming() -> bool:
    """Whether a transform of ``torch.func`` is active."""
    return bool(torch._C._are_functorch_transforms_active())  # torch.func has no public query for this


def cached_tensors(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Keep the tensors that a function of hashable arguments returns, for as long as they serve all later calls.

    Those made in inference mode could not serve gradients; those made under a transform of ``torch.func`` end with it,
    and so do those of a trace, such as that of ``torch.export``, whose tensors hold no numbers.
    """
    kept: dict[Any, Result] = {}

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if transforming() or torch.compiler.is_compiling():
            return function(*args, **kwargs)
        key = args, tuple(kwargs.items())
        result = kept.get(key)
        if result is None:
            with torch.inference_mode(False):
                result = function(*args, **kwargs)
            if all(type(tensor) is Tensor for tensor in tree.leaves(result)):
                if len(kept) >= LARGEST_CACHE:
                    kept.clear()
                kept[key] = result
        return result

    return call


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
