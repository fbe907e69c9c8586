"""Replays a function of tensors as a CUDA graph: one launch in place of one for each of its operations.

Recording runs the function on buffers that stay; a replay copies new arguments there, repeats what was launched, and
copies the results out. So the function must launch the same for all arguments of the same sizes, and not wait for
numbers from the device.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree

Result = TypeVar("Result")
#: Calls before the recording, which make and load what the function needs only once.
WARM_UP = 2
_logger = logging.getLogger(__name__)


class CudaGraph:
    """A recording of launches on a device."""

    def __init__(self, device: torch.device) -> None:
        self._device, self._graph, self._freed = device, torch.cuda.CUDAGraph(), torch.cuda.Event()

    def record(self, function: Callable[[], Result]) -> Result:
        """Record what a function launches; its result holds numbers only after a replay."""
        with torch.cuda.device(self._device):
            stream = torch.cuda.current_stream()
            try:
                own = torch.cuda.Stream(self._device)  # by default torch has one for all devices
                with torch.cuda.graph(self._graph, stream=own, capture_error_mode="thread_local"):
                    return function()
            finally:
                torch.cuda.set_stream(stream)  # torch stays on its own where the recording fails

    def replay(self) -> None:
        """Launch it again on the current stream."""
        with torch.cuda.device(self._device):
            self._graph.replay()

    def wait(self) -> None:
        """Let the current stream wait until the buffers are free."""
        torch.cuda.current_stream(self._device).wait_event(self._freed)

    def free(self) -> None:
        """Say that they are free once the current stream has come this far."""
        self._freed.record(torch.cuda.current_stream(self._device))


class Replayed:
    """Calls a function, and from the third call with arguments of the same sizes on replays it.

    Where it cannot be recorded, or the first replay comes to other numbers than the function, the function is called,
    and the reason is logged once.

    Args:
        function: Takes and returns trees of tensors (see :mod:`torchmpm.tree`); all else in them must stay equal.
        graph: Makes a recording on a device, as :class:`CudaGraph` does.
    """

    def __init__(self, function: Callable[..., Any], graph: Callable[[torch.device], Any] = CudaGraph) -> None:
        self.function, self.graph = function, graph
        self.failure: str | None = None
        self._seen = 0
        self._key: Any = None
        self._recording: Recording | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy records anew."""
        return Replayed, (self.function, self.graph)

    def __call__(self, *arguments: Any) -> Any:
        """The result for these arguments, without gradients, in tensors that belong to the caller."""
        if self.failure is not None:
            return self.function(*arguments)
        entries, structure = pytree.tree_flatten(arguments)
        key = structure, tuple(map(_kind, entries))
        if key != self._key:
            self._seen, self._key, self._recording = 0, key, None
        if self._recording is None:
            self._seen += 1
            if self._seen <= WARM_UP:
                return self.function(*arguments)
            return self._record(entries, structure)
        return self._recording(entries)

    def _record(self, entries: Sequence[Any], structure: pytree.TreeSpec) -> Any:
        with _Constants() as constants:
            result = self.function(*pytree.tree_unflatten(entries, structure))
        theirs = {id(entry) for entry in (*entries, *pytree.tree_leaves(result))}
        kept = [tensor for tensor in constants.alive() if id(tensor) not in theirs]
        try:
            recording = Recording(self.function, self.graph, entries, structure, kept)
            if not _same(recording(entries), result):
                raise ValueError("a replay came to other numbers")
            self._recording = recording
        except (RuntimeError, ValueError) as error:
            self.failure = str(error)
            _logger.warning("operations are launched one by one: they cannot be recorded (%s)", error)
        return result


class Recording:
    """A function on buffers of its own, as :class:`Replayed` uses it.

    The arguments are given as flat ``entries`` and their ``structure``; ``constants`` are tensors whose memory the
    launches read besides them.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        graph: Callable[[torch.device], Any],
        entries: Sequence[Any],
        structure: pytree.TreeSpec,
        constants: Sequence[Tensor],
    ) -> None:
        tensors = [entry for entry in entries if isinstance(entry, Tensor)]
        with torch.inference_mode(False), torch.no_grad():
            self.inputs = _copied(tensors)
            buffers = iter(self.inputs)
            filled = [next(buffers) if isinstance(entry, Tensor) else entry for entry in entries]
            self.graph, self.constants = graph(tensors[0].device), constants
            result = self.graph.record(lambda: function(*pytree.tree_unflatten(filled, structure)))
        leaves, self.structure = pytree.tree_flatten(result)
        # What the function passes on is found among the arguments.
        place = {id(buffer): k for k, buffer in enumerate(self.inputs)}
        made = {id(leaf): leaf for leaf in leaves if isinstance(leaf, Tensor) and id(leaf) not in place}
        self.outputs = list(made.values())
        place |= {key: len(self.inputs) + k for k, key in enumerate(made)}
        self.found = [(place[id(leaf)], None) if isinstance(leaf, Tensor) else (None, leaf) for leaf in leaves]
        self.graph.free()

    def __call__(self, entries: Sequence[Any]) -> Any:
        """The result for arguments of the same kinds."""
        given = [entry.detach() for entry in entries if isinstance(entry, Tensor)]
        with torch.no_grad():
            self.graph.wait()
            _copy(self.inputs, given)
            self.graph.replay()
            tensors = given + _copied(self.outputs)
            self.graph.free()
        leaves = [leaf if k is None else tensors[k] for k, leaf in self.found]
        return pytree.tree_unflatten(leaves, self.structure)


class _Constants(TorchFunctionMode):
    """Collects the tensors that a block touches and that outlive it."""

    def __init__(self) -> None:
        super().__init__()
        self._touched: dict[int, weakref.ref[Tensor]] = {}

    def __torch_function__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        found = pytree.tree_leaves((args, kwargs))
        self._touched |= {id(entry): weakref.ref(entry) for entry in found if isinstance(entry, Tensor)}
        return func(*args, **(kwargs or {}))

    def alive(self) -> list[Tensor]:
        """Those that still exist."""
        return [tensor for tensor in (reference() for reference in self._touched.values()) if tensor is not None]


def _kind(entry: Any) -> Any:
    """What must stay the same about an argument."""
    if isinstance(entry, Tensor):
        return entry.shape, entry.dtype, entry.device
    return entry


def _copied(tensors: Sequence[Tensor]) -> list[Tensor]:
    copies = [torch.empty_like(tensor) for tensor in tensors]
    _copy(copies, tensors)
    return copies


def _copy(to: Sequence[Tensor], tensors: Sequence[Tensor]) -> None:
    """Copy tensors in one launch for each dtype."""
    for dtype in {tensor.dtype for tensor in tensors}:
        pairs = [(a, b) for a, b in zip(to, tensors, strict=True) if b.dtype == dtype]
        torch._foreach_copy_([a for a, _ in pairs], [b for _, b in pairs])


def _same(tree: Any, other: Any) -> bool:
    """Whether all numbers of two trees are the same; NaN is."""
    pairs = zip(pytree.tree_leaves(tree), pytree.tree_leaves(other), strict=True)
    return all(bool(((a == b) | ((a != a) & (b != b))).all()) for a, b in pairs if isinstance(a, Tensor))
