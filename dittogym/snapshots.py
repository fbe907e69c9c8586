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


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A saved state of an environment, see :meth:`dittogym.TorchEnv.save`.

    Attributes:
        kind: See :func:`kind_of`.
        state: Everything that moves.
        observation: (B, 3, 64, 64) uint8.
        constants: What else the environment that loads it must share, see :func:`constants_of`.
    """

    kind: tuple[str, tuple[int, ...], tuple[float, ...]]
    state: EnvState
    observation: Tensor
    constants: Mapping[str, str]


torch.serialization.add_safe_globals([Snapshot, EnvState, Features])  # tensors, numbers and a name


def kind_of(model: Model) -> tuple[str, tuple[int, ...], tuple[float, ...]]:
    """The task's name, the particles of each body, and the full-size particles that one of them stands for."""
    return model.spec.name, model.camera.counts, model.camera.particle_weight


def constants_of(model: Model) -> dict[str, str]:
    """By name what determines an episode besides its state, as texts that are equal for equal values.

    Tensors that require gradients are identified by their shape alone, because training changes their values.
    """
    names = [each.name for each in fields(model.spec) if each.name not in ("coarse", "fine")]
    spec = {name: _as_text(getattr(model.spec, name)) for name in names}
    return {**spec, "substeps": str(model.substeps), "dt": str(model.solver.dt)}


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
    text = repr(value)
    return type(value).__name__ if " at 0x" in text else text  # an address differs in another process


def check_snapshot(snapshot: Snapshot, model: Model, constants: Mapping[str, str], like: Tensor) -> None:
    """Refuse a snapshot that does not fit the model and B simulations of dtype and device of ``like`` (B,)."""
    x, size = snapshot.state.particles.x, len(snapshot.state.steps)
    if size not in (1, len(like)):
        raise ValueError(f"snapshot must hold 1 simulation or as many as num_envs, {len(like)}, got {size}")
    own, theirs = (*kind_of(model), like.dtype, like.device), (*snapshot.kind, x.dtype, x.device)
    names = "task", "particles", "particle weights", "dtype", "device"
    for name, mine, given in zip(names, own, theirs, strict=True):
        if mine != given:
            raise ValueError(f"snapshot must have the environment's {name}, {mine}, got {given}")
    if others := [name for name, text in constants.items() if snapshot.constants.get(name) != text]:
        raise ValueError(f"snapshot must be of an environment with the same {', '.join(others)}, got another")
