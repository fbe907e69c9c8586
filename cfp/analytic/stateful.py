"""State of objects whose training can be interrupted."""

import copy
import zlib
from typing import Any, ClassVar

import torch
from torch import Tensor


class Stateful:
    """Saves and restores attributes by name: ``parts`` that have a state of their own, and plain ``values``."""

    parts: ClassVar[tuple[str, ...]] = ()
    values: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """All that the next step depends on; tensors on the CPU."""
        state = {name: getattr(self, name).state_dict() for name in self.parts}
        return state | {name: _plain(getattr(self, name)) for name in self.values}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict` in an object made with the same options."""
        for name in self.parts:
            getattr(self, name).load_state_dict(state[name])
        for name in self.values:
            value, present = state[name], getattr(self, name)
            if isinstance(present, torch.Generator):
                present.set_state(value)
            elif isinstance(present, Tensor) and present.requires_grad:  # an optimiser holds it
                present.data.copy_(value)
            else:
                setattr(self, name, value.to(present) if isinstance(present, Tensor) else copy.copy(value))


def compress(images: Tensor) -> Tensor:
    """Bytes (n,) of uint8 images, which take about a thirtieth of the memory; on the CPU."""
    return torch.frombuffer(bytearray(zlib.compress(images.cpu().numpy().tobytes(), 1)), dtype=torch.uint8)


def decompress(content: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The images (N, *shape) that `compress` was given."""
    return torch.frombuffer(bytearray(zlib.decompress(content.numpy().tobytes())), dtype=torch.uint8).view(-1, *shape)


def _plain(value: Any) -> Any:
    if isinstance(value, torch.Generator):
        return value.get_state()
    return value.detach().cpu() if isinstance(value, Tensor) else copy.copy(value)
