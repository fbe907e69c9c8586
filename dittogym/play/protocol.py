"""What page and server tell each other: JSON messages from the page, and binary frames to it."""

from __future__ import annotations

import base64
import binascii
import json
import reprlib
import struct
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any, ClassVar, NoReturn

import numpy as np

from torchmpm import checks

#: Largest size of a message from the page, bytes.
LARGEST_MESSAGE = 2**18
#: Pixels per side of the largest drawing.
LARGEST_DRAWING = 256
#: Positions are sent as 16 bits per coordinate, within this range around the window's origin, m.
LOW, HIGH = -0.5, 1.5
#: Stands for a particle that is elsewhere.
HIDDEN = 65535
#: Numbers at the head of a frame: whole ones, then floating point ones; see :func:`pack_frame`.
HEAD = struct.Struct("<5I8f")


def one_of(name: str, given: Any, allowed: Sequence[Any]) -> None:
    """Refuse what is not one of a few values."""
    if not isinstance(given, str | None) or given not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {reprlib.repr(given)}")


class Message:
    """Base class of what the page may send; fields are checked when a message is made."""


@dataclass(frozen=True)
class Play(Message):
    """Let time pass or stop it."""

    playing: bool

    def __post_init__(self) -> None:
        checks.flag("playing", self.playing)


@dataclass(frozen=True)
class Speed(Message):
    """Simulated seconds per second."""

    factor: float

    def __post_init__(self) -> None:
        checks.number("factor", self.factor, least=0.01)
        if self.factor > 16:
            raise ValueError(f"factor must be at most 16, got {self.factor}")


@dataclass(frozen=True)
class Step(Message):
    """Stop, and take one control step."""


@dataclass(frozen=True)
class Reset(Message):
    """Start a new episode; with a seed the particles are drawn anew."""

    seed: int | None = None

    def __post_init__(self) -> None:
        if self.seed is not None:
            checks.whole("seed", self.seed, 0, 2**32 - 1)


@dataclass(frozen=True)
class Hand(Message):
    """What the pointer does at a point of the world, m; without a tool it lets go. Frames echo the last ``id``."""

    tool: str | None
    x: float = 0.0
    y: float = 0.0
    id: int = 0

    tools: ClassVar = ("pull", "contract", "expand", None)

    def __post_init__(self) -> None:
        one_of("tool", self.tool, self.tools)
        for name in ("x", "y"):
            checks.number(name, getattr(self, name))
        checks.whole("id", self.id, 0, 2**32 - 1)


@dataclass(frozen=True)
class Paint(Message):
    """Set entries of the painted action image: ``cells`` are pairs (row, column) of the muscles in one direction."""

    muscles: str
    value: float
    cells: list[list[int]]

    directions: ClassVar = {"both": slice(0, 2), "horizontal": slice(0, 1), "vertical": slice(1, 2)}

    def __post_init__(self) -> None:
        one_of("muscles", self.muscles, tuple(self.directions))
        checks.number("value", self.value, least=-1.0)
        if self.value > 1:
            raise ValueError(f"value must be at most 1, got {self.value}")
        if not isinstance(self.cells, list) or not 0 < len(self.cells) <= 4096:
            raise ValueError(f"cells must be 1 to 4096 pairs (row, column), got {reprlib.repr(self.cells)}")
        for cell in self.cells:
            if not isinstance(cell, list) or len(cell) != 2:
                raise ValueError(f"cells must be pairs (row, column), got {reprlib.repr(cell)}")
            for name, index in zip(("row", "column"), cell, strict=True):
                checks.whole(name, index, 0)


@dataclass(frozen=True)
class Clear(Message):
    """Wipe the painted action image."""


@dataclass(frozen=True)
class Wave(Message):
    """Let waves of contraction travel through the robot, or stop them."""

    direction: str | None

    directions: ClassVar = ("left", "right", "up", "down", None)

    def __post_init__(self) -> None:
        one_of("direction", self.direction, self.directions)


@dataclass(frozen=True)
class Policy(Message):
    """Hand the muscles over to a policy by its name, or take them back."""

    name: str | None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str | None):
            raise ValueError(f"name must be the name of a policy or null, got {reprlib.repr(self.name)}")


@dataclass(frozen=True)
class Colour(Message):
    """Colour the particles by a quantity."""

    by: str


