"""Saved states of environments, and whether one fits."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dittogym.core import EnvState, Model
from dittogym.rewards import Features
from torchmpm import tree


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A saved state of an environment, see :meth:`dittogym.TorchEnv.save`; ``torch.save`` writes it to a file.

    Attributes:
        state: Everything that moves.
        observation: (B, 3, 64, 64) uint8, the last observation.
        constants: What an environment that loads it must have in common: task, numbers of particles, substeps, dtype,
            device and the like, by name, as text that is equal for equal values.
    """

    state: EnvState
    observation: Tensor
    constants: Mapping[str, str]

    def __getitem__(self, index: int) -> Snapshot:
        """Select one simulation of the batch, a snapshot that can be loaded into all elements of an environment.

        Raises:
            IndexError: There is no such simulation.
        """
        return Snapshot(tree.map(lambda value: value[[index]], self.state), self.observation[[index]], self.constants)

    def __repr__(self) -> str:
        """Task and state; the rest would fill pages."""
        return f"{type(self).__name__}({self.constants['task']}, {self.state!r})"


torch.serialization.add_safe_globals([Snapshot, EnvState, Features])  # tensors, numbers and a name


def constants_of(model: Model, like: Tensor) -> dict[str, str]:
    """What determines an episode besides its state, by name, as strings that are equal for equal values.

    Tensors that require gradients are identified by their shape alone, because training changes their values.

    Args:
        model: The task.
        like: Gives dtype and device.
    """
    spec = model.spec
    values = {each.name: getattr(spec, each.name) for each in fields(spec) if each.name not in ("coarse", "fine")}
    own = {"particles": model.counts, "substeps": model.substeps, "dt": model.solver.dt}
    own |= {"dtype": like.dtype, "device": like.device}
    return {name: _as_text(value) for name, value in ({"task": values.pop("name")} | own | values).items()}


def _as_text(value: Any) -> str:
    if is_dataclass(value) and not isinstance(value, type):
        return _as_text([type(value).__name__, *(getattr(value, each.name) for each in fields(value))])
    if isinstance(value, Mapping):
        return _as_text(sorted(value.items()))
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_as_text, value))}]"
    if isinstance(value, Tensor):
        return f"{tuple(value.shape)} learned" if value.requires_grad else _as_text(value.detach().cpu().numpy())
    if isinstance(value, np.ndarray):
        return f"{tuple(value.shape)} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, functools.partial):
        return _as_text([value.func, value.args, value.keywords])
    if callable(value):
        return str(getattr(value, "__qualname__", type(value).__name__))
    text = repr(value.item() if isinstance(value, np.generic) else value)
    return type(value).__name__ if " at 0x" in text else text  # an address differs in another process


def check_snapshot(snapshot: Snapshot, constants: Mapping[str, str], num_envs: int) -> None:
    """Refuse a snapshot that does not fit an environment with these constants and ``num_envs`` simulations."""
    if (size := len(snapshot.state.steps)) not in (1, num_envs):
        raise ValueError(f"snapshot must hold 1 simulation or as many as num_envs, {num_envs}, got {size}")
    if others := [name for name, text in constants.items() if snapshot.constants.get(name) != text]:
        raise ValueError(f"snapshot must be of an environment with the same {', '.join(others)}, got another")
