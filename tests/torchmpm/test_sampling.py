"""Particle positions: inside their shapes, with the right density, from nobody else's random numbers."""

import math

import numpy as np
import pytest
import torch

from torchmpm import sampling

COUNT = 4096


@pytest.fixture(params=["uniform", "sobol"])
def numbers(request: pytest.FixtureRequest) -> np.ndarray:
    return draw(request.param, COUNT, 0)


def draw(kind: str, count: int, seed: int) -> np.ndarray:
    return sampling.sobol(count, seed) if kind == "sobol" else np.random.default_rng(seed).random((count, 2))


def tolerance(kind_scale: float) -> float:
    """Five standard errors of a mean over COUNT random points."""
    return 5.0 * kind_scale / math.sqrt(COUNT)


def test_sobol_numbers_leave_no_holes() -> None:
    """1024 scrambled Sobol numbers: one in each of 32 x 32 boxes; random ones leave a third of them empty."""

    def occupied(points: np.ndarray) -> int:
        return len(np.unique((points * 32).astype(int), axis=0))

    assert occupied(sampling.sobol(1024, 3)) == 1024
    assert occupied(draw("uniform", 1024, 3)) < 800


def test_a_seed_decides_and_nothing_global_is_touched() -> None:
    before = torch.get_rng_state()
    first, again, other = (sampling.sobol(100, seed) for seed in (7, 7, 8))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert torch.equal(before, torch.get_rng_state())


def test_disc_is_uniform(numbers: np.ndarray) -> None:
    """Uniform density: mean r^2 = R^2/2, and a disc of half the radius holds a quarter."""
    offset = sampling.disc(numbers, (0.4, 0.6), 0.2) - (0.4, 0.6)
    r2 = (offset**2).sum(1)
    assert r2.max() <= 0.04 * (1 + 1e-12)
    assert r2.mean() == pytest.approx(0.02, abs=tolerance(0.04 * 12**-0.5))
    assert (r2 < 0.01).mean() == pytest.approx(0.25, abs=tolerance(0.44))
    np.testing.assert_allclose(offset.mean(0), 0.0, atol=tolerance(0.1))
    np.testing.assert_allclose(np.cov(offset.T), np.diag([0.01, 0.01]), atol=tolerance(0.01))


def test_chord_disc_is_uniform_in_x_and_on_each_chord(numbers: np.ndarray) -> None:
    """Variances D^2/12 and D^2/18: denser towards left and right than a uniform disc (D^2/16 both)."""
    D = 0.4
    offset = sampling.chord_disc(numbers, (0.4, 0.6), D / 2) - (0.4, 0.6)
    assert (offset**2).sum(1).max() <= (D / 2) ** 2 * (1 + 1e-12)
    np.testing.assert_allclose(offset.mean(0), 0.0, atol=tolerance(0.12))
    assert offset[:, 0].var() == pytest.approx(D**2 / 12, abs=tolerance(0.012))
    assert offset[:, 1].var() == pytest.approx(D**2 / 18, abs=tolerance(0.012))


def test_lattice_fills_rows_from_below() -> None:
    points = sampling.lattice((3, 2), (1.0, 10.0), (3.0, 4.0))
    np.testing.assert_allclose(points, [[1.5, 11], [2.5, 11], [3.5, 11], [1.5, 13], [2.5, 13], [3.5, 13]])


MASK = np.array(
    [
        [1, 0, 0, 0],  # top
        [1, 0, 1, 0],
        [1, 1, 1, 0],  # bottom
    ],
    dtype=bool,
)


def test_image_fills_its_pixels_evenly_and_upright(numbers: np.ndarray) -> None:
    corner, size = (0.2, 0.5), (0.4, 0.6)
    points = sampling.image(numbers, MASK, corner, size)
    column, row = ((points - corner) / np.array(size) * (4, 3)).T
    assert (column >= 0).all() and (column < 3).all()
    assert (row >= 0).all() and (row < 3).all()
    pixel = MASK[::-1][row.astype(int), column.astype(int)]
    assert pixel.all(), "row 0 of a mask is its top"
    share = np.zeros((3, 4))
    np.add.at(share, (2 - row.astype(int), column.astype(int)), 1 / COUNT)
    np.testing.assert_allclose(share[MASK], 1 / 6, atol=tolerance(0.38))
    for within in (column % 1.0, row % 1.0):
        assert within.mean() == pytest.approx(0.5, abs=tolerance(12**-0.5))
        assert within.var() == pytest.approx(1 / 12, abs=tolerance(0.08))


def test_image_keeps_sobol_numbers_even() -> None:
    """Each pixel of a full mask gets its share to within a few particles."""
    points = sampling.image(sampling.sobol(1024, 0), np.ones((8, 8), dtype=bool), (0.0, 0.0), (1.0, 1.0))
    counts = np.histogram2d(*points.T, bins=8, range=[[0, 1], [0, 1]])[0]
    assert (counts == 16).all()


@pytest.mark.parametrize("last", [np.nextafter(1.0, 0.0), 1.0])
def test_image_at_the_last_number(last: float) -> None:
    points = sampling.image(np.array([[0.0, 0.0], [last, last]]), MASK, (0.0, 0.0), (4.0, 3.0))
    np.testing.assert_allclose(points, [[0.0, 0.0], [3.0, 2.0]], atol=1e-12)
