"""Loops over steps, written once, with checkpoints so that memory stays bounded under autograd."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import is_dataclass
from functools import partial
from numbers import Integral
from types import FunctionType
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchmpm import checks

State = TypeVar("State")
Input = TypeVar("Input")
Output = TypeVar("Output")


def transforming() -> bool:
    """Whether a transform of ``torch.func`` is at work; torch has no public name for it."""
    return bool(torch._C._are_functorch_transforms_active())


class _Running(threading.local):
    """The segments that this thread is inside of, forward or in a replay."""

    def __init__(self) -> None:
        self.segments: list[_Segment[Any]] = []


_running = _Running()


class _Segment(Generic[State]):
    """A function to be replayed, which must then read what it read the first time.

    It remembers how often each tensor had been changed in place, not the tensors, which would keep their memory.
    """

    def __init__(self, function: Callable[[State], State], given: Callable[[], dict[str, Any]]) -> None:
        self.function = function
        self.given = given
        self.versions: list[int] = []
        self.replayed: Iterator[int] | None = None  # the versions still to be compared, once it has run

    def __call__(self, state: State) -> State:
        _running.segments.append(self)
        try:
            reads({"state": state} | self.given())
            return self.function(state)
        finally:
            _running.segments.pop()
            self.replayed = iter(self.versions)

    def read(self, name: str, tensor: Tensor) -> None:
        version = -1 if tensor.is_inference() else tensor._version
        if self.replayed is None:
            self.versions.append(version)
        elif next(self.replayed, version) != version:
            raise RuntimeError(
                f"{name} was changed in place after a step had read it, and the backward pass replays that step: give "
                "each step tensors of its own, such as a clone, or keep the whole graph (checkpointed=False, "
                "segment=None)"
            )


def reads(values: Mapping[str, Any]) -> None:
    """Tell the segments around this call what it reads; their replay raises an error if that has changed since.

    Args:
        values: Tensors by name, or tuples, lists, mappings and dataclasses of them; anything else is ignored.
    """
    if _running.segments:
        for name, tensor in tensors(values).items():
            for segment in _running.segments:
                segment.read(name, tensor)


def tensors(values: Mapping[str, Any]) -> dict[str, Tensor]:
    """The tensors among ``values``, see :func:`reads`, by names such as ``state.x`` and ``bodies[0].mass``."""
    found: dict[str, Tensor] = {}

    def collect(value: Any, name: str) -> None:
        if isinstance(value, Tensor):
            found[name] = value
        elif value is None or isinstance(value, int | float | str):
            pass
        elif isinstance(value, tuple | list):
            for index, item in enumerate(value):
                collect(item, f"{name}[{index}]")
        elif isinstance(value, Mapping):
            for key, item in value.items():
                collect(item, f"{name}.{key}")
        elif is_dataclass(value) and not isinstance(value, type):
            for key in value.__dataclass_fields__:
                collect(getattr(value, key), f"{name}.{key}")

    for name, value in values.items():
        collect(value, name)
    return found


def _captured(function: Callable[..., Any]) -> dict[str, Tensor]:
    """The tensors that a Python function names beside its arguments."""
    if not isinstance(function, FunctionType):
        return {}
    code, named = function.__code__, {}
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # nothing has been assigned yet
            named[name] = cell.cell_contents
    named |= {name: function.__globals__.get(name) for name in code.co_names}
    return {name: value for name, value in named.items() if isinstance(value, Tensor)}


def _segmented(function: Callable[[State], State], state: State, step: Callable[..., State], **given: Any) -> State:
    """Run ``function`` so that autograd keeps only its input and replays it in the backward pass.

    The transforms of ``torch.func`` know no checkpoints: under them the whole graph is kept.

    Args:
        function: What to run.
        state: Its argument.
        step: The caller's part of it.
        given: What else that gets.
    """
    if not torch.is_grad_enabled() or transforming():
        return function(state)
    segment = _Segment(function, lambda: given | _captured(step))
    return checkpoint(segment, state, use_reentrant=False, preserve_rng_state=False)


def _apply(step: Callable[[State, Input], State], value: Input, state: State) -> State:
    return step(state, value)


#: Substeps between checkpoints; ``None`` for none, ``"auto"`` to leave it to the backend.
Segment: TypeAlias = "int | Literal['auto'] | None"
#: What ``"auto"`` is where nothing but checkpoints bounds the memory.
SEGMENT = 10


def check_repetition(times: int, segment: Segment, name: str = "times") -> tuple[int, Segment]:
    """``times``, which the caller calls by this name, and ``segment``, of Python's integers where they are integers.

    Raises the errors of :func:`repeated`.
    """
    given: Any = segment
    if given not in (None, "auto"):
        if isinstance(given, bool) or not isinstance(given, Integral) or int(given) < 1:
            raise ValueError(f"segment must be at least 1, None or 'auto', got {given!r}")
        segment = int(given)
    return checks.whole(name, times, 0), segment


def repeated(step: Callable[[State], State], state: State, times: int, *, segment: Segment = None) -> State:
    """Apply ``step`` to ``state`` again and again.

    Args:
        step: One step; must not depend on a random generator.
        state: Anything ``step`` takes and returns, with tensors in it.
        times: How often.
        segment: With gradients enabled, keep the state only every ``segment`` steps and replay the steps between in
            the backward pass: memory for ``times / segment`` states and the graph of ``segment`` steps, for one more
            forward pass. ``None`` keeps the whole graph, ``"auto"`` is 10. The transforms of ``torch.func`` know no
            checkpoints and keep the whole graph too.

    Raises:
        ValueError: ``times`` is negative or ``segment`` is below 1.
        RuntimeError: In the backward pass: a tensor that a step reads was changed in place before its replay. The
            state, tensors that ``step`` names, and all that goes into :meth:`torchmpm.Solver.step` are watched.
    """
    times, segment = check_repetition(times, segment)
    segment = SEGMENT if segment == "auto" else segment
    if segment is None or segment >= times or not torch.is_grad_enabled():
        for _ in range(times):
            state = step(state)
        return state
    for start in range(0, times, segment):
        length = min(segment, times - start)
        state = _segmented(partial(repeated, step, times=length), state, step)
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
            pass. Nests with the ``segment`` of :meth:`torchmpm.Solver.step`, and does nothing under ``torch.func``.

    Returns:
        The final state and the list of observations, one per input.

    Raises:
        RuntimeError: In the backward pass: a tensor that a step reads, such as an input, was changed in place before
            its replay; see :func:`repeated`.
    """
    outputs = []
    for value in inputs:
        if checkpointed:
            state = _segmented(partial(_apply, step, value), state, step, input=value)
        else:
            state = step(state, value)
        outputs.append(observe(state))
    return state, outputs
