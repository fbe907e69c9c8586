"""The window of nodes."""

import math

import numpy as np
import pytest
import torch

from torchmpm import Body, Elastic, Grid, Solver


def test_the_window_is_one_metre_or_what_the_spacing_makes_it() -> None:
    assert (Grid().resolution, Grid().h) == (128, 1 / 128)
    assert Grid(10, spacing=0.5).contains(torch.tensor([[4.99, 5.01]]), torch.zeros(1, 1)).tolist() == [[True, False]]


@pytest.mark.parametrize("origin", [-0.31, 0.0, 2.5])
def test_contains_tests_the_open_interval_inside_the_margin(origin: float) -> None:
    inside = torch.tensor([[1.1e-5, 0.5, 1 - 1.1e-5]], dtype=torch.float64)
    outside = torch.tensor([[-0.1, 0.0, 0.9e-5, 1 - 0.9e-5, 1.0, 1.2, math.nan, math.inf, -math.inf]]).double()
    start = torch.full((1, 1), origin, dtype=torch.float64)
    assert Grid(64).contains(inside + origin, start).all()
    assert not Grid(64).contains(outside + origin, start).any()


def test_small_integers_of_numpy_become_python_integers() -> None:
    """Else sums and squares of them would overflow."""
    assert Grid(np.uint8(128)).width ** 2 == 134**2
    solver = Solver(Grid(np.int16(200)), (Body(np.int16(20000), Elastic(300.0, 50.0)),) * 2)
    assert solver.num_particles == 40000
