"""Pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import begun

from dittogym import BatchEnv, Env, TorchEnv, make_spec
from dittogym.render.frame import BRIDGE, GROUND, SOLID, TARGET, TILE, Canvas, frame
from dittogym.render.scene import CONTRACT, EXPAND, OBJECT, RELAX, ROBOT, SCALES, Solid, describe, shear_strain, speed


def near(image: np.ndarray, colour) -> np.ndarray:
    return (np.abs(image.astype(int) - np.asarray(colour)).max(-1) < 12).nonzero()


@pytest.mark.parametrize("particles", ["full", "lite"])
def test_body_and_floor_are_where_they_should_be(particles: str) -> None:
    env = begun(TorchEnv("run", 1, particles=particles))
    image = env.render(zoom=1)
    assert image.shape == (512, 512, 3) and image.dtype == np.uint8
    rows, columns = near(image, ROBOT)
    area = np.pi * (0.09 * 512) ** 2
    assert 0.85 * area < len(rows) < 1.15 * area
    assert columns.mean() == pytest.approx(0.4 * 512, abs=3)
    assert rows.mean() == pytest.approx((1 - 0.25) * 512, abs=3)
    ground = np.concatenate([near(image, shade)[0] for shade in (SOLID, TILE)])  # every tenth of a metre another
    assert ground.max() == 511 and (ground > (1 - 20 / 128) * 512 - 2).mean() > 0.9


def test_muscles_target_and_size() -> None:
    env = begun(TorchEnv("shapematch", 2, particles=500, substeps=1))
    plain = env.render(1, size=128)
    assert plain.shape == (128, 128, 3)
    assert np.array_equal(plain, env.render(1, muscles=True, size=128))  # nothing acts yet
    env.step(torch.ones(2, *env.action_shape))
    red = near(env.render(1, muscles=True), CONTRACT)[0]
    assert len(red) > 1000
    for index in (2, True):
        with pytest.raises(IndexError, match="index"):
            env.render(index)


def test_a_shot_holds_the_quantities_that_are_asked_for() -> None:
    env = begun(TorchEnv("kick", 1, particles=100, substeps=1))
    assert set(env.shot().values) == {"deformation", "speed"}  # nothing acts yet
    env.step(torch.ones(1, *env.action_shape))
    whole = env.shot()
    assert set(whole.values) == set(SCALES)
    for asked in ((), ("muscle",), ("muscle", "deformation")):
        values = env.shot(0, asked).values
        assert set(values) == set(asked) and all(np.array_equal(values[by], whole.values[by]) for by in asked)


def test_scales() -> None:
    """The quantities in their units, and colours at the ends of a scale, beyond them, and without a value."""
    env = begun(TorchEnv("kick", 1, particles=100, dtype="float64"))
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
    env = begun(TorchEnv(task, 1, particles=100, substeps=1))
    env.state.v.fill_(1e30)
    with torch.no_grad():
        assert not env.step(torch.zeros(1, *env.action_shape))[-1]["finite"]
    assert not len(near(env.render(), ROBOT)[0])


def test_matter_that_lies_far_apart() -> None:
    """Two pieces in a picture of twenty metres."""
    canvas = Canvas(256, np.zeros(2), 20.0)
    canvas.surface(np.array(((1.0, 1.0), (19.0, 19.0))), np.array(ROBOT, np.uint8), 0.2, 0.2, 0)
    assert all(tuple(canvas.image[row, column]) == ROBOT for row, column in ((243, 12), (12, 243)))
    assert tuple(canvas.image[128, 128]) == GROUND


def test_holes_of_a_target_stay_empty() -> None:
    """A ring with a disc in it."""
    y, x = np.mgrid[:64, :64] - 31.5
    radius = np.hypot(x, y)
    spec = replace(make_spec("shapematch"), target=(radius < 8) | ((radius > 16) & (radius < 28)))
    canvas = Canvas(256, np.zeros(2))
    canvas.target(describe(TorchEnv(spec, particles=100).model).target, np.array((0.5, 0.5)))
    for distance, colour in ((0, TARGET), (24, GROUND), (44, TARGET), (62, GROUND)):  # pixels of the picture
        assert tuple(canvas.image[128, 128 + distance]) == colour == tuple(canvas.image[128 - distance, 128])


@pytest.mark.parametrize(("nodes", "joined"), [(2.5, True), (3.5, False)])
def test_matter_is_one_piece_as_far_as_its_particles_share_nodes(nodes: float, joined: bool) -> None:
    """Two ribs of a body beside each other; a particle that is not finite changes nothing."""
    canvas, height = Canvas(512, np.zeros(2)), np.arange(0.4, 0.6, 0.002)
    ribs = [np.stack((np.full_like(height, 0.5 + side * nodes / 128 / 2), height), 1) for side in (-1, 1)]
    canvas.surface(np.concatenate([*ribs, [[np.nan, 0.5]]]), np.array(ROBOT, np.uint8), BRIDGE / 2, 0.001, 0)
    assert tuple(canvas.image[256, 256]) == (ROBOT if joined else GROUND)
    assert tuple(canvas.image[256, 256 - 20]) == tuple(canvas.image[256, 256 + 20]) == GROUND


def test_the_floor_moves_past_a_camera_that_follows() -> None:
    floor = Solid(-np.inf, np.inf, -np.inf, 0.1, True)
    for left in (0.0, 0.1, 2.3):
        canvas = Canvas(200, np.array((left, 0.0)))
        canvas.box(floor)
        shades = [tuple(canvas.image[190, column]) for column in (10, 30, 50)]
        assert shades == ([SOLID, TILE, SOLID] if round(10 * left) % 2 == 0 else [TILE, SOLID, TILE])


@pytest.mark.parametrize(("task", "colours"), [("run", ()), ("grow", (TARGET,)), ("kick", (OBJECT,))])
def test_a_legend_shows_the_colours_of_the_scene(task: str, colours) -> None:
    env = begun(TorchEnv(task, 1, particles=100))
    scene, shot = describe(env.model), env.shot()
    top = frame(scene, shot, 360, legend=True)[17:34]
    others = {TARGET, OBJECT} - set(colours)
    assert all(len(near(top, colour)[0]) > 9 for colour in (EXPAND, CONTRACT, *colours))
    assert not any(len(near(top, colour)[0]) for colour in others)


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
