"""Ways to run the same substep."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchmpm import native
from torchmpm.native.library import find_compiler
from torchmpm.rollout import reads, transforming

if TYPE_CHECKING:
    from torchmpm.solver import Scene, Solver
    from torchmpm.state import ParticleState

Planes = tuple[Tensor, ...]
Substep = Callable[["Solver", "Scene", Planes], Planes]

BACKENDS = ("auto", "eager", "compile", "native")
_logger = logging.getLogger(__name__)


def compiler_found() -> bool:
    """Whether ``"native"``, and ``"compile"`` on the CPU, can work: is there a C++ compiler ($CXX, g++ or clang++)?"""
    return find_compiler() is not None


def runs_native(solver: Solver, state: ParticleState, *fields: Tensor | None) -> bool:
    """Whether a step from this state is one for ``torchmpm.native``.

    ``"auto"`` takes it on the CPU wherever it works. Where it does not, a warning is logged once that says why. On CUDA
    it waits to be asked for: its kernels there have been tested, but on no device yet.

    Args:
        solver: The solver.
        state: The present state.
        fields: What else the step depends on.

    Raises:
        ValueError: The backend is ``"native"``, or ``"compile"``, and cannot run this.
    """
    if solver.backend == "compile" and not transforming() and _has_tangents(solver, state, fields):
        raise ValueError("backend 'compile' loses the tangents of forward_ad; use 'eager', or torch.func.jvp")
    if solver.backend not in ("auto", "native"):
        return False
    reason = native.unsupported(solver, state.device)
    if reason is None and transforming():
        reason = "the transforms of torch.func do not go through its kernels"
    elif reason is None and _has_tangents(solver, state, fields):
        reason = "it has no forward-mode derivatives"
    if solver.backend == "native":
        if reason is not None:
            raise ValueError(f"backend 'native' cannot run this: {reason}; use 'eager'")
        return True
    if reason is None and state.device.type == "cuda":
        reason = "backend 'native' has not been tried on a CUDA device yet: choose it to do so"
    if reason is None:
        try:
            native.load(state.dtype, state.device)
        except ValueError as error:
            reason = str(error)
    if reason is not None:
        _warn_once(reason)
    return reason is None


def vmapping() -> bool:
    """Whether a ``torch.func.vmap`` is at work."""
    stack = torch._C._functorch.get_interpreter_stack() if transforming() else None
    return any(interpreter.key() == torch._C._functorch.TransformType.Vmap for interpreter in stack or ())


def _has_tangents(solver: Solver, state: ParticleState, fields: Sequence[Tensor | None]) -> bool:
    """Whether anything that a step depends on is a dual tensor of :mod:`torch.autograd.forward_ad`."""
    values = (*vars(state).values(), *fields, solver.gravity)
    values += tuple(value for body in solver.bodies for part in (body, body.material) for value in vars(part).values())
    return any(isinstance(value, Tensor) and forward_ad.unpack_dual(value).tangent is not None for value in values)


@functools.cache
def _warn_once(reason: str) -> None:
    _logger.warning("the physics runs operator by operator, many times slower than it could: %s", reason)


def substep_function(solver: Solver, scene: Scene) -> Callable[[Planes], Planes]:
    """The substep of ``solver`` in ``scene`` as a function of the component planes.

    ``"eager"`` runs operator by operator. ``"compile"`` runs the same code through ``torch.compile``: several times
    faster, after about ten seconds of compilation for each new combination of solver and shapes in a process (less with
    TorchInductor's cache on disk). More than eight combinations in one process run eagerly again.
    """
    run: Substep = type(solver).substep
    if solver.backend == "compile":
        run = _compiled(run)

    read = {"origin": scene.origin} | solver.tensors

    def substep(planes: Planes) -> Planes:
        reads(read)
        return run(solver, scene, planes)

    return substep


@functools.cache
def _compiled(substep: Substep) -> Substep:
    # Sums over the nine nodes become one expression that computes their addresses once; addresses are clamped already.
    options: dict[str, Any] = {"unroll_reductions_threshold": 16, "assert_indirect_indexing": False}
    return torch.compile(substep, dynamic=False, options=options)
