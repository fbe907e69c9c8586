"""Colours of particles by muscle, deformation or speed; one definition for pictures, films and pages."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dittogym.action import place
from dittogym.core import EnvState, Model
from dittogym.geometry import NODES, centre_in_window

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
