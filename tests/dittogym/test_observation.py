"""The raster: against a slow loop at full size, and in expectation at fewer particles."""

import numpy as np
import pytest
import torch

from dittogym import observation as obs
from dittogym.observation import encode


def loop_raster(position: np.ndarray, velocity: np.ndarray, row: int, column: int, mask: np.ndarray) -> np.ndarray:
    """One particle after the other into 1024 x 1024 pixels, then the crop, then the mean over 8 x 8."""
    fine = np.zeros((3, 512, 512))
    fine[0] = mask
    for (x, y), v in zip(position, velocity, strict=True):
        r, c = int((1 - y) * 1024) - row, int(x * 1024) - column
        if y > 0 and 0 <= r < 512 and 0 <= c < 512:
            fine[:, r, c] = 1, *v
    return fine.reshape(3, 64, 8, 64, 8).mean((2, 4))


def background(mask: np.ndarray) -> obs.Background:
    """Any set of fine pixels (B, 512, 512)."""
    pixels = torch.as_tensor(mask)
    return obs.Background(pixels, pixels.view(-1, 64, 8, 64, 8).double().mean((2, 4)))


def test_pixels_equal_the_loop() -> None:
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.1, 1.1, (2, 4000, 2))
    position[:, :2000] = 0.5 + 0.02 * rng.standard_normal((2, 2000, 2))  # many particles in one pixel
    velocity = rng.uniform(-10, 10, (2, 4000, 2))
    row, column = torch.tensor([[300], [512]]), torch.tensor([[200], [0]])
    mask = rng.random((2, 512, 512)) < 0.01
    p, v = torch.as_tensor(position), torch.as_tensor(velocity)
    seen = (p[..., 0] > 0) & (p[..., 0] < 1)
    weight, hidden = torch.ones(4000), torch.zeros(4000, dtype=torch.bool)
    ours = obs.pixel_means(obs.RasterInput(p, v, weight, seen, hidden, row, column, background(mask)))
    for i in range(2):
        kept = seen[i].numpy()
        loop = loop_raster(position[i][kept], velocity[i][kept], int(row[i]), int(column[i]), mask[i])
        assert ours[i].numpy() == pytest.approx(loop, abs=1e-12)


def test_splat_is_the_mean_of_random_rasters() -> None:
    """A block of uniform density: occupancy and velocity inside it agree with the raster of ten times the particles.

    Not exactly: SATURATION is fitted to the threshold of silhouettes, 4.5 % above the value for purely random pixels.
    """
    generator = torch.Generator().manual_seed(0)
    corner = (torch.tensor([[256]]), torch.tensor([[256]]))
    means = {}
    for count, weight, raster in ((40000, 1.0, obs.pixel_means), (4000, 10.0, obs.splat_means)):
        position = 0.4 + 0.2 * torch.rand(1, count, 2, generator=generator, dtype=torch.float64)
        velocity = torch.tensor([1.5, -0.5], dtype=torch.float64).expand(1, count, 2)
        seen = torch.ones(1, count, dtype=torch.bool)
        image = raster(obs.RasterInput(position, velocity, torch.full((count,), weight), seen, ~seen[0], *corner, None))
        means[count] = image[0, :, 25:38, 25:38].mean((1, 2))
    assert means[4000].tolist() == pytest.approx(means[40000].tolist(), rel=0.08)


@pytest.mark.parametrize("raster", [obs.pixel_means, obs.splat_means])
def test_hidden_velocities(raster) -> None:
    """Two particles in one place: the velocity of the pixel is that of the one whose velocity is not hidden."""
    velocity = torch.tensor([[[3.0, -2.0], [0.0, 0.0]]])
    corner = (torch.tensor([[256]]), torch.tensor([[256]]))
    means = {}
    for hidden in ([False, True], [True, True], [False, False]):
        here = torch.full((1, 2, 2), 0.5)
        visible = torch.ones(1, 2, dtype=torch.bool)
        shown = obs.RasterInput(here, velocity, torch.ones(2), visible, torch.tensor(hidden), *corner, None)
        if all(hidden):
            shown = shown._replace(velocity=torch.zeros(1, 2, 2))
        means[tuple(hidden)] = raster(shown)[0].sum((1, 2))
    one, none, both = means.values()
    assert one[0] == none[0] == both[0]
    assert none[1:].tolist() == [0.0, 0.0]
    assert one[1] == pytest.approx(3.0 / 64, rel=0.05) and one[2] == pytest.approx(-2.0 / 64, rel=0.05)
    assert abs(both[1]) < abs(one[1]) * 1.01


def test_coding() -> None:
    means = torch.zeros(1, 3, 64, 64)
    means[0, 0, 0, :4] = torch.tensor([0.0, 0.5, 1.0, 21 / 64])
    means[0, 1, 0, :4] = torch.tensor([0.0, 0.965, -1.036, 10.0])
    code = encode(means).to(torch.uint8)
    assert code[0, 0, 0, :4].tolist() == [0, 127, 255, 83]
    assert code[0, 1, 0, :4].tolist() == [132, 255, 0, 255]


def test_crop_stays_in_the_window() -> None:
    centre = torch.tensor([[0.5, 0.4], [0.0, 0.0], [1.0, 1.0], [0.4, 0.28]])
    row, column = obs.crop_corner(centre)
    assert row[:, 0].tolist() == [359, 512, 0, 482]
    assert column[:, 0].tolist() == [256, 0, 512, 153]
