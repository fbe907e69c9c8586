"""The window of nodes."""

import math

import numpy as np
import pytest
import torch

from torchmpm import Body, Elastic, Grid, Solver


def test_default_window_is_one_metre() -> None:
    grid = Grid()
    assert (grid.resolution, grid.h) == (128, 1 / 128)
    assert Grid(50).h * 50 == pytest.approx(1.0, rel=1e-15)


def test_spacing_scales_the_window() -> None:
    grid = Grid(10, spacing=0.5)
    assert grid.h == 0.5
    x = torch.tensor([[4.99, 5.01]])
    assert grid.contains(x, torch.zeros(1, 1)).tolist() == [[True, False]]


@pytest.mark.parametrize("origin", [-0.31, 0.0, 2.5])
def test_contains_tests_the_open_interval_inside_the_margin(origin: float) -> None:
    offsets = torch.tensor([[-0.1, 0.0, 0.9e-5, 1.1e-5, 0.5, 1 - 1.1e-5, 1 - 0.9e-5, 1.0, 1.2]], dtype=torch.float64)
    found = Grid(64).contains(offsets + origin, torch.full((1, 1), origin, dtype=torch.float64))
    assert found.tolist() == [[False, False, False, True, True, True, False, False, False]]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_outside(number: float) -> None:
    assert not Grid(8).contains(torch.tensor([[number]]), torch.zeros(1, 1)).any()


def test_small_integers_of_numpy_become_python_integers() -> None:
    """Else sums and squares of them would overflow."""
    assert Grid(np.uint8(128)).width ** 2 == 134**2
    solver = Solver(Grid(np.int16(200)), (Body(np.int16(20000), Elastic(300.0, 50.0)),) * 2)
    assert solver.num_particles == 40000
