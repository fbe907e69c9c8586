"""Loops over steps, with checkpoints so that memory stays bounded under autograd."""

import weakref
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from functools import partial
from numbers import Integral
from typing import Any, Literal, TypeAlias, TypeVar, cast

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchmpm import checks, tree
from torchmpm.tree import transforming

State = TypeVar("State")
Input = TypeVar("Input")
Output = TypeVar("Output")
Shared = TypeVar("Shared")

#: Substeps between checkpoints; ``None``: no checkpoints; ``"auto"`` leaves it to the backend.
Segment: TypeAlias = int | Literal["auto"] | None
#: Segment of ``"auto"`` where only checkpoints bound the memory.
SEGMENT = 10
#: What was read before a checkpoint is replayed: a name, the tensor as long as it lives, and its counter of changes.
Reads: TypeAlias = list[tuple[str, "weakref.ref[Tensor]", int]]
#: Of the checkpoints, from the outermost in, whose function runs for the first time.
_running: ContextVar[tuple[Reads, ...]] = ContextVar("_running", default=())


def check_repetition(times: int, segment: Segment, name: str = "times") -> tuple[int, Segment]:
    """``times``, which the caller calls ``name``, and ``segment``, converted to Python's integers."""
    given: Any = segment
    if given is not None and not (isinstance(given, str) and given == "auto"):
        if isinstance(given, bool) or not isinstance(given, Integral) or int(given) < 1:
            raise ValueError(f"segment must be at least 1, None or 'auto', got {given!r}")
        segment = int(given)
    return checks.whole(name, times, 0), segment


def note_reads(reads: Mapping[str, Any]) -> None:
    """Tell the checkpoints around a step which tensors it reads besides its state, by name.

    They must not change before the replay. What a checkpoint's function itself makes is made anew then, and not kept.
    """
    if running := _running.get():
        found = versions(reads)
        for record in running:
            record += found


def versions(reads: Mapping[str, Any]) -> Reads:
    """Note how often tensors, by name, were changed in place, where torch counts that."""
    if transforming() or torch.compiler.is_compiling():
        return []
    # Tensor._version is the counter that torch's documentation of in-place checks describes; it has no public name.
    # Views share it with their base, which lives on where a function makes a new view in each call.
    tensors = [(name, tensor) for name, read in reads.items() for tensor in tree.leaves(read)]
    return [(name, weakref.ref(_base(t)), t._version) for name, t in tensors if not t.is_inference()]


def _base(tensor: Tensor) -> Tensor:
    return tensor if tensor._base is None else tensor._base


def changed(before: Reads) -> list[str]:
    """The names of the tensors that were changed in place since :func:`versions` noted them."""
    tensors = ((name, reference(), version) for name, reference, version in before)
    return list(dict.fromkeys(name for name, t, version in tensors if t is not None and t._version != version))


class _Replay(torch.autograd.Function):
    """A function of tensors that runs without a graph now, and with one in the backward pass.

    Without reentry, ``torch.utils.checkpoint`` builds the graph in the forward pass too, and keeps its nodes: it takes
    twice as long, and its memory grows with every operation. But it finds the tensors that a function reads by
    itself, while this function has to get all of them as arguments.
    """

    @staticmethod
    def forward(ctx: Any, function: Callable[..., tuple[Tensor, ...]], *tensors: Tensor) -> tuple[Tensor, ...]:
        """Call ``function(*tensors)``; torch notices if one of them is changed in place before the backward pass."""
        ctx.function = function
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return function(*tensors)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Tensor | None, ...]:
        """Derivatives in the tensors from those in the results."""
        again = torch.is_grad_enabled()  # with create_graph=True
        # Tensors of its own: derivatives must end at them, although one argument may depend on another.
        tensors = [t.view_as(t) if again else t.detach().requires_grad_(t.requires_grad) for t in ctx.saved_tensors]
        with torch.enable_grad():
            results = ctx.function(*tensors)
        pairs = [(r, bar) for r, bar in zip(results, bars, strict=True) if bar is not None and r.requires_grad]
        inputs = [tensor for tensor in tensors if tensor.requires_grad]
        found: Iterable[Tensor | None] = [None] * len(inputs)
        if pairs:
            ends, their_bars = zip(*pairs, strict=True)
            found = torch.autograd.grad(ends, inputs, their_bars, create_graph=again, allow_unused=True)
        derivatives = iter(found)
        return None, *(next(derivatives) if tensor.requires_grad else None for tensor in tensors)


