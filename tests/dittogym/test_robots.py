"""Robots and obstacles of one's own, and what particles bodies are made of."""

import os
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest
import torch
from PIL import Image
from tiny import TASKS, begun, tiny

import dittogym
from dittogym.bodies.images import read_mask
from dittogym.bodies.positions import particle_counts
from dittogym.bodies.shapes import Disc, Figure, Lattice, Rectangle
from dittogym.geometry import ceiling, floor, solid
from dittogym.render.frame import SOLID
from dittogym.spec import BodySpec
from torchmpm import sampling

#: An L: a column of two by six cells on the left, a foot of four by two to its right.
ELL = np.zeros((6, 6), bool)
ELL[:, :2] = True
ELL[4:, 2:] = True
ELL_OUTLINE = [(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)]
SQUARE = [(-1, -1), (1, -1), (1, 1), (-1, 1)]


def large(mask: np.ndarray = ELL, margin: int = 7) -> np.ndarray:
    """The mask with ten pixels a cell and an uneven dark margin."""
    return np.pad(np.kron(mask, np.ones((10, 10), bool)), ((margin, 0), (3, margin)))


def pictures(folder: Path) -> dict[str, object]:
    """The same robot in every form in which it can be given as a picture."""
    mask = large()
    grey = np.where(mask, 200, 30).astype(np.uint8)
    colour = np.dstack([grey] * 3)
    clear = np.dstack([np.full_like(colour, 255), 255 * mask.astype(np.uint8)])
    forms = {"grey": grey, "bool": mask, "float": grey / 255.0, "uint16": grey * np.uint16(257)}
    forms |= {"colour": colour, "transparent": clear}
    for name in ("grey", "colour", "transparent", "uint16"):
        path = folder / f"{name}.png"
        assert cv2.imwrite(str(path), forms[name])
        forms |= {f"path of {name}": path, f"text path of {name}": str(path)}
    return forms


def points(shape, count: int = 4096) -> np.ndarray:
    return shape.positions(sampling.sobol(count, seed=1))


def test_pictures_of_all_kinds_are_the_same_robot(tmp_path: Path) -> None:
    own = dittogym.make_spec("run").robot
    for name, picture in pictures(tmp_path).items():
        robot = dittogym.make_spec("run", body=picture).robot
        assert isinstance(robot.shape, Figure) and np.array_equal(robot.shape.mask, large(margin=0)[:, 3:]), name
        assert (robot.count, robot.mass) == (own.count, own.mass)


@pytest.mark.parametrize("name", ["stär.png", os.fsdecode(b"st\xe4r.png"), "two\nlines.png"])
def test_names_of_files_may_have_any_letters(name: str, tmp_path: Path) -> None:
    """Also bytes that are not in the encoding of the system, as in a name from another one; no C library opens them."""
    path = f"{tmp_path}/{name}"
    Image.fromarray(large()).save(path)
    named, drawn = (dittogym.make_spec("shapematch", body=each, target=each) for each in (path, large()))
    assert np.array_equal(named.robot.shape.mask, drawn.robot.shape.mask)
    assert np.array_equal(named.target, drawn.target)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("body", [large(), ELL_OUTLINE, np.array(ELL_OUTLINE) * 0.01 - 5.0, np.array(SQUARE)])
def test_area_and_place_are_those_of_the_tasks_own_robot(task: str, body) -> None:
    own, robot = dittogym.make_spec(task).robot, dittogym.make_spec(task, body=body).robot
    assert robot.count == own.count and robot.shape.area == pytest.approx(own.shape.area)
    assert robot.shape.corner[1] == own.shape.corner[1]
    assert robot.shape.corner[0] + robot.shape.size[0] / 2 == pytest.approx(own.shape.corner[0] + own.shape.size[0] / 2)
    assert robot.shape.size[0] == pytest.approx(robot.shape.size[1], rel=0.01)
    x = points(robot.shape)
    low, high = np.array(robot.shape.corner), np.array(robot.shape.corner) + robot.shape.size
    assert (x >= low).all() and (x <= high).all()
    assert x.min(0) == pytest.approx(low, abs=0.005) and x.max(0) == pytest.approx(high, abs=0.005)


