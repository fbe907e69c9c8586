"""Memory that gradients need, estimated before they are computed."""

import copy
from bisect import bisect
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchmpm import checks
from torchmpm.rollout import SEGMENT, Segment, check_repetition
from torchmpm.solver import Solver
from torchmpm.state import ParticleState
from torchmpm.substep import Planes

#: Component planes of a state.
PLANES = 13
#: Largest temporary memory of an eager substep, in units of the graph that it leaves.
TEMPORARY = 0.4
#: Particles of a block of the native kernels, and the numbers of blocks from which on they sum over particles in 2, 4
#: and 8 parts, each with grids of its own (``native/cpu/scene.hpp``).
BLOCK, PARTS = 64, (16, 128, 512)
#: Numbers of a node in the grids that all parts share, and in those of a part, without and with muscles.
SHARED_GRIDS, PART_GRIDS = 8, (16, 24)

#: Where a step starts, or (B, N, dtype) of a state on the CPU.
Start = ParticleState | tuple[int, int, torch.dtype]
#: Bytes as a function of the segment.
Need = Callable[[Segment], int]


def estimate_memory(
    solver: Solver, state: Start, *, substeps: int, segment: Segment = "auto", env_steps: int = 1
) -> int:
    """Bytes that :meth:`torchmpm.Solver.step` and a backward pass through it need beyond their inputs.

    The largest number of bytes alive at once, with gradients in state and actuation, without what an allocator rounds
    up or keeps for later. For the eager backend it is extrapolated from the graph of a substep on tensors without
    memory, for the native one from the size of its tape. For a compiled substep it is an upper bound.

    Args:
        solver: The solver; its backend is the one that the step would use.
        state: Where the step starts; or (B, N, dtype) on the CPU, for which the native backend assumes particles
            all over the window.
        substeps: Substeps of a step.
        segment: As in :meth:`torchmpm.Solver.step`.
        env_steps: Steps in a row, through :func:`torchmpm.trajectory` with its checkpoints.

    Raises:
        ValueError: A number is below 1, the solver cannot run such a state, or would run it natively on CUDA.
        TypeError: The solver or the state has another type.

    Examples:
        Checkpoints need less memory than the whole graph:

        >>> import torch, torchmpm
        >>> robot = torchmpm.Body(2000, torchmpm.VonMises(mu=500.0, lam=50.0, yield_stress=62.0), mass=2.0)
        >>> solver = torchmpm.Solver(torchmpm.Grid(128), (robot,), backend="eager")
        >>> whole, segments = (
        ...     torchmpm.estimate_memory(solver, (1, 2000, torch.float32), substeps=100, segment=segment)
        ...     for segment in (None, 10)
        ... )
        >>> whole > 5 * segments
        True
    """
    substeps, segment = check_repetition(substeps, segment, "substeps")
    return _estimate(solver, state, substeps, env_steps)(segment)


def segment_for(solver: Solver, state: Start, *, substeps: int, budget: int, env_steps: int = 1) -> int | None:
    """The ``segment`` for :meth:`torchmpm.Solver.step` with which gradients fit into a budget.

    The whole graph (``None``) if that fits, which saves a second forward pass eagerly; else as few checkpoints as fit.

    Args:
        solver: The solver.
        state: Where the step starts, or (B, N, dtype) on the CPU.
        substeps: Substeps of a step.
        budget: Bytes.
        env_steps: Steps in a row, see :func:`estimate_memory`.

    Raises:
        ValueError: The smallest need exceeds the budget, or a number is below 1.
        TypeError: The solver or the state has another type.
    """
    checks.whole("budget", budget, 1)
    checks.whole("substeps", substeps, 1)
    need = _estimate(solver, state, substeps, env_steps)
    needs = []
    for segment in (None, *range(substeps - 1, 0, -1)):
        needs.append(need(segment))
        if needs[-1] <= budget:
            return segment
    raise ValueError(
        f"budget must be at least {min(needs):,} bytes for {env_steps} step(s) of {substeps} substeps, got {budget:,}: "
        "take fewer particles, simulations or substeps a step"
    )


def _state(start: Start) -> ParticleState:
    """The state where a step starts; for sizes alone one whose tensors are a single number, expanded."""
    if isinstance(start, ParticleState):
        return start
    if not isinstance(start, tuple) or len(start) != 3 or start[2] not in (torch.float32, torch.float64):
        raise TypeError(f"state must be a ParticleState, or (B, N, torch.float32 or torch.float64), got {start!r:.60}")
    batch, count = checks.whole("B of the state", start[0], 1), checks.whole("N of the state", start[1], 1)
    return ParticleState.from_stack(torch.empty((), dtype=start[2]).expand(PLANES, batch, count))