@dataclass(frozen=True)
class Matter(Message):
    """Factors on the task's own stiffness and yield stress, and gravity downwards, m/s^2."""

    stiffness: float
    yield_stress: float
    gravity: float

    def __post_init__(self) -> None:
        checks.number("stiffness", self.stiffness, above=0.0)
        checks.number("yield_stress", self.yield_stress, least=0.0)
        checks.number("gravity", self.gravity)
        if not abs(self.gravity) <= 100:
            raise ValueError(f"gravity must be between -100 and 100, got {self.gravity}")


@dataclass(frozen=True)
class Save(Message):
    """Send a file: ``"moment"`` or ``"actions"``."""

    what: str

    files: ClassVar = ("moment", "actions")

    def __post_init__(self) -> None:
        one_of("what", self.what, self.files)


@dataclass(frozen=True)
class Back(Message):
    """Go back to the moment that was saved last."""


@dataclass(frozen=True)
class Draw(Message):
    """A drawn robot or target: a square picture, one byte per pixel in base64, row 0 at the top."""

    what: str
    size: int
    pixels: str

    kinds: ClassVar = ("body", "target")

    def __post_init__(self) -> None:
        one_of("what", self.what, self.kinds)
        checks.whole("size", self.size, 8, LARGEST_DRAWING)
        self.picture()

    def picture(self) -> np.ndarray:
        """The drawing (size, size) uint8."""
        try:
            content = base64.b64decode(self.pixels, validate=True)
        except (TypeError, ValueError, binascii.Error) as error:
            raise ValueError(f"pixels must be base64, got {reprlib.repr(self.pixels)}") from error
        if len(content) != self.size**2:
            raise ValueError(f"pixels must be {self.size**2} bytes, got {len(content)}")
        return np.frombuffer(content, np.uint8).reshape(self.size, self.size)


@dataclass(frozen=True)
class Seen(Message):
    """The page has drawn a frame; no more than a few are on their way to it."""

    frame: int

    def __post_init__(self) -> None:
        checks.whole("frame", self.frame, 0)


MESSAGES = {kind.__name__.lower(): kind for kind in Message.__subclasses__()}


def parse(text: str) -> Message:
    """The message that a text holds.

    Raises:
        ValueError: It is no JSON object with a known ``type`` and exactly its fields, in their ranges.
    """
    try:
        content = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"message must be JSON ({reprlib.repr(str(error))}), got {reprlib.repr(text)}") from error
    if not isinstance(content, dict):
        raise ValueError(f"message must be a JSON object, got {reprlib.repr(content)}")
    kind = content.pop("type", None)
    if not isinstance(kind, str) or kind not in MESSAGES:
        raise ValueError(f"type must be one of {', '.join(MESSAGES)}, got {reprlib.repr(kind)}")
    declared = {field.name: field.default is MISSING for field in fields(MESSAGES[kind])}  # type: ignore[arg-type]
    if unknown := content.keys() - declared.keys():
        raise ValueError(f"{kind} may hold {', '.join(declared) or 'nothing'}, got {reprlib.repr(sorted(unknown))}")
    if missing := [name for name, required in declared.items() if required and name not in content]:
        raise ValueError(f"{kind} must hold {', '.join(missing)}")
    return MESSAGES[kind](**content)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def quantise(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Positions (N, 2), m, as 16-bit whole numbers relative to the window's ``origin`` (2,), m."""
    relative = (positions - origin - LOW) / (HIGH - LOW) * (HIDDEN - 1)
    seen = (relative >= 0) & (relative <= HIDDEN - 1)  # false for NaN
    return np.where(seen.all(1, keepdims=True), np.where(seen, relative, 0.0).round(), HIDDEN).astype(np.uint16)


def pack_frame(
    counters: tuple[int, int, int, int], numbers: Sequence[float], rows: np.ndarray, arrays: Sequence[np.ndarray]
) -> bytes:
    """A frame for the page, little-endian.

    Args:
        counters: Number of the frame, control steps of the episode, id of the last :class:`Hand`, and flags.
        numbers: Origin (x, y) of the window, centre of the robot, lower left corner of the action image, m; return;
            simulated seconds per second.
        rows: Return and the terms of the reward in each step since the last frame, (S, 1 + K) float32.
        arrays: Arrays in the order of their item sizes: positions (N, 2) uint16; colour values (N,) uint8; observation
            (3, 64, 64) uint8; action (2, R, R) int8; gate (2, G, G) uint8, or empty.
    """
    head = HEAD.pack(*counters, len(rows), *numbers)
    return b"".join((head, rows.astype("<f4").tobytes(), *(array.tobytes() for array in arrays)))
