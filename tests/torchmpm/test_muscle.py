"""Muscles: the actuation field on particles, and its stress."""

import math

import torch
from scenes import GRID, normal, positions

from torchmpm.grid import PAD
from torchmpm.materials.muscle import muscle_stress
from torchmpm.spline import stencil
from torchmpm.transfer import interpolate


def test_interpolation_of_the_field() -> None:
    """A field that is linear in the node indices is reproduced at the particles, each component and simulation."""
    x = positions(30, batch=2)
    origin = torch.tensor([[0.0, 0.0], [0.1, 0.05]], dtype=torch.float64)
    nodes = stencil(GRID, x[..., 0], x[..., 1], origin)
    i = torch.arange(-PAD, GRID.resolution + PAD, dtype=torch.float64)
    scale = torch.tensor([[1.0, -2.0], [3.0, 0.5]], dtype=torch.float64)  # component, simulation
    field = scale[..., None, None] * (1.0 + 2.0 * i[:, None] - 0.7 * i)
    u = (x - origin[:, None]) / GRID.h
    for found, factor in zip(interpolate(nodes, field.flatten(2)), scale, strict=True):
        torch.testing.assert_close(found, factor[:, None] * (1.0 + 2.0 * u[..., 0] - 0.7 * u[..., 1]))


def test_stress_is_the_actuation_between_two_deformations() -> None:
    F, ax, ay = normal(2, 9, 2, 2, seed=1), normal(2, 9, seed=2), normal(2, 9, seed=3)
    planes = tuple(F.flatten(-2).unbind(-1))
    expected = F @ torch.diag_embed(torch.stack((ax, ay), -1)) @ F.mT
    xx, xy, yy = muscle_stress(planes, (ax, ay))
    torch.testing.assert_close(torch.stack((xx, xy, xy, yy), -1).unflatten(-1, (2, 2)), expected)


def test_muscle_directions_are_material() -> None:
    """A body that has rolled by 90 degrees pulls along y with its x muscle."""
    zero, one = torch.zeros(1, 1), torch.ones(1, 1)
    xx, xy, yy = muscle_stress((zero, -one, one, zero), (3.0 * one, zero))
    assert (xx.item(), xy.item(), yy.item()) == (0.0, 0.0, 3.0)
    assert math.isclose(muscle_stress((one, zero, zero, one), (3.0 * one, zero))[0].item(), 3.0)
