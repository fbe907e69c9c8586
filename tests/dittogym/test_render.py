"""Pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dittogym import BatchEnv, Env, TorchEnv, make_spec
from dittogym.render.frame import GROUND, SOLID, TARGET, Canvas
from dittogym.render.scene import CONTRACT, EXPAND, RELAX, ROBOT, SCALES, describe, shear_strain, speed


def near(image: np.ndarray, colour) -> np.ndarray:
    return (np.abs(image.astype(int) - np.asarray(colour)).max(-1) < 12).nonzero()


@pytest.mark.parametrize("particles", ["full", "lite"])
def test_body_and_floor_are_where_they_should_be(particles: str) -> None:
    env = TorchEnv("run", 1, particles=particles)
    env.reset(seed=0)
    image = env.render(zoom=1)
    assert image.shape == (512, 512, 3) and image.dtype == np.uint8
    rows, columns = near(image, ROBOT)
    area = np.pi * (0.09 * 512) ** 2
    assert 0.85 * area < len(rows) < 1.15 * area
    assert columns.mean() == pytest.approx(0.4 * 512, abs=3)
    assert rows.mean() == pytest.approx((1 - 0.25) * 512, abs=3)
    ground = near(image, SOLID)[0]
    assert ground.max() == 511 and (ground > (1 - 20 / 128) * 512 - 2).mean() > 0.9


def test_muscles_target_and_size() -> None:
    env = TorchEnv("shapematch", 2, particles=500, substeps=1)
    env.reset(seed=0)
    plain = env.render(1, size=128)
    assert plain.shape == (128, 128, 3)
    assert np.array_equal(plain, env.render(1, muscles=True, size=128))  # nothing acts yet
    env.step(torch.ones(2, *env.action_shape))
    red = near(env.render(1, muscles=True), CONTRACT)[0]
    assert len(red) > 1000
    with pytest.raises(IndexError, match="index"):
        env.render(2)


def test_a_shot_holds_the_quantities_that_are_asked_for() -> None:
    env = TorchEnv("kick", 1, particles=100, substeps=1)
    env.reset(seed=0)
    assert set(env.shot().values) == {"deformation", "speed"}  # nothing acts yet
    env.step(torch.ones(1, *env.action_shape))
    whole = env.shot()
    assert set(whole.values) == set(SCALES)
    for asked in ((), ("muscle",), ("muscle", "deformation")):
        values = env.shot(0, asked).values
        assert set(values) == set(asked) and all(np.array_equal(values[by], whole.values[by]) for by in asked)


def test_scales() -> None:
    """The quantities in their units, and colours at the ends of a scale, beyond them, and without a value."""
    env = TorchEnv("kick", 1, particles=100, dtype="float64")
    env.reset(seed=0)
    stretch = 1.03
    env.state.F[0, 0] = torch.tensor([[0.0, -stretch], [1 / stretch, 0.0]])  # stretched along y, and turned
    env.state.v[0, -1] = torch.tensor([0.3, -0.4])
    strain, speeds = shear_strain(env.env_state, 0), speed(env.env_state, 0)
    assert strain[0] == pytest.approx(np.sqrt(2) * np.log(stretch)) and not strain[1:].any()
    assert speeds[-1] == pytest.approx(0.5) and not speeds[:-1].any()
    muscle = SCALES["muscle"]
    shown = muscle.palette()[muscle.codes(np.array([-9.0, 0.0, 1.0, np.nan]))]
    assert shown.tolist() == [list(EXPAND), list(RELAX), list(CONTRACT), list(RELAX)]


@pytest.mark.parametrize("task", ["shapematch", "slot"])
def test_a_robot_that_has_flown_far_away(task: str) -> None:
    env = TorchEnv(task, 1, particles=100, substeps=1)
    env.reset(seed=0)
    env.state.v.fill_(1e30)
    with torch.no_grad():
        assert not env.step(torch.zeros(1, *env.action_shape))[-1]["finite"]
    assert not len(near(env.render(), ROBOT)[0])


def test_particles_that_are_not_finite_are_left_out() -> None:
    env = TorchEnv("run", 1, particles=100)
    env.reset(seed=0)
    env.state.x[0, :50] = torch.nan
    env.render(muscles=True)
    assert len(near(env.render(), ROBOT)[0]) > 0


def test_holes_of_a_target_stay_empty() -> None:
    """A ring with a disc in it."""
    y, x = np.mgrid[:64, :64] - 31.5
    radius = np.hypot(x, y)
    spec = replace(make_spec("shapematch"), target=(radius < 8) | ((radius > 16) & (radius < 28)))
    canvas = Canvas(256, np.zeros(2))
    canvas.target(describe(TorchEnv(spec, particles=100).model).target, np.array((0.5, 0.5)))
    for distance, colour in ((0, TARGET), (24, GROUND), (44, TARGET), (62, GROUND)):  # pixels of the picture
        assert tuple(canvas.image[128, 128 + distance]) == colour == tuple(canvas.image[128 - distance, 128])


@pytest.mark.parametrize("muscles", [True, False])
def test_pictures_of_gymnasium_s_environments(muscles: bool) -> None:
    """Their size, and muscles, which are coloured unless they are not asked for."""
    options = {"render_mode": "rgb_array", "render_size": 256, "render_muscles": muscles, "substeps": 1}
    env, batch = Env("run", particles="lite", **options), BatchEnv("run", 2, particles="lite", **options)
    for each, action in ((env, np.ones(env.action_space.shape)), (batch, np.ones(batch.action_space.shape))):
        each.reset(seed=0)
        each.step(action.astype(np.float32))
        picture = each.render() if each is env else each.render()[1]
        assert picture.shape == (256, 256, 3) and (len(near(picture, CONTRACT)[0]) > 250) == muscles
