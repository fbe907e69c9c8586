"""The substep as fused kernels: in C++ on the CPU, compiled on first use, and in Triton on CUDA.

``pack`` brings a solver into the tables they read, ``ops`` makes them operators of torch.
:mod:`torchmpm.native.cuda` has all that is for CUDA. The rest is for the CPU: ``library`` compiles and loads. The
kernels, in the order in which they build on each other: ``simd``, ``linalg``, ``material``, ``scene``, ``transfer``,
``grid``, ``team``, ``workspace``, ``step``; the adjoint: ``material_adjoint``, ``grid_adjoint``, ``adjoint_block``,
``adjoint``; ``native.cpp`` is what is compiled.

A simulation's particles are cut into blocks of 64, each of one body. One pass over the blocks reads velocities from the
nodes, moves and deforms the particles, and adds mass and momentum to the nodes for the next substep. The sums of a few
groups of blocks are kept apart and added in one order: results do not depend on the number of threads, nor on what else
is in the batch, by a bit. The adjoint replays a step from its start onto a tape, then goes back with the same passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchmpm.boundary import node_shift
from torchmpm.native import ops, pack
from torchmpm.native.pack import unsupported
from torchmpm.rollout import Segment
from torchmpm.state import ParticleState

if TYPE_CHECKING:
    from torchmpm.solver import Solver

__all__ = ["load", "step", "unsupported"]


def load(dtype: torch.dtype, device: torch.device) -> None:
    """Compile and load the kernels for a dtype, unless that has been done; on CUDA the first step does it.

    Raises:
        ValueError: There is no compiler, or it failed.
    """
    if device.type == "cpu":
        ops.library_for(dtype)


def step(
    solver: Solver,
    state: ParticleState,
    actuation: Tensor | None,
    origin: Tensor,
    substeps: int,
    segment: Segment = "auto",
    *,
    mass_epsilon: float,
) -> ParticleState:
    """Advance a state whose arguments were checked; see :meth:`torchmpm.Solver.step`.

    Args:
        solver: The solver.
        state: Where the particles are, at least one simulation.
        actuation: (B, 2, G, G) or ``None``.
        origin: (B, 2).
        substeps: Number of substeps, at least 1.
        segment: With gradients, at most so many substeps are taped at once.
        mass_epsilon: Added to the mass of a node before the division, kg.

    Raises:
        ValueError: There is no compiler, or it failed.
    """
    origin = origin.contiguous()
    table, widths = pack.values(solver, state.Jp)
    field = None if actuation is None else actuation.contiguous()
    given = solver.gravity if isinstance(solver.gravity, Tensor) else pack.upload(solver.gravity, state.Jp)
    gravity = given.to(state.Jp).expand(state.batch_size, 2).contiguous()
    shift, description = node_shift(solver.grid, origin), pack.description(solver, widths, mass_epsilon)
    planes = state.stack()
    # With gradients a call keeps its start and needs a tape of all its substeps later, which must not grow endlessly.
    limit = ops.tape_limit(planes, solver.grid.width, segment) if torch.is_grad_enabled() else substeps
    for start in range(0, substeps, limit):
        length = min(limit, substeps - start)
        planes = ops.native_step(planes, field, origin, gravity, table, shift, description, length)
    return ParticleState.from_stack(planes)
