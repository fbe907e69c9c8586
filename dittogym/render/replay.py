"""Replays: one HTML page with the particles of an episode and a player, which needs nothing else."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from dittogym.render.scene import REST, VIEW_WIDTH, Scene, Shot

PLAYER = Path(__file__).parent / "replay.html"
#: Draws a scene in a browser; :mod:`cfp.play` serves the same file.
SCENE = Path(__file__).parent / "scene.js"
#: Quantities of particles that a replay holds; it computes speeds itself.
SHOWN = ("muscle", "deformation")
#: At most so many moments and particles are kept, evenly spread.
MOST_MOMENTS, MOST_PARTICLES = 400, 3000
#: Positions are multiples of this, m.
QUANTUM = 2.5e-4
#: Code of a position that is not finite or too far away.
NOWHERE = -(2**15)
#: Values are kept in steps of so many of 254.
VALUE_STEP = 8


def replay_page(
    scene: Scene, shots: Sequence[Shot], rewards: Sequence[float], success: bool | None, speed: float
) -> str:
    """The page of a replay.

    Args:
        scene: The static parts of the scene.
        shots: The start, then one moment after each step.
        rewards: Of the steps.
        success: Whether the last step counts as success, if the task defines it.
        speed: At which the page begins to play, 1 is real time.
    """
    header, data = encode(scene, shots)
    written = [round(reward, 4) if math.isfinite(reward) else "NaN" for reward in rewards]  # of a task of the user's
    header |= {"rewards": written, "success": success, "speed": speed}
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = PLAYER.read_text(encoding="utf-8").replace("%SCENE%", SCENE.read_text(encoding="utf-8"))
    page = page.replace("%TITLE%", escape(scene.task)).replace("%HEADER%", text)
    return page.replace("%DATA%", base64.b64encode(data).decode())


def encode(scene: Scene, shots: Sequence[Shot]) -> tuple[dict[str, Any], bytes]:
    """What a replay holds of an episode: a description as JSON values, and compressed arrays.

    The arrays are, with T moments and N particles: positions relative to the robot's centre, x and y (T, 2, N) in
    multiples of ``quantum``, as second differences in time modulo 2^16, of which positive and negative ones alternate
    (0, -1, 1, -2, ...), first all low bytes and then all high bytes; and uint8 differences in time of the values
    ``muscle`` (T, n) of the robot's particles and ``deformation`` (T, N). Differences begin from zero.
    """
    stride = math.ceil((len(shots) - 1) / MOST_MOMENTS) or 1
    steps = sorted({*range(0, len(shots), stride), len(shots) - 1})
    kept = [shots[step] for step in steps]
    chosen, counts = _selection(scene, shots[0])
    arrays = [_positions(kept, chosen)]
    for name, particles in zip(SHOWN, (chosen[: counts[0]], chosen), strict=True):
        rest = np.full(len(shots[0].x), REST, np.uint8)
        values = np.stack([shot.values.get(name, rest)[particles] for shot in kept]) // VALUE_STEP
        arrays.append(np.diff(values, axis=0, prepend=np.uint8(0)).tobytes())
    header = scene.as_json() | {
        "quantum": QUANTUM,
        "particles": len(shots[0].x),
        "levels": 254 // VALUE_STEP,  # the highest value
        "stride": stride,
        "steps": steps,
        "centre": [_rounded(shot.centre) for shot in kept],
        "corner": [_rounded(shot.corner(VIEW_WIDTH)) for shot in kept],
        "width": VIEW_WIDTH,
        "bodies": [
            vars(body) | {"count": count, "radius": body.radius * math.sqrt(body.count / count)}
            for body, count in zip(scene.bodies, counts, strict=True)
        ],
    }
    return header, zlib.compress(b"".join(arrays))


def _selection(scene: Scene, start: Shot) -> tuple[np.ndarray, list[int]]:
    """Indices of the particles that are kept, neighbours beside each other, and their number in each body."""
    share = min(1.0, MOST_PARTICLES / sum(body.count for body in scene.bodies))
    cells = np.where(np.isfinite(start.x), start.x * 64, 0).astype(np.int64)  # 16 mm wide
    order = np.lexsort((np.where(cells[:, 0] % 2, -1, 1) * cells[:, 1], cells[:, 0]))  # up a column, down the next
    body_of = np.repeat(np.arange(len(scene.bodies)), [body.count for body in scene.bodies])[order]
    chosen, counts = [], []
    for number, body in enumerate(scene.bodies):
        counts.append(max(1, round(share * body.count)))
        chosen.append(order[body_of == number][np.arange(counts[-1]) * body.count // counts[-1]])
    return np.concatenate(chosen), counts


def _positions(shots: Sequence[Shot], chosen: np.ndarray) -> bytes:
    relative = np.stack([(shot.x[chosen] - shot.centre).T for shot in shots]) / QUANTUM
    near = np.abs(relative) < -NOWHERE  # false where it is not finite
    codes = np.where(near, relative, NOWHERE).round().astype(np.int16)
    padded = np.concatenate([np.zeros((2, *codes.shape[1:]), np.int16), codes])
    second = padded[2:] - 2 * padded[1:-1] + padded[:-2]
    alternating = ((second << 1) ^ (second >> 15)).view(np.uint16)
    low, high = (alternating & 255).astype(np.uint8), (alternating >> 8).astype(np.uint8)
    return low.tobytes() + high.tobytes()


def _rounded(place: np.ndarray) -> list[float]:
    return [round(float(value), 5) for value in place]
