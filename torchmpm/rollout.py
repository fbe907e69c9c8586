"""Loops over steps, with checkpoints so that memory stays bounded under autograd."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar, cast

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop

from torchmpm import checks, tree
from torchmpm.checks import Segment
from torchmpm.tree import transforming

State = TypeVar("State")
Input = TypeVar("Input")
Output = TypeVar("Output")

#: Segment of ``"auto"`` where only checkpoints bound the memory.
SEGMENT = 10


def repeated(
    step: Callable[..., State], state: State, times: int, *, segment: Segment = None, shared: Any = None
) -> State:
    """Apply a function to a state several times, with checkpoints that bound the memory of gradients.

    Args:
        step: ``step(state) -> state``, or, if ``shared`` is given, ``step(shared, state) -> state``. It must not depend
            on a random generator.
        state: A tensor or a tree of tensors (see :mod:`torchmpm.tree`).
        times: Number of repetitions.
        segment: With gradients enabled, keep the state only every ``segment`` steps and replay the steps between in
            the backward pass. This takes memory for ``times / segment`` states and the graph of ``segment`` steps, and
            the time of one more forward pass. ``None`` keeps the whole graph, as does any value under ``torch.func``
            and ``torch.compile``; ``"auto"`` is 10.
        shared: A tree of all tensors that ``step`` reads besides the state. Without it, ``step`` may read any tensors,
            but checkpoints take about twice as long; and if ``step`` calls ``torch.autograd.grad``, they take many
            times as long, and more memory than a whole graph.

    Returns:
        The state after ``times`` steps.

    Raises:
        ValueError: ``times`` is not a whole number from 0, or ``segment`` not a whole number from 1, ``None`` or
            ``"auto"``.
        TypeError: With ``shared`` and checkpoints: ``shared`` or ``state`` holds something whose tensors checkpoints
            cannot see, such as a module.
        RuntimeError: In the backward pass: a tensor that ``step`` reads was changed in place before its replay.

    Examples:
        >>> import torch, torchmpm
        >>> x = torch.ones(3, requires_grad=True)
        >>> torchmpm.repeated(torch.sin, x, times=100, segment=10).sum().backward()
        >>> x.grad.shape
        torch.Size([3])
    """
    times, segment = checks.whole("times", times, 0), checks.segment(segment)
    if segment is None or not _records():
        segment = max(times, 1)
    elif segment == "auto":
        segment = SEGMENT
    arguments = () if shared is None else (shared,)
    checkpointed = _checkpointed
    if shared is not None and segment < times:
        for name, given in (("shared", shared), ("state", state)):
            if (opaque := tree.opaque_leaf(given)) is not None:  # derivatives in tensors that it hides would be lost
                raise TypeError(
                    f"{name} must hold only tensors, numbers, strings and containers of them, got a "
                    f"{type(opaque).__name__}: register a dataclass with torchmpm.tree.register, and give the tensors "
                    "of other objects"
                )
        tensors = tree.leaves((shared, state))
        if not tree.has_tangents(tensors) and not _autocast(tensors):
            checkpointed = _replayed
    for start in range(0, times, segment):
        run = partial(_run, step, min(segment, times - start))
        if segment >= times:
            state = run(*arguments, state)
        else:
            state = checkpointed(run, *arguments, state)
    return state


def trajectory(
    step: Callable[[State, Input], State],
    state: State,
    inputs: Iterable[Input],
    *,
    observe: Callable[[State], Output],
    checkpointed: bool = True,
) -> tuple[State, list[Output]]:
    """Advance a state once per input and collect an output after each step.

    Args:
        step: ``step(state, input) -> state``, for example ``lambda s, a: solver.step(s, a, substeps=100)``.
        state: The state at the start, a tensor or a tree of tensors (see :mod:`torchmpm.tree`).
        inputs: One entry a step, for example actuation fields (B, 2, G, G).
        observe: What to keep of each state, for example ``lambda s: s.x.mean(1)``.
        checkpointed: With gradients enabled, keep only the states between steps and replay each step in the backward
            pass. This combines with the ``segment`` of :meth:`torchmpm.Solver.step`, and has no effect under
            ``torch.func`` and ``torch.compile``.

    Returns:
        The final state and the list of outputs, one per input.

    Raises:
        ValueError: ``checkpointed`` is not True or False.
        RuntimeError: In the backward pass: a tensor that ``step`` reads was changed in place before its replay.

    Examples:
        >>> import torch, torchmpm
        >>> body = torchmpm.Body(200, torchmpm.Elastic(1e3, 1e3), mass=1e-2, volume=1e-4, muscle=True)
        >>> solver = torchmpm.Solver(torchmpm.Grid(32), (body,))
        >>> disc = torchmpm.sampling.disc(torchmpm.sampling.sobol(200, seed=0), centre=(0.5, 0.5), radius=0.08)
        >>> start = torchmpm.ParticleState.at_rest(torch.as_tensor(disc))
        >>> fields = torch.zeros(4, 1, 2, 32, 32, dtype=torch.float64, requires_grad=True)  # of four steps
        >>> advance = lambda state, field: solver.step(state, field, substeps=10)
        >>> end, centres = torchmpm.trajectory(advance, start, fields, observe=lambda state: state.x.mean(1))
        >>> len(centres), centres[0].shape
        (4, torch.Size([1, 2]))
    """
    checks.flag("checkpointed", checkpointed)
    outputs = []
    for value in inputs:
        state = _checkpointed(step, state, value) if checkpointed and _records() else step(state, value)
        outputs.append(observe(state))
    return state, outputs


def _run(step: Callable[..., State], times: int, *arguments: Any) -> State:
    *shared, state = arguments
    for _ in range(times):
        state = step(*shared, state)
    return cast(State, state)


def _records() -> bool:
    """Whether a graph is recorded that checkpoints can shorten; torch's transforms and compiler have no checkpoints."""
    return torch.is_grad_enabled() and not transforming() and not torch.compiler.is_compiling()


