"""What the launcher needs of a GPU, which tests replace: properties of the card, kernels, and launches."""

import ctypes
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch

from torchmpm.native.cuda.arguments import Kernel
from torchmpm.native.cuda.compiler import compile_kernel


class Card(NamedTuple):
    """What a launch has to keep to."""

    multiprocessors: int
    shared_bytes: int  # of a block, after asking for more than the usual 48 KB


class Launch(NamedTuple):
    """How a kernel is launched."""

    blocks: int
    threads: int  # of a block
    shared_bytes: int = 0  # of a block
    cooperative: bool = False  # all blocks are resident at once, so that they can wait for each other


@runtime_checkable
class Driver(Protocol):
    """A GPU, or what stands for one."""

    def card(self, device: torch.device) -> Card:
        """Properties of a device."""

    def load(self, kernel: Kernel, device: torch.device) -> Any:
        """A kernel that is ready for launches of as much shared memory as a block may have."""

    def resident(self, function: Any, threads: int, shared_bytes: int, device: torch.device) -> int:
        """How many blocks of a kernel the device can run at once."""

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        """Launch a kernel on the current stream of a device; the arguments are copied."""


class Cuda:
    """The driver of CUDA through NVIDIA's ``cuda-bindings``, in the context that torch made."""

    @functools.cache  # noqa: B019  there is one, for as long as the process
    def card(self, device: torch.device) -> Card:
        """See :class:`Driver`."""
        cuda = _bindings()
        names = ("MULTIPROCESSOR_COUNT", "MAX_SHARED_MEMORY_PER_BLOCK_OPTIN")
        kinds = (getattr(cuda.CUdevice_attribute, f"CU_DEVICE_ATTRIBUTE_{name}") for name in names)
        return Card(*(_checked(cuda.cuDeviceGetAttribute(kind, device.index)) for kind in kinds))

    @functools.cache  # noqa: B019
    def load(self, kernel: Kernel, device: torch.device) -> Any:
        """See :class:`Driver`; compiled for the device on first use."""
        major, minor = torch.cuda.get_device_capability(device)
        binary = compile_kernel(kernel, f"sm_{major}{minor}")
        return self.function(binary, kernel.name, device)

    def function(self, binary: bytes, name: str, device: torch.device) -> Any:
        """A function of a compiled module, as of :meth:`load`."""
        cuda = _bindings()
        library = _checked(cuda.cuLibraryLoadData(binary, None, None, 0, None, None, 0))
        function = _checked(cuda.cuLibraryGetKernel(library, name.encode()))
        attribute = cuda.CUfunction_attribute
        own = _checked(cuda.cuKernelGetAttribute(attribute.CU_FUNC_ATTRIBUTE_SHARED_SIZE_BYTES, function, device.index))
        dynamic, most = attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES, self.card(device).shared_bytes - own
        _checked(cuda.cuKernelSetAttribute(dynamic, most, function, device.index))
        return cuda.CUfunction(int(function))

    def resident(self, function: Any, threads: int, shared_bytes: int, device: torch.device) -> int:
        """See :class:`Driver`."""
        with _context(device):
            measure = _bindings().cuOccupancyMaxActiveBlocksPerMultiprocessor
            return _checked(measure(function, threads, shared_bytes)) * self.card(device).multiprocessors

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        """See :class:`Driver`."""
        pointers = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
        grid, block = (launch.blocks, 1, 1), (launch.threads, 1, 1)
        cuda, address = _bindings(), ctypes.addressof(pointers)
        with _context(device):
            stream = torch.cuda.current_stream(device).cuda_stream
            if launch.cooperative:
                start = cuda.cuLaunchCooperativeKernel
                _checked(start(function, *grid, *block, launch.shared_bytes, stream, address))
            else:
                _checked(cuda.cuLaunchKernel(function, *grid, *block, launch.shared_bytes, stream, address, 0))


@functools.cache
def _bindings() -> Any:
    from cuda.bindings import driver

    return driver


@contextmanager
def _context(device: torch.device) -> Iterator[None]:
    """Meanwhile, torch's context of a device is the thread's own; a thread that has just begun may have none."""
    cuda = _bindings()
    with torch.cuda.device(device):
        if not int(_checked(cuda.cuCtxGetCurrent())):
            _checked(cuda.cuCtxSetCurrent(_checked(cuda.cuDevicePrimaryCtxRetain(device.index))))
        yield


def _checked(result: tuple[Any, ...]) -> Any:
    """What a function of the driver returned."""
    code, *values = result
    if code != 0:
        _, text = _bindings().cuGetErrorString(code)
        raise RuntimeError(f"CUDA error: {code.name}: {text.decode()}")
    return values[0] if values else None
