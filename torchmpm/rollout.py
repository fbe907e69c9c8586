"""Loops over steps, written once, with checkpoints so that memory stays bounded under autograd."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Literal, TypeAlias, TypeVar

import torch
from torch.utils.checkpoint import checkpoint

from torchmpm import checks

State = TypeVar("State")
Input = TypeVar("Input")
Output = TypeVar("Output")


def _segmented(function: Callable[[State], State], state: State) -> State:
    """Run ``function`` so that autograd keeps only its input and replays it in the backward pass."""
    if not torch.is_grad_enabled():
        return function(state)
    return checkpoint(function, state, use_reentrant=False, preserve_rng_state=False)


def _apply(step: Callable[[State, Input], State], value: Input, state: State) -> State:
    return step(state, value)


#: Substeps between checkpoints; ``None`` for none, ``"auto"`` to leave it to the backend.
Segment: TypeAlias = "int | Literal['auto'] | None"
#: What ``"auto"`` is where nothing but checkpoints bounds the memory.
SEGMENT = 10


def check_repetition(times: int, segment: Segment, name: str = "times") -> None:
    """Raise the errors of :func:`repeated`, where the caller calls ``times`` by this name."""
    checks.whole(name, times, 0)
    if segment not in (None, "auto") and (isinstance(segment, bool) or not (isinstance(segment, int) and segment >= 1)):
        raise ValueError(f"segment must be at least 1, None or 'auto', got {segment!r}")


def repeated(step: Callable[[State], State], state: State, times: int, *, segment: Segment = None) -> State:
    """Apply ``step`` to ``state`` again and again.

    Args:
        step: One step; must not depend on a random generator.
        state: Anything ``step`` takes and returns, with tensors in it.
        times: How often.
        segment: With gradients enabled, keep the state only every ``segment`` steps and replay the steps between in
            the backward pass: memory for ``times / segment`` states and the graph of ``segment`` steps, for one more
            forward pass. ``None`` keeps the whole graph, ``"auto"`` is 10.

    Raises:
        ValueError: ``times`` is negative or ``segment`` is below 1.
    """
    check_repetition(times, segment)
    segment = SEGMENT if segment == "auto" else segment
    if segment is None or segment >= times or not torch.is_grad_enabled():
        for _ in range(times):
            state = step(state)
        return state
    for start in range(0, times, segment):
        length = min(segment, times - start)
        state = _segmented(partial(repeated, step, times=length), state)
    return state


def trajectory(
    step: Callable[[State, Input], State],
    state: State,
    inputs: Iterable[Input],
    *,
    observe: Callable[[State], Output],
    checkpointed: bool = True,
) -> tuple[State, list[Output]]:
    """Advance ``state`` once per input and collect what ``observe`` sees after each step.

    Args:
        step: ``step(state, input) -> state``, for example ``lambda s, a: solver.step(s, a, substeps=100)``.
        state: The start.
        inputs: One entry a step, for example actuation fields.
        observe: What to keep of each state, for example ``lambda s: s.x.mean(1)``.
        checkpointed: With gradients enabled, keep only the states between steps and replay each step in the backward
            pass. Nests with the ``segment`` of :meth:`torchmpm.Solver.step`.

    Returns:
        The final state and the list of observations, one per input.
    """
    outputs = []
    for value in inputs:
        if checkpointed:
            state = _segmented(partial(_apply, step, value), state)
        else:
            state = step(state, value)
        outputs.append(observe(state))
    return state, outputs
