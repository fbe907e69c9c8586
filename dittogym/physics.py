"""Constants of the matter that may differ between the simulations of a batch (domain randomisation)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import torch
from torch import Tensor

from dittogym.spec import TaskSpec
from torchmpm.state import choose

#: Values by name, (B,) each; ``gravity`` (B, 2).
Physics: TypeAlias = Mapping[str, Tensor]

#: What can be set: Lame parameters of the robot and of objects without a material of their own, Pa; yield stress and
#: muscle limit of the robot, Pa; gravity, m/s^2; and a factor on the mass of all particles.
NAMES = ("mu", "lam", "yield_stress", "max_actuation", "gravity", "mass")
_POSITIVE = ("mu", "mass")


def defaults(spec: TaskSpec, like: Tensor) -> dict[str, Tensor]:
    """The task's own values for B simulations, B the length of ``like``."""
    own = {name: getattr(spec, name) for name in NAMES if name != "mass"} | {"mass": 1.0}
    return {name: _expanded(like.new_tensor(value), name, len(like)) for name, value in own.items()}


def physics_values(given: Any, batch: int, like: Tensor) -> dict[str, Tensor]:
    """Check what a user asks for and bring it to one value per simulation; gradients flow through.

    Args:
        given: Mapping from :data:`NAMES` to a number, or a tensor or array of shape () or (B,); for ``gravity`` of
            shape (2,) or (B, 2).
        batch: B.
        like: Gives dtype and device.

    Raises:
        ValueError: Not a mapping, an unknown name, a wrong shape, or values that are not finite or have a wrong sign.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"physics must be a mapping from {', '.join(NAMES)} to values, got {type(given).__name__}")
    values = {}
    for name, value in given.items():
        if name not in NAMES:
            raise ValueError(f"physics may hold {', '.join(NAMES)}, got {name!r}")
        try:
            tensor = torch.as_tensor(value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"physics[{name!r}] must be numbers, got {value!r}") from error
        if tensor.is_complex():
            raise ValueError(f"physics[{name!r}] must be real, got {tensor.dtype}")
        tensor = tensor.to(like)
        own = (2,) if name == "gravity" else ()
        if tuple(tensor.shape) not in (own, (batch, *own)):
            raise ValueError(f"physics[{name!r}] must have shape {own} or {(batch, *own)}, got {tuple(tensor.shape)}")
        low = -torch.inf if name == "gravity" else 0.0
        allowed = torch.isfinite(tensor) & ((tensor > low) if name in _POSITIVE else (tensor >= low))
        if not bool(allowed.all()):
            kind = "finite" + (", positive" if name in _POSITIVE else "" if name == "gravity" else ", not negative")
            raise ValueError(f"physics[{name!r}] must be {kind}, got {tensor.detach()[~allowed].flatten()[0].item()}")
        values[name] = _expanded(tensor, name, batch)
    return values


def merged(spec: TaskSpec, old: Physics, new: Physics, mask: Tensor, like: Tensor) -> dict[str, Tensor]:
    """``new`` where ``mask`` (B,) holds, ``old`` elsewhere; the task's own value where one of them has none."""
    if bool(mask.all()):
        return dict(new)
    own = defaults(spec, like)
    names = [name for name in NAMES if name in old or name in new]
    return {name: choose(mask, new.get(name, own[name]), old.get(name, own[name])) for name in names}


def _expanded(value: Tensor, name: str, batch: int) -> Tensor:
    return value.expand(batch, 2) if name == "gravity" else value.expand(batch)
