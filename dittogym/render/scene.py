"""What is drawn of a simulation: the static scene, the particles of a moment, and the colours of their quantities."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch
from torch import Tensor

from dittogym.action import place
from dittogym.core import EnvState, Model
from dittogym.geometry import NODES, Box, centre_in_window
from dittogym.observation import SIZE
from dittogym.spec import TaskSpec
from torchmpm import Snow, checks

#: Red, green and blue, 0 to 255.
Colour: TypeAlias = tuple[int, int, int]

ROBOT, OBJECT, GROUND_BODY = (38, 121, 140), (222, 122, 60), (150, 118, 86)
EXPAND, RELAX, CONTRACT = (52, 92, 200), (190, 190, 190), (206, 60, 52)


class ColourScale(NamedTuple):
    """Colours of a quantity.

    Attributes:
        label: What it is, with its unit.
        low: Value of the first colour.
        high: Value of the last one; larger values have the same colour.
        stops: RGB colours at equal distances from ``low`` to ``high``, between which colours are interpolated.
        robot_only: Whether other bodies do not have it; they have colours of their own.
    """

    label: str
    low: float
    high: float
    stops: tuple[Colour, ...]
    robot_only: bool = False

    def codes(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) as uint8, from 0 for ``low`` to 254 for ``high``; the middle where they are NaN."""
        at = np.clip((values - self.low) / (self.high - self.low), 0.0, 1.0)
        return np.where(np.isnan(at), 127.0, 254.0 * at).round().astype(np.uint8)

    def palette(self) -> np.ndarray:
        """The colour of each code, (255, 3) uint8."""
        at, stops = np.linspace(0.0, 1.0, len(self.stops)), np.array(self.stops, np.float64)
        mixed = [np.interp(np.linspace(0.0, 1.0, 255), at, column) for column in stops.T]
        return np.stack(mixed, axis=1).round().astype(np.uint8)


SCALES = {
    "muscle": ColourScale("expansion to contraction", -1.0, 1.0, (EXPAND, RELAX, CONTRACT), True),
    "deformation": ColourScale(
        "shear strain", 0.0, 0.1, ((38, 70, 83), (42, 157, 143), (233, 196, 106), (231, 111, 81))
    ),
    "speed": ColourScale("speed, m/s", 0.0, 1.5, ((49, 54, 110), (78, 121, 190), (120, 200, 190), (253, 231, 130))),
}
#: Code of muscles at rest.
REST = 127
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
    grains: bool  # loose, not one surface


class Solid(NamedTuple):
    """A box of an obstacle, m; ``filled`` if the robot sees it, or if it is a floor: a box with a top only."""

    left: float
    right: float
    bottom: float
    top: float
    filled: bool


@dataclass(frozen=True)
class Scene:
    """The static parts of what pictures show.

    Attributes:
        task: Name of the task.
        dt: Duration of a control step, s.
        bodies: The robot, then the object if there is one. Each has a ``count`` of particles, the ``radius`` with which
            they are drawn, m, an RGB ``colour``, and ``grains``, whether it is loose matter.
        solids: Boxes of the obstacles, with ``left``, ``right``, ``bottom`` and ``top``, m, which are infinite at open
            sides, and ``filled``, whether more than the outline is drawn.
        goal: Point (x, y) in the world, m; ``None`` for no goal.
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
        x: (N, 2) float32 positions of the particles in the world, m.
        values: Quantities of the particles by name, as uint8 from 0 for the lowest to 254 for the highest value:
            ``"muscle"`` (n,) of the robot's n particles, from -1, expansion, to 1, contraction, missing before the
            first step; ``"deformation"`` (N,), the shear strain from 0 to 0.1; ``"speed"`` (N,), from 0 to 1.5 m/s.
        origin: (2,) lower left corner of the simulated window in the world, m.
        view: (2,) centre of the observed region, relative to ``origin``, m.
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
        """Return the lower left corner of a picture around the observed region, kept inside the simulated window.

        Args:
            width: Width of the square picture, m.

        Returns:
            (2,) position in the world, m.
        """
        half = width / 2
        middle = np.clip(self.view, half, 1 - half) if width < 1 else np.full(2, 0.5)
        return np.asarray(self.origin + middle - half)


def describe(model: Model) -> Scene:
    """The scene of a task."""
    spec = model.spec
    matter = []
    for count, body in zip(model.counts, spec.bodies, strict=True):
        grains = isinstance(body.material, Snow)
        radius = GRAIN_RADIUS if grains else RADIUS
        colour = ROBOT if body is spec.robot else GROUND_BODY if grains else OBJECT
        matter.append(Matter(count, radius * math.sqrt(body.shape.area / count), colour, grains))
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
    if isinstance(index, bool) or not isinstance(index, (int, np.integer)) or not 0 <= index < len(state.steps):
        raise IndexError(f"index must be between 0 and {len(state.steps) - 1}, got {index!r}")
    index = int(index)
    one = slice(index, index + 1)
    view = centre_in_window(model.spec.view, state.centre[one], state.origin[one])
    points = (state.origin[one], view, state.centre[one])
    origin, view, centre = (point.detach().cpu().double().numpy()[0] for point in points)
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


def muscle_activity(model: Model, state: EnvState, index: int, actuation: Tensor) -> np.ndarray:
    """Mean actuation of the muscles at each particle of the robot, as a fraction of their limit, (n,) in [-1, 1].

    Args:
        model: The task.
        state: Its present state.
        index: Which element of the batch.
        actuation: (B, 2, P, P) on the patch, Pa.
    """
    spec, one = model.spec, slice(index, index + 1)
    centre = centre_in_window(spec.patch_centre, state.centre[one], state.origin[one])
    nodes = place(actuation[one], centre, NODES)[0].cpu().numpy().sum(0, dtype=np.float64)
    robot_x, origin = state.particles.x[index, : model.num_robot_particles], state.origin[index]
    relative = robot_x.detach().cpu().numpy().astype(np.float64) - origin.detach().cpu().numpy()
    finite = np.isfinite(relative).all(1, keepdims=True)
    at = np.clip(np.where(finite, relative, 0.0) * len(nodes), 0, len(nodes) - 1).astype(int)
    strength = float(state.physics["max_actuation"][index]) if "max_actuation" in state.physics else spec.max_actuation
    # Without muscles there is nothing to pull.
    return np.clip(nodes[at[:, 0], at[:, 1]] / (2 * strength), -1, 1) if strength else np.zeros(len(at))


def shear_strain(state: EnvState, index: int) -> np.ndarray:
    """Norm of the deviator of the logarithmic elastic strain of each particle, (N,).

    Where it would exceed ``yield_stress / (2 mu)``, a robot flows.
    """
    a, b, c, d = state.particles.F[index].detach().flatten(1).double().cpu().unbind(1)
    total, difference = torch.hypot(a + d, b - c), torch.hypot(a - d, b + c)  # of the principal stretches
    return (math.sqrt(2.0) * torch.atanh((difference / total).clamp_max(1.0 - 1e-9))).numpy()


def speed(state: EnvState, index: int) -> np.ndarray:
    """Speed of each particle (N,), m/s."""
    x, y = state.particles.v[index].detach().unbind(-1)
    return torch.hypot(x, y).cpu().numpy()  # many times faster than Tensor.norm
