"""Options, such as bodies and conditions, as values that JSON can hold, for Gymnasium's ``EnvSpec.to_json``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from typing import Any

import numpy as np
import torch

from dittogym.bodies.shapes import Disc, Figure, Lattice, Rectangle
from dittogym.conditions import Conditions
from dittogym.geometry import Box, Obstacle
from dittogym.spec import BodySpec
from torchmpm import Elastic, Snow, VelocityRule, VonMises

#: What becomes a dictionary with the name of its class under ``"kind"``.
KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (BodySpec, Disc, Rectangle, Lattice, Figure, Elastic, Snow, VonMises, Obstacle, Box, VelocityRule)
}


def to_values(value: Any) -> Any:
    """An option of an environment as values for JSON; what JSON can hold already, and unknown objects, as they are."""
    kind = type(value)
    if isinstance(value, Conditions):
        return to_values(vars(value))
    if isinstance(value, dict):
        return {name: to_values(each) for name, each in value.items()}
    if KINDS.get(kind.__name__) is kind:
        named = {each.name: to_values(getattr(value, each.name)) for each in fields(value)}
        return {"kind": kind.__name__, **named}
    if isinstance(value, list | tuple):
        return [to_values(each) for each in value]
    if isinstance(value, torch.dtype | torch.device | os.PathLike):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):  # such as a mode of autoreset
        return value.value
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.kind == "u" and value.shape[1:] != (2,):  # a picture; lists of whole numbers are outlines
        value = (value // 257 if value.dtype == np.uint16 else value) / 255
    return value.tolist()


def from_values(values: Any) -> Any:
    """A body or an obstacle from what :func:`to_values` and JSON leave of it; anything else as it is.

    Raises:
        ValueError: It is a mapping of another kind.
    """
    if isinstance(values, list):
        return tuple(from_values(each) for each in values)
    if not isinstance(values, Mapping):
        return values
    kind = values.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"kind of a body or an obstacle must be one of {', '.join(KINDS)}, got {dict(values)!r}")
    made = {name: from_values(value) for name, value in values.items() if name != "kind"}
    if "mask" in made:
        made["mask"] = np.array(made["mask"], dtype=bool)
    return KINDS[kind](**made)