@pytest.mark.parametrize("body", [large(), ELL_OUTLINE])
@pytest.mark.parametrize("particles", [2000, "full"])
def test_particles_fill_the_mask_evenly(body, particles) -> None:
    """Sobol and random draws: every cell of the L holds its share, what is outside holds none; the foot is below."""
    env = begun(tiny("run", body=body, particles=particles))
    shape, x = env.spec.robot.shape, env.state.x[0].numpy()
    column, above = ((x - shape.corner) / shape.size * 6).clip(0, 6 - 1e-9).astype(int).T
    cells = np.zeros((6, 6), int)
    np.add.at(cells, (5 - above, column), 1)
    share = env.num_particles / ELL.sum()
    assert cells[~ELL].sum() <= 0.02 * env.num_particles  # an outline is drawn with its edge
    assert cells[ELL] == pytest.approx(np.full(ELL.sum(), share), rel=0.07 if particles == 2000 else 0.15)


def test_a_shape_lies_where_it_says_and_is_as_dense() -> None:
    spec, own = dittogym.make_spec("run", body=Rectangle((0.05, 0.3), (0.1, 0.12))), dittogym.make_spec("run").robot
    assert spec.robot.shape.corner == (0.05, 0.3)
    assert spec.robot.count / spec.robot.shape.area == pytest.approx(own.count / own.shape.area, rel=1e-4)
    assert spec.robot.mass == own.mass
    body = BodySpec(Disc((0.1, 0.2), 0.1), count=77, mass=3.5)  # is taken as it is
    assert dittogym.make_spec("kick", body=body).robot is body
    env = begun(dittogym.TorchEnv(spec, particles="lite"))
    assert env.state.x[0].mean(0).tolist() == pytest.approx([0.1, 0.36], abs=1e-3)
    assert env.env_state.origin[0].tolist() == pytest.approx([0.1 - 0.4, 0.0], abs=1e-3)


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_a_square_robot_in_every_task(task: str) -> None:
    env = tiny(task, 2, body=SQUARE, particles=300)
    observation, info = env.reset(seed=0)
    side = np.sqrt(env.spec.robot.shape.area)
    assert info["split"].tolist() == pytest.approx([side / np.sqrt(6)] * 2, rel=0.03)
    assert info["finite"].all() and (observation[:, 0] > 60).any()
    for _ in range(2):
        _, reward, terminated, _, info = env.step(torch.ones(2, *env.action_shape, dtype=env.dtype))
    assert info["finite"].all() and not terminated.any() and torch.isfinite(reward).all()


def test_a_drawing_in_parts_is_a_warning() -> None:
    with pytest.warns(UserWarning, match="the robot falls apart from the start: its drawing has 2 separate parts"):
        dittogym.make_spec("run", body=np.array([[1, 0, 1]] * 3, bool))


