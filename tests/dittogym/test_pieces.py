"""Mass in one piece, of bodies whose pieces are known."""

import numpy as np
import pytest
import torch

from dittogym import make_spec
from dittogym.bodies.positions import InitialPositions, particle_counts
from dittogym.pieces import largest_piece
from dittogym.tasks import TASKS

CELL = 1 / 128


def body(*boxes):
    """Four particles in each cell of some boxes (left, bottom, width, height), in cells."""
    quarter = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    cells = [
        torch.cartesian_prod(torch.arange(left, left + width), torch.arange(bottom, bottom + height))
        for left, bottom, width, height in boxes
    ]
    return ((torch.cat(cells)[:, None] + quarter) * CELL).reshape(1, -1, 2)


SQUARE = (40, 20, 8, 8)
#: Bodies, and the cells of their largest piece over all of theirs.
BODIES = {
    "whole": ([SQUARE], 1.0),
    "at the edges of the window": ([(0, 120, 128, 8)], 1.0),
    "joined by a strand one cell wide": ([SQUARE, (48, 23, 6, 1), (54, 20, 4, 8)], 64 / 102),
    "joined by a strand two cells wide": ([SQUARE, (48, 23, 6, 2), (54, 20, 4, 8)], 1.0),
    "touching at a corner": ([SQUARE, (48, 28, 8, 8)], 1.0),
    "torn apart": ([SQUARE, (50, 20, 4, 8)], 64 / 96),
    "dust": ([(10, 10, 1, 1), (12, 10, 1, 30)], 0.0),
}


@pytest.mark.parametrize("name", BODIES)
def test_share_of_the_largest_piece(name):
    boxes, share = BODIES[name]
    assert largest_piece(body(*boxes), torch.zeros(1, 2)) == pytest.approx([share])


def test_robots_of_a_batch_have_their_own_windows_and_pieces():
    whole, torn = body(SQUARE, (48, 20, 4, 8)), body(SQUARE, (50, 20, 4, 8))
    there = torch.tensor([[0.0, 0.0], [1.7, 0.0], [-3.3, 0.0]])
    together = torch.cat((torn, whole, torn)) + there[:, None]
    assert largest_piece(together, there) == pytest.approx([2 / 3, 1.0, 2 / 3])


def test_what_has_left_the_window_or_is_not_finite_is_in_no_piece():
    x = body(SQUARE)
    x[0, :16], x[0, 16:32], x[0, 32:48] = 1e20, float("nan"), -0.01
    assert largest_piece(x, torch.zeros(1, 2)) == pytest.approx([(256 - 48) / 256])


@pytest.mark.parametrize("particles", ["lite", "full"])
@pytest.mark.parametrize("task", TASKS)
def test_robots_begin_in_one_piece(task, particles):
    spec = make_spec(task)
    counts, like = particle_counts(spec, particles), torch.zeros(1)
    drawn = InitialPositions(spec, counts, 1, random=particles == "full", resample=False)
    x = drawn.draw(3, np.ones(1, bool), None, like).positions[:, : counts[0]]
    assert largest_piece(x, spec.window.origin(x.mean(1)))[0] > 0.95
