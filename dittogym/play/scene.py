"""What the page draws that does not move: bodies by their colours, obstacles, goal and target."""

from __future__ import annotations

import base64
import math
from typing import Any

from dittogym.geometry import NODES, Box
from dittogym.model import Model
from dittogym.render.colours import SCALES, body_colours
from dittogym.render.frame import FULL_SIZE_RADIUS

#: Radius of a dot with which evenly spread matter has no holes, by the distance between particles.
CLOSED = 0.85


def describe(model: Model) -> dict[str, Any]:
    """A task for the page, as JSON values; lengths in m."""
    spec, solver, colours = model.spec, model.solver, body_colours(model)
    bodies, first = [], 0
    for body, weight, moving in zip(spec.bodies, model.camera.particle_weight, solver.bodies, strict=True):
        (left, bottom), (width, height) = body.shape.corner, body.shape.size
        bodies.append(
            {
                "count": moving.count,
                "colour": colours[first].tolist(),
                "radius": max(FULL_SIZE_RADIUS * math.sqrt(weight), CLOSED * math.sqrt(body.shape.area / moving.count)),
                "box": [left, left + width, bottom, bottom + height],
            }
        )
        first += moving.count
    boxes = [
        {"edges": _edges(box), "solid": bool(obstacle.observed_boxes) or box == Box(top=box.top)}
        for obstacle in spec.obstacles
        for box in obstacle.boxes
    ]
    return {
        "task": spec.name,
        "horizon": spec.horizon,
        "control_step": model.substeps * solver.dt,
        "follow": spec.window.moves,
        "window_left": spec.window.left,
        "bodies": bodies,
        "boxes": boxes,
        "goal": spec.goal,
        "target": None if spec.target is None else base64.b64encode(spec.target.tobytes()).decode(),
        "patch": spec.patch / NODES,
        "scales": {name: scale._asdict() for name, scale in SCALES.items()},
        "matter": {"mu": spec.mu, "yield_stress": spec.yield_stress, "gravity": -spec.gravity[1]},
    }


def _edges(box: Box) -> list[float | None]:
    """Left, right, bottom and top of a box; ``None`` where it is open, which JSON cannot say otherwise."""
    return [edge if math.isfinite(edge) else None for edge in (box.left, box.right, box.bottom, box.top)]
