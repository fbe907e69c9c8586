"""Memory that gradients need, estimated before they are computed."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmpm import checks
from torchmpm.native.cpu import call
from torchmpm.native.inputs import Inputs
from torchmpm.rollout import SEGMENT, Segment, check_repetition
from torchmpm.solver import Solver
from torchmpm.state import ParticleState
from torchmpm.substep import Planes, substep

#: Component planes of a state.
PLANES = 13
#: Largest temporary memory of an eager substep, in units of the graph that it leaves: on top of a graph, and without.
WITH_GRAPH, WITHOUT_GRAPH = 0.4, 0.7


def estimate_memory(
    solver: Solver,
    state: ParticleState | tuple[int, int, torch.dtype],
    *,
    substeps: int,
    segment: Segment = "auto",
    env_steps: int = 1,
    backward: bool = True,
) -> int:
    """Bytes that :meth:`torchmpm.Solver.step`, and a backward pass through it, will need beyond their inputs.

    For the eager backend, the graph of a substep is measured on tensors without memory, and the result is extrapolated.
    A compiled substep keeps less than an eager one, so there this is an upper bound. The native backend reports the
    size of its scratch memory. The estimate is the largest number of bytes alive at once, with gradients in state and
    actuation; what an allocator rounds up, or keeps for later, is not included.

    Args:
        solver: The solver; its backend is the one that the step would use.
        state: Where the step starts; or (B, N, dtype) on the CPU, for which the native backend assumes particles
            all over the window.
        substeps: Substeps of a step.
        segment: As in :meth:`torchmpm.Solver.step`.
        env_steps: Steps in a row, through :func:`torchmpm.trajectory` with its checkpoints.
        backward: With a gradient; else only what one step needs without.

    Raises:
        ValueError: A number is below 1, the solver cannot run such a state, or it would run it natively on CUDA, whose
            memory is not known beforehand.
    """
    batch = state.batch_size if isinstance(state, ParticleState) else state[0]
    for name, number in (("substeps", substeps), ("env_steps", env_steps), ("the state's batch size", batch)):
        checks.whole(name, number, 1)
    substeps, segment = check_repetition(substeps, segment, "substeps")
    share = _occupied(solver, state)
    state = _empty(solver, state)
    if solver.runs_native(state):
        if state.device.type != "cpu":
            raise ValueError(f"state must be on the CPU for the memory of backend 'native', got {state.device}")
        return _native(solver, state, substeps, segment, env_steps, backward, share)
    graph = _graph_bytes(solver, state)
    if not backward:
        return int(WITHOUT_GRAPH * graph)
    return _eager(state, graph, substeps, segment) + (env_steps - 1) * _step_bytes(solver, state)


def segment_for(
    solver: Solver,
    state: ParticleState | tuple[int, int, torch.dtype],
    *,
    substeps: int,
    budget: int,
    env_steps: int = 1,
) -> int | None:
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
    """
    least = estimate_memory(solver, state, substeps=substeps, segment=None, env_steps=env_steps)
    if least <= budget:
        return None
    share, state = _occupied(solver, state), _empty(solver, state)
    lengths = range(substeps - 1, 0, -1)
    if solver.runs_native(state):
        needs = {n: _native(solver, state, substeps, n, env_steps, True, share) for n in lengths}
    else:
        graph = _graph_bytes(solver, state)
        others = least - _eager(state, graph, substeps, None)
        needs = {n: others + _eager(state, graph, substeps, n) for n in lengths}
    for length, need in needs.items():
        if need <= budget:
            return length
    least = min([least, *needs.values()])
    raise ValueError(
        f"budget must be at least {least:,} bytes for {env_steps} step(s) of {substeps} substeps, {state.batch_size} x "
        f"{state.num_particles} particles in {state.dtype}, got {budget:,}: take fewer particles, simulations or "
        "substeps a step"
    )


def _empty(solver: Solver, state: ParticleState | tuple[int, int, torch.dtype]) -> ParticleState:
    """A state of that size; nothing is written to its memory, so it takes none."""
    if isinstance(state, ParticleState):
        return state
    batch, count, dtype = state
    if count != solver.num_particles:
        raise ValueError(f"state has {count} particles, the solver's bodies {solver.num_particles}")
    return ParticleState.from_stack(torch.empty(PLANES, batch, count, dtype=dtype))


def _state_bytes(state: ParticleState) -> int:
    return PLANES * state.batch_size * state.num_particles * state.x.element_size()


