"""What a checkpoint keeps of an object, so that a run goes on as if it had not been interrupted."""

from __future__ import annotations

import copy
import zlib
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor


class Resumable:
    """Base class with a `state_dict` and a `load_state_dict` that save and restore attributes by name.

    Attributes:
        parts: Names of the attributes that have these two methods themselves, such as modules and optimisers.
        values: Names of the attributes that are tensors, generators of torch, or plain values.
    """

    parts: ClassVar[tuple[str, ...]] = ()
    values: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """Return the attributes by name; tensors are on the CPU."""
        state = {name: getattr(self, name).state_dict() for name in self.parts}
        return state | {name: _plain(getattr(self, name)) for name in self.values}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, in an object that was made with the same options.

        Args:
            state: The attributes by name.
        """
        for name in self.parts:
            getattr(self, name).load_state_dict(state[name])
        for name in self.values:
            value, present = state[name], getattr(self, name)
            if isinstance(present, torch.Generator):
                restore_generator(present, value)
            elif isinstance(present, Tensor) and present.requires_grad:  # an optimiser holds it
                present.data.copy_(value)
            else:
                setattr(self, name, value.to(present) if isinstance(present, Tensor) else copy.copy(value))


def _plain(value: Any) -> Any:
    if isinstance(value, torch.Generator):
        return value.get_state()
    return value.detach().cpu() if isinstance(value, Tensor) else copy.copy(value)


def generator_state(generator: torch.Generator | np.random.Generator) -> Any:
    """The state of a generator, for `restore_generator`."""
    return generator.get_state() if isinstance(generator, torch.Generator) else generator.bit_generator.state


def restore_generator(generator: torch.Generator | np.random.Generator, state: Any) -> None:
    """Set a generator to a state; to that of a generator of another kind only in so far as it is seeded with it.

    So a run that goes on on another kind of device is as random as before, but not the same to the last bit.
    """
    if isinstance(generator, np.random.Generator):
        if isinstance(state, dict):
            generator.bit_generator.state = state
        else:
            generator.bit_generator.state = type(generator.bit_generator)(_digest(state)).state
    elif isinstance(state, Tensor) and len(state) == len(generator.get_state()):
        generator.set_state(state)
    else:
        generator.manual_seed(_digest(state))


def _digest(state: Any) -> int:
    """A seed that depends on all of a generator's state."""
    return zlib.crc32(state.numpy().tobytes() if isinstance(state, Tensor) else repr(state).encode())


def compress(images: Tensor) -> Tensor:
    """Bytes (n,) of uint8 images, which take about a thirtieth of the memory; on the CPU."""
    return torch.frombuffer(bytearray(zlib.compress(images.cpu().numpy().tobytes(), 1)), dtype=torch.uint8)


def decompress(content: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The images (N, *shape) that `compress` was given."""
    return torch.frombuffer(bytearray(zlib.decompress(content.numpy().tobytes())), dtype=torch.uint8).view(-1, *shape)