def _checkpointed(function: Callable[[State], State], state: State, reads: Mapping[str, Any]) -> State:
    """Run a function so that autograd keeps only its input and replays it in the backward pass.

    ``torch.utils.checkpoint`` does not notice when a tensor is changed in place before the replay, which would give a
    wrong gradient; this raises an error. The transforms of ``torch.func`` do not support checkpoints.
    """
    if not torch.is_grad_enabled() or transforming() or torch.compiler.is_compiling():
        return function(state)
    before, replaying = versions({"state": state, **reads}), False

    def replayable(state: State) -> State:
        nonlocal replaying
        if not replaying:
            replaying = True
            token = _running.set((*_running.get(), before))
            try:
                return function(state)
            finally:
                _running.reset(token)
        if names := changed(before):
            raise RuntimeError(
                f"{names[0]} was changed in place after a step had read it, and the backward pass replays that step: "
                "give each step tensors of its own, such as a clone, or keep the whole graph (checkpointed=False, "
                "segment=None)"
            )
        return function(state)

    return cast(State, checkpoint(replayable, state, use_reentrant=False, preserve_rng_state=False))


def repeated(
    step: Callable[[State], State],
    state: State,
    times: int,
    *,
    segment: Segment = None,
    reads: Mapping[str, Any] | None = None,
) -> State:
    """Apply ``step`` to ``state`` again and again.

    Args:
        step: One step; must not depend on a random generator.
        state: A tensor or a tree of tensors (see ``torchmpm.tree``) that ``step`` takes and returns.
        times: Number of repetitions.
        segment: With gradients enabled, keep the state only every ``segment`` steps and replay the steps between in
            the backward pass: memory for ``times / segment`` states and the graph of ``segment`` steps, for one more
            forward pass. ``None``, and any value under ``torch.func``, keeps the whole graph; ``"auto"`` is 10.
        reads: Tensors by name that ``step`` reads besides the state, and that must not change before a replay. Those
            that :meth:`torchmpm.Solver.step` reads need not be among them.

    Raises:
        ValueError: ``times`` is negative or ``segment`` is below 1.
        RuntimeError: In the backward pass: the state, one of ``reads``, or a tensor that a :class:`torchmpm.Solver`
            within ``step`` reads was changed in place before its replay.
    """
    times, segment = check_repetition(times, segment)
    segment = SEGMENT if segment == "auto" else segment
    if segment is None or segment >= times or not torch.is_grad_enabled():
        for _ in range(times):
            state = step(state)
        return state
    for start in range(0, times, segment):
        length = min(segment, times - start)
        state = _checkpointed(partial(repeated, step, times=length), state, reads or {})
    return state


def replayed(
    step: Callable[[Shared, tuple[Tensor, ...]], tuple[Tensor, ...]],
    shared: Shared,
    state: tuple[Tensor, ...],
    times: int,
    segment: Segment,
) -> tuple[Tensor, ...]:
    """The same as :func:`repeated`, in half the time, for a step whose tensors are all in a tree ``shared``.

    Without gradients, and where ``torch.func`` or ``torch.compile`` is at work, it keeps no checkpoints.
    """
    segment = SEGMENT if segment == "auto" else segment
    keeps = torch.is_grad_enabled() and not transforming() and not torch.compiler.is_compiling()
    if segment is None or segment >= times or not keeps:
        for _ in range(times):
            state = step(shared, state)
        return state
    for start in range(0, times, segment):
        tensors, rebuild = tree.flatten(tree.without_inference((shared, state)))
        run = partial(_run, step, rebuild, min(segment, times - start))
        state = cast(tuple[Tensor, ...], _Replay.apply(run, *tensors))
    return state


def _run(step: Callable[..., Any], rebuild: Callable[..., Any], times: int, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Apply ``step`` again and again, from the tensors of what it shares and of the state."""
    shared, state = rebuild(tensors)
    for _ in range(times):
        state = step(shared, state)
    return cast(tuple[Tensor, ...], state)


def trajectory(
    step: Callable[[State, Input], State],
    state: State,
    inputs: Iterable[Input],
    *,
    observe: Callable[[State], Output],
    checkpointed: bool = True,
) -> tuple[State, list[Output]]:
    """Advance ``state`` once per input and collect an output after each step.

    Args:
        step: ``step(state, input) -> state``, for example ``lambda s, a: solver.step(s, a, substeps=100)``.
        state: The start.
        inputs: One entry a step, for example actuation fields.
        observe: What to keep of each state, for example ``lambda s: s.x.mean(1)``.
        checkpointed: With gradients enabled, keep only the states between steps and replay each step in the backward
            pass. Nests with the ``segment`` of :meth:`torchmpm.Solver.step`, and does nothing under ``torch.func``.

    Returns:
        The final state and the list of outputs, one per input.

    Raises:
        RuntimeError: In the backward pass: a state, an input, or a tensor that a :class:`torchmpm.Solver` within
            ``step`` reads (its constants, the actuation, the origin) was changed in place before the replay. Other
            tensors that ``step`` reads are not checked.
    """

    def advance(value: Input, state: State) -> State:
        return step(state, value)

    outputs = []
    for value in inputs:
        once = partial(advance, value)
        state = _checkpointed(once, state, {"input": value}) if checkpointed else once(state)
        outputs.append(observe(state))
    return state, outputs