def _field_bytes(solver: Solver, state: ParticleState) -> int:
    return 2 * state.batch_size * solver.grid.resolution**2 * state.x.element_size()


def _step_bytes(solver: Solver, state: ParticleState) -> int:
    """What a further step of a trajectory adds: its start, and the derivative in its actuation."""
    return _state_bytes(state) + _field_bytes(solver, state)


def _eager(state: ParticleState, graph: int, substeps: int, segment: Segment) -> int:
    """Bytes of an eager step with its backward pass, from those that the graph of one substep takes."""
    segment = SEGMENT if segment == "auto" else segment
    if segment is None or segment >= substeps:
        return int(graph * (substeps + WITH_GRAPH))
    return int(graph * (segment + WITH_GRAPH)) + _state_bytes(state) * -(-substeps // segment)


def _graph_bytes(solver: Solver, state: ParticleState) -> int:
    """Bytes that one further substep adds to the graph of a step."""
    batch, count, nodes = state.batch_size, state.num_particles, solver.grid.resolution
    stacked = torch.empty(PLANES, batch, count, dtype=state.dtype, device="meta")
    field = torch.empty(batch, 2, nodes, nodes, dtype=state.dtype, device="meta")
    scene = solver.scene(ParticleState.from_stack(stacked), field.requires_grad_())
    planes: Planes = tuple(plane.requires_grad_() for plane in stacked.unbind())
    kept: dict[int, torch.UntypedStorage] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[id(storage)] = storage
        return tensor

    sizes = []
    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        for _ in range(2):
            planes = substep(scene, planes)
            sizes.append(sum(storage.nbytes() for storage in kept.values()))
    return sizes[1] - sizes[0]


def _occupied(solver: Solver, state: ParticleState | tuple[int, int, torch.dtype]) -> float:
    """Share of the nodes that a state reaches, with a margin for a step's motion; all where only sizes are known."""
    if not isinstance(state, ParticleState) or not bool(state.x.isfinite().all()):
        return 1.0
    extent = state.x.detach().amax(1) - state.x.detach().amin(1)
    nodes = (extent / solver.grid.h + 5.0).clamp(max=solver.grid.width)
    return float(nodes.prod(1).max() / solver.grid.width**2)


def _native(
    solver: Solver,
    state: ParticleState,
    substeps: int,
    segment: Segment,
    env_steps: int,
    backward: bool,
    share: float,
) -> int:
    planes = state.x.new_empty(PLANES, state.batch_size, state.num_particles)
    length = min(substeps, solver.kernels.tape_limit(planes, segment)) if backward else substeps
    scratch = _scratch_bytes(solver, state, length, backward)
    if not backward:
        return scratch + 2 * _state_bytes(state)
    # The tape has room for all nodes, but memory that is never written to takes none.
    teams = max(1, round(scratch / _scratch_bytes(solver, state[0], length, backward)))
    scratch -= int((1.0 - share) * 3 * solver.grid.width**2 * state.x.element_size() * length * teams)
    # Alive at once in a backward pass: every call's start, one result, and derivatives in both on their way.
    calls = env_steps * -(-substeps // length)
    values_bar = 8 * _state_bytes(state) // PLANES if _differentiates_values(solver) else 0
    derivatives = 3 * _state_bytes(state) + values_bar
    return scratch + (calls + 1) * _state_bytes(state) + derivatives + env_steps * _field_bytes(solver, state)


def _differentiates_values(solver: Solver) -> bool:
    """Whether a material value, mass or volume has a gradient."""
    return any(value.requires_grad for name, value in solver.constants.items() if name != "gravity")


def _scratch_bytes(solver: Solver, state: ParticleState, substeps: int, backward: bool) -> int:
    """Scratch memory that the kernels ask for."""
    batch, count, nodes = state.batch_size, state.num_particles, solver.grid.resolution
    empty = state.x.new_empty
    with torch.no_grad():
        values = solver.kernels.values(state.Jp)
    field, pair, planes = empty(batch, 2, nodes, nodes), empty(batch, 2), empty(PLANES, batch, count)
    inputs = Inputs(planes, field, pair, pair, values, torch.empty(batch, 2, dtype=torch.int64))
    outputs = {"result": planes}
    if backward:
        outputs = dict.fromkeys(("planes_bar", "field_bar"), planes)
        outputs |= dict.fromkeys(("origin_bar", "gravity_bar"), pair)
        if _differentiates_values(solver):
            outputs["values_bar"] = planes
    return call.scratch_bytes(inputs, solver.kernels.handle, substeps, **outputs)
