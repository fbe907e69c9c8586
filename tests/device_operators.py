"""Where a function would wait for a GPU, counted on tensors of the CPU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

#: Operators that wait for the device, because the host needs a number or a size from it.
WAITS = set(
    "_local_scalar_dense is_nonzero item nonzero equal masked_select unique2 _unique2 unique_dim repeat_interleave "
    "allclose bincount".split()
)
#: Functions of torch that copy numbers of the host to the device, and methods that copy to the host and wait for it.
UPLOADS = {torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor}
DOWNLOADS = {Tensor.cpu, Tensor.numpy, Tensor.tolist, Tensor.__array__}


class DeviceOperators:
    """Records where a block waits.

    The tensors lie on the CPU, so code that asks for the device of a tensor takes another way than on CUDA. There are
    three such places around the physics: the observation, which the C++ function draws as the CUDA kernel does, in one
    call; actions of a single simulation, so count with two or more; and the check whether an action is finite, see
    ``on_a_gpu`` in test_device.py. The physics is a call into C++, which is not counted.

    Attributes:
        waits: Operators and functions that wait for the device, or copy to it from memory of the host.
    """

    def __init__(self) -> None:
        self.waits: Counter[str] = Counter()
        self._modes = (_Functions(self), _Operators(self))

    def __enter__(self) -> DeviceOperators:
        for mode in self._modes:
            mode.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for mode in reversed(self._modes):
            mode.__exit__(kind, error, at)


class _Functions(TorchFunctionMode):
    def __init__(self, record: DeviceOperators) -> None:
        super().__init__()
        self.record = record

    def __torch_function__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        host = isinstance(kwargs.get("device"), str)  # "cpu" by name stays on the host; else it is a tensor's device
        given = isinstance(args[0], Tensor) if args else False
        if func in DOWNLOADS or (func in UPLOADS and not host and not (given and func is torch.as_tensor)):
            self.record.waits[f"torch.{func.__name__}"] += 1
        return func(*args, **kwargs)


class _Operators(TorchDispatchMode):
    def __init__(self, record: DeviceOperators) -> None:
        super().__init__()
        self.record = record

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        name = func.overloadpacket.__name__
        if name in WAITS or (name.startswith("index") and _masked(args)):
            self.record.waits[name] += 1
        return func(*args, **(kwargs or {}))


def _masked(args: Sequence[Any]) -> bool:
    """Whether an index is a mask, whose entries the host must count."""
    indices = args[1] if len(args) > 1 and isinstance(args[1], (list, tuple)) else ()
    return any(isinstance(index, Tensor) and index.dtype == torch.bool for index in indices)