def _autocast(tensors: Iterable[Tensor]) -> bool:
    """Whether autocast is on where the tensors are; :func:`_replayed` would replay without it, in another dtype."""
    kinds = {tensor.device.type for tensor in tensors}
    return any(torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind) for kind in kinds)


def _checkpointed(function: Callable[..., State], *arguments: Any) -> State:
    """``function(*arguments)``, of which autograd keeps only the arguments and the result.

    ``torch.utils.checkpoint`` differentiates in all tensors that the function reads, but notices only of the arguments
    when one of them is changed in place before the replay. After a change of others the replay comes to another
    result, unless a factor is zero, and this raises an error.
    """
    tensors, rebuild = tree.flatten(tree.without_inference(arguments))
    result: State | None = None

    def replayable(*tensors: Tensor) -> State:
        nonlocal result
        found = function(*rebuild(tensors))
        if result is None:
            result = tree.detach(found)
        elif not _close(found, result):
            raise RuntimeError(
                "a tensor that a step reads was changed in place after the step, so that its replay in the backward "
                "pass comes to another state: give each step tensors of its own, such as a clone, draw random numbers "
                "before the step, or keep the whole graph (checkpointed=False, segment=None)"
            )
        return found

    with set_checkpoint_early_stop(False):  # or the replay would end before the result
        return cast(State, checkpoint(replayable, *tensors, use_reentrant=False, preserve_rng_state=False))


def _close(found: Any, expected: Any) -> bool:
    """Whether tensors are equal but for half of their digits, as sums on CUDA are taken in no fixed order."""

    def close(new: Tensor, old: Tensor) -> bool:
        if torch.equal(new, old) or not new.is_floating_point():
            return torch.equal(new, old)
        tolerance = torch.finfo(new.dtype).eps ** 0.5
        largest = torch.where(old.isfinite(), old.abs(), 0.0).max().item()
        return torch.allclose(new, old, rtol=tolerance, atol=tolerance * largest, equal_nan=True)

    return all(map(close, tree.leaves(tree.detach(found)), tree.leaves(expected)))


def _replayed(function: Callable[..., State], *arguments: Any) -> State:
    """As :func:`_checkpointed`, in half the time, of a function that reads no tensors but those of its arguments.

    It has no forward-mode derivatives.
    """
    tensors, rebuild = tree.flatten(tree.without_inference(arguments))
    structure: list[Callable[..., State]] = []

    def of_tensors(*tensors: Tensor) -> tuple[Tensor, ...]:
        results, of_results = tree.flatten(function(*rebuild(tensors)))
        structure[:] = [of_results]
        return tuple(results)

    results = _Replay.apply(of_tensors, *tensors)
    return structure[0](results)


class _Replay(torch.autograd.Function):
    """A function of tensors that runs without a graph now, and with one in the backward pass."""

    @staticmethod
    def forward(ctx: Any, function: Callable[..., tuple[Tensor, ...]], *tensors: Tensor) -> tuple[Tensor, ...]:
        """Call ``function(*tensors)``; torch notices if one of them is changed in place before the backward pass."""
        ctx.function = function
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return function(*tensors)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        """Derivatives in the tensors from those in the results."""
        again = torch.is_grad_enabled()  # with create_graph=True
        # Tensors of its own: derivatives must end at them, although one argument may depend on another.
        tensors = [t.view_as(t) if again else t.detach().requires_grad_(t.requires_grad) for t in ctx.saved_tensors]
        with torch.enable_grad():
            results = ctx.function(*tensors)
        pairs = [(r, bar) for r, bar in zip(results, cotangents, strict=True) if bar is not None and r.requires_grad]
        inputs = [tensor for tensor in tensors if tensor.requires_grad]
        found: Iterable[Tensor | None] = [None] * len(inputs)
        if pairs:
            ends, theirs = zip(*pairs, strict=True)
            found = torch.autograd.grad(ends, inputs, theirs, create_graph=again, allow_unused=True)
        derivatives = iter(found)
        return None, *(next(derivatives) if tensor.requires_grad else None for tensor in tensors)
