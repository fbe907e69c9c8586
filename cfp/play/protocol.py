"""The messages between page and server: JSON from the page, binary frames to it."""

from __future__ import annotations

import struct
from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from cfp.play.hand import Direction

#: Largest size of a message from the page, bytes.
LARGEST_MESSAGE = 2**18
#: The head of a frame: its number, the control steps of the episode, the id of the last :class:`Hand`, flags, and sizes
#: S, K, N, R and G; then the robot's centre (x, y) and the lower left corner of the action image in the world, m, the
#: return, and simulated seconds per second. After it come, little-endian, the return and the terms of the reward after
#: each step since the last frame (S, K) float32; positions (N, 2) float32, m; codes of colours (N,) uint8; observation
#: (3, 64, 64) uint8; action (2, R, R) int8; gate (2, G, G) uint8.
HEAD = struct.Struct("<9I6f")

#: Bounded, so that squares of distances are finite.
Metres: TypeAlias = Annotated[float, Meta(ge=-1e4, le=1e4)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Pixels: TypeAlias = Annotated[bytes, Meta(min_length=64, max_length=2**16)]


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag=str.lower):
    """Base class of what the page may send; its name in lower case is the ``type``."""


class Play(Message, frozen=True):
    """Let time pass, or stop it."""

    playing: bool


class Speed(Message, frozen=True):
    """Simulated seconds per second."""

    factor: Annotated[float, Meta(ge=0.01, le=16)]


class Step(Message, frozen=True):
    """Stop, and take one control step."""


class Reset(Message, frozen=True):
    """Start a new episode; with a seed the particles are drawn anew."""

    seed: Count | None = None


class Hand(Message, frozen=True):
    """What the pointer does at a point of the world, m; without a tool it lets go. Frames echo the last ``id``."""

    tool: Literal["pull", "contract", "expand", None]
    x: Metres = 0.0
    y: Metres = 0.0
    id: Count = 0


class Paint(Message, frozen=True):
    """Set cells (row, column) of the painted action image, of the muscles in both directions or in one."""

    muscles: Literal["both", "horizontal", "vertical"]
    value: Annotated[float, Meta(ge=-1, le=1)]
    cells: Annotated[list[tuple[Count, Count]], Meta(min_length=1, max_length=4096)]


class Clear(Message, frozen=True):
    """Wipe the painted action image."""


class Wave(Message, frozen=True):
    """Let waves of contraction travel through the robot, or stop them."""

    direction: Direction | None


class Policy(Message, frozen=True):
    """Hand the muscles over to a policy by its name, or take them back."""

    name: str | None


class Colour(Message, frozen=True):
    """Colour the particles by a quantity."""

    by: Literal["muscle", "deformation", "speed"]


class Matter(Message, frozen=True):
    """Factors on the task's own stiffness and yield stress, and gravity downwards, m/s^2."""

    stiffness: Annotated[float, Meta(gt=0)]
    yield_stress: Annotated[float, Meta(ge=0)]
    gravity: Annotated[float, Meta(ge=-100, le=100)]


class Save(Message, frozen=True):
    """Send the present state, the actions since the reset, or a replay of them as a file."""

    what: Literal["moment", "actions", "replay"]


class Back(Message, frozen=True):
    """Go back to the moment that was saved last."""


class Draw(Message, frozen=True):
    """A drawn robot or target: a square picture, one byte per pixel, row 0 at the top.

    A robot has the area of the task's own one, or with a ``scale`` less than 1 so many times its width and height.
    """

    what: Literal["body", "target"]
    pixels: Pixels
    scale: Annotated[float, Meta(ge=0.1, le=1)] = 1.0


class Seen(Message, frozen=True):
    """The page has drawn a frame; no more than a few are on their way to it."""

    frame: Count


_DECODER = msgspec.json.Decoder(
    Play | Speed | Step | Reset | Hand | Paint | Clear | Wave | Policy | Colour | Matter | Save | Back | Draw | Seen
)


def parse(text: str) -> Message:
    """The message that a text holds.

    Raises:
        ValueError: It is not JSON, or not a message with exactly its fields, in their ranges.
    """
    try:
        message: Message = _DECODER.decode(text)
    except msgspec.DecodeError as error:  # a ValueError in newer versions only
        raise ValueError(str(error)) from error
    return message