def _estimate(solver: Solver, start: Start, substeps: int, env_steps: int) -> Need:
    checks.instance("solver", solver, Solver)
    state = _state(start)
    solver.check_state(state)
    checks.whole("substeps", substeps, 1)
    checks.whole("env_steps", env_steps, 1)
    checks.whole("the state's batch size", state.batch_size, 1)
    if not solver.runs_native(state):
        return _eager(solver, state, substeps, env_steps)
    if state.device.type != "cpu":
        raise ValueError(f"state must be on the CPU for the memory of backend 'native', got {state.device}")
    return _native(solver, state, substeps, env_steps, sizes_alone=start is not state)


def _sizes(solver: Solver, state: ParticleState) -> tuple[int, int]:
    """Bytes of a state and of an actuation field."""
    size = state.batch_size * state.x.element_size()
    return PLANES * state.num_particles * size, 2 * solver.grid.resolution**2 * size


def _eager(solver: Solver, state: ParticleState, substeps: int, env_steps: int) -> Need:
    (state_bytes, field_bytes), graph = _sizes(solver, state), _graph_bytes(solver, state)
    # A further step of a trajectory keeps its start, and the derivative in its actuation.
    others = (env_steps - 1) * (state_bytes + field_bytes)

    def need(segment: Segment) -> int:
        length = SEGMENT if segment == "auto" else substeps if segment is None else segment
        starts = 0 if length >= substeps else -(-substeps // length)
        return int(graph * (min(length, substeps) + TEMPORARY)) + starts * state_bytes + others

    return need


def _graph_bytes(solver: Solver, state: ParticleState) -> int:
    """Bytes that one further substep adds to the graph of a step."""
    empty, nodes = state.to("meta"), solver.grid.resolution
    solver = solver.with_constants(tuple(map(_on_meta, solver.bodies)), solver.gravity)
    field = empty.x.new_empty(state.batch_size, 2, nodes, nodes, requires_grad=True)
    scene = solver.scene(empty, field)
    planes: Planes = tuple(plane.detach().requires_grad_() for plane in empty.planes())
    kept: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[id(storage)] = storage
        return tensor

    sizes = []
    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        for _ in range(2):
            planes = solver.substep(scene, planes)
            sizes.append(sum(storage.nbytes() for storage in kept.values()))
    return sizes[1] - sizes[0]


def _on_meta(holder: Any) -> Any:
    """A body or material whose modules, of learned materials, are copies without memory."""
    if isinstance(holder, nn.Module):
        return copy.deepcopy(holder).to("meta")
    if not is_dataclass(holder) or isinstance(holder, type):
        return holder
    parts = {field.name: getattr(holder, field.name) for field in fields(holder)}
    held = {name: part for name, part in parts.items() if isinstance(part, nn.Module) or is_dataclass(part)}
    return replace(holder, **{name: _on_meta(part) for name, part in held.items()})


def _reached(solver: Solver, x: Tensor) -> float:
    """Share of the nodes that particles at ``x`` (B, n, 2), m, reach, with a margin for a step's motion."""
    if not bool(x.isfinite().all()):
        return 1.0
    extent = x.detach().amax(1) - x.detach().amin(1)
    nodes = (extent / solver.grid.h + 5.0).clamp(max=solver.grid.width)
    return float(nodes.prod(1).max() / solver.grid.width**2)


def _native(solver: Solver, state: ParticleState, substeps: int, env_steps: int, sizes_alone: bool) -> Need:
    state_bytes, field_bytes = _sizes(solver, state)
    planes = state.x.new_empty(()).expand(PLANES, *state.Jp.shape)  # for its sizes alone
    parts = 2 ** bisect(PARTS, sum(-(-body.count // BLOCK) for body in solver.bodies))
    share = 1.0 if sizes_alone else _reached(solver, state.x)
    part_shares = [1.0] * parts if sizes_alone else [_reached(solver, x) for x in state.x.chunk(parts, dim=1)]
    # Each team of threads has two states of its own, some grids, and a tape. Memory of nodes that no particle comes
    # near is never written to and takes none.
    numbers = SHARED_GRIDS * share + PART_GRIDS[any(body.muscle for body in solver.bodies)] * sum(part_shares)
    team = 2 * state_bytes // state.batch_size + int(numbers * solver.grid.width**2) * planes.element_size()
    wants_values = any(value.requires_grad for name, value in solver.constants.items() if name != "gravity")
    # Alive at once in a backward pass: every call's start, one result, and derivatives in both on their way.
    others = 4 * state_bytes + env_steps * field_bytes + (8 * state_bytes // PLANES if wants_values else 0)

    def need(segment: Segment) -> int:
        length = min(substeps, solver.kernels.tape_limit(planes, segment))
        tape = length * solver.kernels.tape_bytes(planes, share)
        starts = env_steps * -(-substeps // length) * state_bytes
        return min(state.batch_size, torch.get_num_threads()) * (team + tape) + starts + others

    return need
