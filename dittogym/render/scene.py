"""The arrays from which pictures, films and replays are drawn."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from torch import Tensor

from dittogym.core import EnvState, Model
from dittogym.geometry import Box, centre_in_window
from dittogym.observation import SIZE
from dittogym.render.colours import (
    GROUND_BODY,
    OBJECT,
    ROBOT,
    SCALES,
    Colour,
    muscle_activity,
    shear_strain,
    speed,
)
from dittogym.spec import TaskSpec
from torchmpm import Snow, checks

#: Names of all quantities of particles.
QUANTITIES = tuple(SCALES)
#: Radius of a particle by the distance between particles, which closes even a body of random positions; of a grain.
RADIUS, GRAIN_RADIUS = 1.25, 0.7
#: Width that the default camera shows, a little more than the half metre that the robot observes, m.
VIEW_WIDTH = 0.56
#: Pixels per side of the largest picture.
LARGEST = 8192
#: Contours of a target are found in a mask that is enlarged by this factor.
ENLARGED = 8


@dataclass(frozen=True)
class Matter:
    """How the particles of a body are drawn."""

    count: int
    radius: float  # m
    colour: Colour


class Solid(NamedTuple):
    """A box of an obstacle, m; ``filled`` if the robot sees it, or if it is a floor: a box with a top only."""

    left: float
    right: float
    bottom: float
    top: float
    filled: bool


@dataclass(frozen=True)
class Scene:
    """The static parts of a scene.

    Attributes:
        task: Name of the task.
        dt: Duration of a control step, s.
        bodies: The robot, then the object if there is one.
        solids: Boxes of the obstacles; open sides are infinite.
        goal: A point in the world, m.
        target: Outlines (K, 2) of the picture to match, and of its holes, relative to the robot's centre, m.
    """

    task: str
    dt: float
    bodies: tuple[Matter, ...]
    solids: tuple[Solid, ...]
    goal: tuple[float, float] | None
    target: tuple[np.ndarray, ...]

    def as_json(self) -> dict[str, Any]:
        """The scene as JSON values, with the scales of colours; ``None`` stands for an open side."""
        return {
            "task": self.task,
            "dt": self.dt,
            "bodies": [vars(body) for body in self.bodies],
            "solids": [[*(None if math.isinf(side) else side for side in box[:4]), box.filled] for box in self.solids],
            "goal": self.goal,
            "target": [np.round(outline, 5).tolist() for outline in self.target],
            "scales": {name: scale._asdict() for name, scale in SCALES.items()},
        }


class Shot(NamedTuple):
    """One moment of one simulation.

    Attributes:
        x: (N, 2) float32 positions in the world, m.
        values: Quantities of :data:`dittogym.render.colours.SCALES` by name, uint8 over the range of their scale: (N,),
            of the muscles (n,) for the robot's particles; these are missing where nothing has acted yet.
        origin: (2,) lower left corner of the simulated window in the world, m.
        view: (2,) centre of the observed region in the window, m.
        centre: (2,) the robot's centre in the world, m.
        step: Control steps since the reset.
    """

    x: np.ndarray
    values: dict[str, np.ndarray]
    origin: np.ndarray
    view: np.ndarray
    centre: np.ndarray
    step: int

    def corner(self, width: float) -> np.ndarray:
        """Lower left corner (2,) in the world of a square picture, m, kept inside the simulated window."""
        half = width / 2
        middle = np.clip(self.view, half, 1 - half) if width < 1 else np.full(2, 0.5)
        return np.asarray(self.origin + middle - half)


def describe(model: Model) -> Scene:
    """The scene of a task."""
    spec = model.spec
    matter = []
    for count, body in zip(model.camera.counts, spec.bodies, strict=True):
        grains = isinstance(body.material, Snow)
        radius = GRAIN_RADIUS if grains else RADIUS
        colour = ROBOT if body is spec.robot else GROUND_BODY if grains else OBJECT
        matter.append(Matter(count, radius * math.sqrt(body.shape.area / count), colour))
    solids = tuple(
        Solid(box.left, box.right, box.bottom, box.top, bool(obstacle.observed_boxes) or box == Box(top=box.top))
        for obstacle in spec.obstacles
        for box in obstacle.boxes
    )
    return Scene(spec.name, model.substeps * model.solver.dt, tuple(matter), solids, spec.goal, _outlines(spec))


def _outlines(spec: TaskSpec) -> tuple[np.ndarray, ...]:
    if spec.target is None:
        return ()
    pixels = SIZE * ENLARGED
    mask = cv2.resize(spec.target.astype(np.uint8), (pixels, pixels), interpolation=cv2.INTER_NEAREST)
    outlines, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return tuple((outline[:, 0] + 0.5 - pixels / 2) * (0.5 / pixels, -0.5 / pixels) for outline in outlines)


def take(
    model: Model, state: EnvState, index: int, actuation: Tensor | None, quantities: Iterable[str] = QUANTITIES
) -> Shot:
    """The present moment of one element of a batch, with the ``actuation`` (B, 2, P, P) of the last step, Pa.

    Of its values only ``quantities`` are computed: a picture shows muscles alone.
    """
    if not isinstance(index, (int, np.integer)) or not 0 <= index < len(state.steps):
        raise IndexError(f"index must be between 0 and {len(state.steps) - 1}, got {index!r}")
    index = int(index)
    one = slice(index, index + 1)
    view = centre_in_window(model.spec.view, state.centre[one], state.origin[one])
    origin, view, centre = (
        place.detach().cpu().double().numpy()[0] for place in (state.origin[one], view, state.centre[one])
    )
    values = {}
    for by in quantities:
        if by != "muscle":
            values[by] = SCALES[by].codes((shear_strain if by == "deformation" else speed)(state, index))
        elif actuation is not None:
            values[by] = SCALES[by].codes(muscle_activity(model, state, index, actuation))
    x = state.particles.x[index].detach().cpu().numpy().astype(np.float32)
    return Shot(x, values, origin, view, centre, int(state.steps[index]))


def check_size(name: str, size: int) -> None:
    """Check the pixels per side of a picture, an argument that the caller calls ``name``."""
    checks.whole(name, size, 16, LARGEST)


def check_view(size: int, zoom: float | None) -> float:
    """Check the size and the zoom of a picture, and return the width that it shows, m."""
    check_size("size", size)
    if zoom is not None:
        checks.number("zoom", zoom, least=0.05)  # lines and numbers are drawn for every 0.1 m
    return VIEW_WIDTH if zoom is None else 1.0 / zoom
