"""Loops over steps, with checkpoints so that memory stays bounded under autograd."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from numbers import Integral
from typing import Any, Literal, TypeAlias, TypeVar, cast

import torch
from torch.utils.checkpoint import checkpoint

from torchmpm import checks, tree
from torchmpm.backends import transforming

State = TypeVar("State")
Input = TypeVar("Input")
Output = TypeVar("Output")

#: Substeps between checkpoints; ``None`` for none, ``"auto"`` to leave it to the backend.
Segment: TypeAlias = int | Literal["auto"] | None
#: Segment of ``"auto"`` where only checkpoints bound the memory.
SEGMENT = 10


def check_repetition(times: int, segment: Segment, name: str = "times") -> tuple[int, Segment]:
    """``times``, which the caller calls ``name``, and ``segment``, converted to Python's integers."""
    given: Any = segment
    if given is not None and not (isinstance(given, str) and given == "auto"):
        if isinstance(given, bool) or not isinstance(given, Integral) or int(given) < 1:
            raise ValueError(f"segment must be at least 1, None or 'auto', got {given!r}")
        segment = int(given)
    return checks.whole(name, times, 0), segment


def _checkpointed(function: Callable[[State], State], state: State, reads: Mapping[str, Any]) -> State:
    """Run a function so that autograd keeps only its input and replays it in the backward pass.

    ``torch.utils.checkpoint`` does not notice when a tensor is changed in place before the replay, which would give a
    wrong gradient; this raises an error. The transforms of ``torch.func`` do not support checkpoints.
    """
    if not torch.is_grad_enabled() or transforming() or torch.compiler.is_compiling():
        return function(state)

    def versions(state: State) -> dict[str, list[int]]:
        # Tensor._version is the counter that torch's documentation of in-place checks describes; it has no public name.
        read = {"state": state, **reads}
        return {name: [t._version for t in tree.leaves(read[name]) if not t.is_inference()] for name in read}

    before = versions(state)

    def replayable(state: State) -> State:
        for name, now in versions(state).items():
            if now != before[name]:
                raise RuntimeError(
                    f"{name} was changed in place after a step had read it, and the backward pass replays that step: "
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
        reads: Tensors by name that ``step`` reads besides the state, and that must not change before a replay.

    Raises:
        ValueError: ``times`` is negative or ``segment`` is below 1.
        RuntimeError: In the backward pass: the state or one of ``reads`` was changed in place before its replay.
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
        RuntimeError: In the backward pass: a state or an input was changed in place before the replay of its step.
    """

    def advance(value: Input, state: State) -> State:
        return step(state, value)

    outputs = []
    for value in inputs:
        once = partial(advance, value)
        state = _checkpointed(once, state, {"input": value}) if checkpointed else once(state)
        outputs.append(observe(state))
    return state, outputs
