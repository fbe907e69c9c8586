"""Arguments of :class:`dittogym.TorchEnv`: what they may be, and what they stand for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral
from typing import Any, TypeVar

import torch
from torch import Tensor

from dittogym.spec import CONTROL_STEP, TaskSpec
from torchmpm import checks
from torchmpm.tree import transforming

Value = TypeVar("Value")
DTYPES = {"float32": torch.float32, "float64": torch.float64}
#: Substeps in a control step, far above any use.
MOST_SUBSTEPS = 1_000_000
RESET_OPTIONS = ("physics", "positions", "reset_mask")


def choice(name: str, given: Any, choices: Mapping[Any, Value]) -> Value:
    """The value that a choice maps to; a ValueError if it is none of the ``choices``."""
    if given not in tuple(choices):
        raise ValueError(f"{name} must be one of {tuple(choices)}, got {given!r}")
    return choices[given]


def find_resolution(spec: TaskSpec, resolution: str | int, name: str = "resolution") -> int:
    """Action cells per axis; ``name`` is that of the argument."""
    named = {"coarse": spec.coarse, "fine": spec.fine}
    size: Any = named.get(resolution) if isinstance(resolution, str) else resolution
    if isinstance(size, bool) or not isinstance(size, Integral) or not 1 <= int(size) <= spec.patch:
        raise ValueError(f"{name} must be 'coarse', 'fine' or 1 to {spec.patch}, got {resolution!r}")
    return int(size)


def find_substeps(dt: float, substeps: int | None) -> int:
    """Substeps of ``dt`` s in a control step; ``None`` stands for as many as take :data:`CONTROL_STEP`."""
    checks.number("dt", dt, above=0.0)
    if substeps is not None:
        return checks.whole("substeps", substeps, 1, MOST_SUBSTEPS)
    ratio = CONTROL_STEP / dt
    count = round(ratio) if ratio <= MOST_SUBSTEPS else 0
    if not math.isclose(count * dt, CONTROL_STEP):
        problem = f"dt must divide the control step of {CONTROL_STEP} s if substeps is not given, got {dt}"
        raise ValueError(f"{problem}; there may be at most {MOST_SUBSTEPS} substeps")
    return count


def find_mask(name: str, given: Any, num_envs: int, device: torch.device) -> Tensor:
    """A mask of elements, (B,) bool; ``None`` stands for all."""
    if given is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    try:
        mask = torch.as_tensor(given, device=device)
    except (TypeError, ValueError, RuntimeError):
        mask = None
    if mask is None or mask.dtype != torch.bool or mask.shape != (num_envs,):
        raise ValueError(f"{name} must be bool of shape ({num_envs},), got {given!r}")
    return mask


def find_device(device: str | torch.device) -> torch.device:
    """The device that the option ``device`` names."""
    try:
        found = torch.device(device)
    except (TypeError, RuntimeError):
        found = None
    if found is None or found.type not in ("cpu", "cuda"):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {device!r}")
    count = torch.cuda.device_count() if found.type == "cuda" else 1
    if (found.index or 0) >= count:
        raise ValueError(f"device must be available, got {device!r}, but torch finds {count} of this kind")
    return found


def reset_options(options: Any) -> dict[str, Any]:
    """The options of a reset; the allowed names are :data:`RESET_OPTIONS`."""
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a mapping that may hold {', '.join(RESET_OPTIONS)}, got {options!r}")
    if unknown := options.keys() - set(RESET_OPTIONS):
        raise ValueError(f"options may hold {', '.join(RESET_OPTIONS)}, got {', '.join(map(repr, unknown))}")
    return dict(options)


def refuse_transforms(name: str) -> None:
    """Refuse to keep tensors that end with the transform of ``torch.func`` that they were made in."""
    if transforming():
        raise RuntimeError(
            f"{name} must not be used under a transform of torch.func, whose tensors the environment would keep: use "
            "dittogym.core.reset and dittogym.core.step with its model, which keep nothing"
        )


def refuse_backward(name: str) -> None:
    """Refuse to advance a state in a backward pass, where a checkpoint repeats a call from the state after it."""
    if torch._C._current_graph_task_id() != -1:
        raise RuntimeError(
            f"{name} must not be called in a backward pass, as torch.utils.checkpoint does to repeat a step: use "
            "dittogym.core.step with its model, which keeps nothing"
        )


def check_action(action: Tensor, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """The action as a tensor of this type and device, if it is a finite floating point tensor of this shape."""
    if not isinstance(action, Tensor) or not action.is_floating_point():
        kind = action.dtype if isinstance(action, Tensor) else type(action).__name__
        hint = "" if isinstance(action, Tensor) else "; torch.as_tensor(action) makes a tensor of an array"
        raise ValueError(f"action must be a floating point tensor, got {kind}{hint}")
    checks.tensor("action", action)
    if action.is_meta:
        raise ValueError("action must hold numbers, got a tensor on the device meta")
    if tuple(action.shape) != shape:
        raise ValueError(
            f"action must have shape {shape}, got {tuple(action.shape)}; the option resolution of the environment sets "
            "its last two numbers"
        )
    action = action.to(device, dtype)
    # A sum that is finite spares the test of every entry; one of finite entries may overflow.
    if not math.isfinite(float(action.detach().sum())) and (wrong := int((~torch.isfinite(action)).sum())):
        raise ValueError(f"action must be finite, got {wrong} entries that are NaN or infinite")
    return action
