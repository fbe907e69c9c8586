"""Checks of arguments: every message names the argument, what it must be, and what was given."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import torch
from torch import Tensor

from torchmpm.tree import transforming

#: Substeps between checkpoints; ``None``: no checkpoints; ``"auto"`` leaves it to the backend.
Segment: TypeAlias = int | Literal["auto"] | None


def whole(name: str, value: Any, least: int, most: int | None = None) -> int:
    """A whole number, not a bool, from ``least`` to ``most`` as a Python integer, or else a ValueError."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{name} must be a whole number, got {value!r}")
    number = int(value)
    if number < least:
        raise ValueError(f"{name} must {_at_least(least)}, got {number}")
    if most is not None and number > most:
        raise ValueError(f"{name} must be at most {most}, got {number}")
    return number


def number(
    name: str, value: Any, *, least: float | None = None, above: float | None = None, most: float | None = None
) -> None:
    """Raise a ValueError unless this is a finite number, at least ``least``, above ``above`` and at most ``most``."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{name} must be a number, got {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"{name} must be finite, got {value}")
    if least is not None and not float(value) >= least:
        raise ValueError(f"{name} must {_at_least(least)}, got {value}")
    if above is not None and not float(value) > above:
        raise ValueError(f"{name} must be {'positive' if above == 0 else f'above {above}'}, got {value}")
    if most is not None and not float(value) <= most:
        raise ValueError(f"{name} must be at most {most:g}, got {value}")


def value(name: str, given: Any, *, least: float | None = None, above: float | None = None) -> None:
    """As :func:`number`, or a tensor, whose numbers are left to :func:`entries`."""
    if isinstance(given, Tensor):
        tensor(name, given)
        if given.is_complex() or given.dtype == torch.bool or not given.numel():
            raise ValueError(f"{name} must be real and not empty, got {given.dtype} of shape {tuple(given.shape)}")
        return
    if not isinstance(given, Real):
        raise ValueError(f"{name} must be a number or a tensor, got {given!r}")
    number(name, given, least=least, above=above)


def entries(
    name: str, given: Any, *, least: float | None = None, above: float | None = None, below: float | None = None
) -> None:
    """As :func:`value`, and all numbers of a tensor must be finite and in range, and below ``below`` where it is given.

    Under ``torch.func`` and ``torch.compile``, where nothing can depend on them, they are not looked at.
    """
    value(name, given, least=least, above=above)
    if isinstance(given, Tensor):
        if not (transforming() or torch.compiler.is_compiling() or given.is_meta):
            for extreme in torch.aminmax(given.detach()):  # NaN if one is among them
                entries(name, extreme.item(), least=least, above=above, below=below)
        return
    if below is not None and not given < below:
        raise ValueError(f"{name} must be below {below}, got {given}")


def segment(given: Any) -> Segment:
    """A :data:`Segment` with Python's integer, or else a ValueError."""
    if given is None or (isinstance(given, str) and given == "auto"):
        return cast(Segment, given)
    if isinstance(given, bool) or not isinstance(given, Integral) or int(given) < 1:
        raise ValueError(f"segment must be at least 1, None or 'auto', got {given!r}")
    return int(given)


def tensor(name: str, given: Any) -> None:
    """Raise a TypeError unless this is a dense tensor."""
    instance(name, given, Tensor)
    if given.layout is not torch.strided:
        raise TypeError(f"{name} must be a dense Tensor, got one of layout {given.layout}")


def points(name: str, given: Any) -> None:
    """Raise a ValueError unless this is an array (N, 2) of points of the unit square."""
    array = isinstance(given, np.ndarray)
    shaped = array and given.shape[1:] == (2,) and given.dtype.kind in "fiu"
    if not shaped or not ((given >= 0) & (given <= 1)).all():
        found = f"an array of {given.dtype} of shape {given.shape}" if array else _brief(given)
        raise ValueError(f"{name} must be an array (N, 2) of numbers from 0 to 1, got {found}")


def pair(name: str, given: Any, *, above: float | None = None) -> None:
    """Raise a ValueError unless these are two finite numbers, x and y, above ``above``."""
    listed = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(listed, Sequence) or isinstance(listed, str) or len(listed) != 2:
        raise ValueError(f"{name} must be two numbers (x, y), got {given!r}")
    for axis, each in zip("xy", listed, strict=True):
        number(f"{name} {axis}", each, above=above)


def instance(name: str, given: Any, kind: type) -> None:
    """Raise a TypeError unless an object is of a type."""
    if not isinstance(given, kind) or isinstance(given, type):
        raise TypeError(f"{name} must be of type {kind.__name__}, got {_brief(given)}")


def instances(name: str, given: Any, kind: type) -> None:
    """Raise a TypeError unless this is a sequence of objects of one type."""
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise TypeError(f"{name} must be a sequence of {kind.__name__}, got {_brief(given)}")
    for index, item in enumerate(given):
        instance(f"{name}[{index}]", item, kind)


def flag(name: str, given: Any) -> None:
    """Raise a ValueError unless this is True or False; any string, even "no", would count as true."""
    if not isinstance(given, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {given!r}")


def _at_least(least: float) -> str:
    return f"be at least {least}" if least else "not be negative"


def _brief(given: Any) -> str:
    """What was given, in few words: values that show themselves in a line, else the type."""
    return repr(given) if isinstance(given, str | int | float | type | None) else type(given).__name__