COLOURS = {"black": 0, "white": 255, "red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "grey": 128}


@pytest.mark.parametrize(
    ("colour", "ground"),
    [
        (colour, ground)
        for colour in ("red", "green", "blue", "white", "black")
        for ground in ("black", "white", "grey", "green")
        if colour != ground
    ],
)
def test_the_order_of_colours_does_not_matter(colour: str, ground: str, tmp_path) -> None:
    """Arrays are RGB, OpenCV's BGR; a file is read as OpenCV has it."""
    drawn = np.pad(ELL, 3)[..., None]
    picture = np.where(drawn, COLOURS[colour], np.broadcast_to(COLOURS[ground], 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "drawing.png"), picture[..., ::-1])
    for given in (picture, picture[..., ::-1], picture / 255, tmp_path / "drawing.png"):
        assert np.array_equal(dittogym.make_spec("run", body=given).robot.shape.mask, ELL)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_a_photograph_is_turned_as_its_orientation_says(suffix: str, tmp_path) -> None:
    orientation = Image.Exif()
    orientation[0x0112] = 6  # the camera was held upright: a quarter turn to the right
    drawn = np.kron(np.pad(ELL, 3), np.ones((16, 16), bool))
    picture = Image.fromarray(np.where(drawn[..., None], 0, 255).astype(np.uint8).repeat(3, axis=2))
    picture.save(tmp_path / f"photograph.{suffix}", exif=orientation)
    assert np.array_equal(read_mask(tmp_path / f"photograph.{suffix}", "body", ""), np.rot90(drawn, -1))


def wall(i: tuple[int, int] = (32, 38), *, visible: bool = True):
    return solid("wall", i, (None, 60), visible=visible)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_custom_obstacle_is_felt_seen_and_drawn(make) -> None:
    """A wall ahead of a robot that is thrown to the right: it stops there, and flies on where there is none."""
    reached, seen, drawn = {}, {}, {}
    worlds = {"wall": (wall(), ceiling(119)), "glass": (wall(visible=False),), "none": ()}
    for name, obstacles in worlds.items():
        options = {"particles": 200, "substeps": 50, "render_mode": "rgb_array", "obstacles": list(obstacles)}
        env = make("dittogym/run-coarse-v0", **options)
        observation, _ = env.reset(seed=0, options={"physics": {"gravity": (0.0, 0.0)}})
        seen[name] = observation.reshape(-1, 3, 64, 64)[0, 0]
        drawn[name] = np.asarray(env.render()).reshape(-1, 512, 512, 3)[0]
        env.unwrapped.state.v[..., 0] = 4.0
        for _ in range(8):
            env.step(np.zeros(env.action_space.shape, np.float32))
        reached[name] = float(env.unwrapped.state.x[..., 0].max()) * 128
    assert reached["wall"] < 34 and reached["glass"] == pytest.approx(reached["wall"]) and reached["none"] > 39
    # The crop is 64 nodes wide, around node (11.52, 35.84); a pixel is a node wide.
    column, row = round(35 - 11.52 + 32), round(35.84 + 32 - 50)
    assert seen["wall"][row, column] == 255 and seen["glass"][row, column] == 0 == seen["none"][row, column]
    assert np.array_equal(seen["glass"], seen["none"])
    # The picture shows 0.56 m around the robot's centre, 0.09 m, and from the lower end of the window on.
    x, y = round((35 / 128 - 0.09 + 0.28) / 0.56 * 512), round((1 - 50 / 128 / 0.56) * 512)
    assert np.abs(drawn["wall"][y, x].astype(int) - SOLID).max() < 12
    assert np.abs(drawn["none"][y, x].astype(int) - SOLID).max() > 60
    edge = drawn["glass"][y, x - 24 : x + 25].astype(int)
    assert np.abs(edge - SOLID).max(-1).min() < 40 and np.abs(edge[24] - SOLID).max() > 60  # an outline only


def test_obstacles_of_the_task_are_gone_when_others_are_given() -> None:
    assert tiny("obstacle", obstacles=()).model.solver.rules == ()
    stairs, ground = (tiny("obstacle", obstacles=o) for o in (None, (floor(),)))
    assert not torch.equal(stairs.reset(seed=0)[0], ground.reset(seed=0)[0])


@pytest.mark.parametrize("size", [(0.16, 0.16), (0.32, 0.16), (0.1, 0.3)])
@pytest.mark.parametrize("count", [1, 2, 17, 300, 19600])
def test_a_lattice_of_any_number_of_particles(count: int, size: tuple[float, float]) -> None:
    """All inside, none twice, rows in order, centred, and about equally far from each other in both directions."""
    shape = Lattice((-0.06, 0.16), size)
    x = shape.positions(np.empty((count, 2)))
    relative = (x - shape.corner) / size
    assert x.shape == (count, 2) and (relative > 0).all() and (relative < 1).all()
    assert len(np.unique(x.round(12), axis=0)) == count
    assert (np.diff(x[:, 1]) >= 0).all()
    assert relative[:, 0].mean() == pytest.approx(0.5, abs=1e-9)
    if count >= 300:
        heights, in_row = np.unique(x[:, 1].round(12), return_counts=True)
        assert np.ptp(in_row) <= 1
        assert relative.mean(0) == pytest.approx([0.5, 0.5], abs=0.01)
        spacing = size[0] / in_row.mean(), np.diff(heights).mean()
        assert spacing[0] == pytest.approx(spacing[1], rel=0.1)
    assert np.array_equal(x, shape.positions(np.random.default_rng(0).random((count, 2))))


#: Particles of robot and object in the lite tier; of DIG's soil more than in proportion, which would be 1,333.
LITE = {
    "shapematch": (2000,),
    "run": (2000,),
    "grow": (2000,),
    "kick": (2000, 164),
    "dig": (2000, 3400),
    "obstacle": (2000,),
    "catch": (2000, 200),
    "slot": (2000, 200),
}


def test_lite_counts() -> None:
    assert LITE.keys() == set(TASKS)
    for task, counts in LITE.items():
        spec = dittogym.make_spec(task)
        assert particle_counts(spec, "lite") == counts
        assert tiny(task, particles="lite").num_particles == sum(counts)


@pytest.mark.parametrize("task", TASKS)
def test_mass_and_volume_are_the_same_with_any_number_of_particles(task: str) -> None:
    totals = []
    for particles in ("full", "lite", 150):
        bodies = tiny(task, particles=particles).model.solver.bodies
        totals.append([(body.count * body.mass, body.count * body.volume) for body in bodies])
    assert totals[1] == pytest.approx(np.array(totals[0])) and totals[2] == pytest.approx(np.array(totals[0]))
