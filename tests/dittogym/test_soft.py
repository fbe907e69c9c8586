"""The soft observation: its gradient, and how near it is to the image."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from tiny import TASKS, actions, begun, stir, tiny
from torch import Tensor

from dittogym import TorchEnv
from dittogym.core import EnvState, observe, soft_observation
from dittogym.geometry import Box
from dittogym.observation import RASTER, box_fraction, silhouette, soft_silhouette
from dittogym.rewards import features_of


def stirred(task: str, **options: object) -> TorchEnv:
    """Two simulations in motion, a step after the start."""
    env = begun(tiny(task, 2, **options))
    stir(env)
    with torch.no_grad():
        env.step(actions(env, 1)[0])
    return env


def moment(env: TorchEnv, x: Tensor, v: Tensor) -> EnvState:
    """The present moment with particles at ``x`` (B, N, 2), window and centre along with them."""
    state = env.env_state
    particles = replace(state.particles, x=x, v=v)
    com = features_of(particles, env.model.num_robot_particles).com
    origin = env.spec.window.origin(com)
    return replace(state, particles=particles, centre=com, origin=origin)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ["x", "v"])
def test_gradient_against_central_differences(task: str, name: str) -> None:
    """Of pixels and of the silhouette, while the crop follows the robot and obstacles pass by."""
    env = stirred(task)
    draw = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=draw, dtype=torch.float64)

    given = {"x": env.state.x.detach().clone(), "v": 0.3 * env.state.v.detach().clone()}
    weights, others, direction = normal(2, 3, 64, 64), normal(2, 64, 64), normal(*given[name].shape)
    direction = direction + 2.0  # also along with the window

    def loss(value: Tensor) -> Tensor:
        image = soft_observation(env.model, moment(env, **(given | {name: value})))
        return (weights * image).sum() + 100.0 * (others * soft_silhouette(image)).sum()

    leaf = given[name].requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    step = 1e-8 if name == "x" else 1e-6
    with torch.no_grad():
        ahead, behind = (loss(leaf + side * step * direction) for side in (1, -1))
    slope = (gradient * direction).sum().item()
    assert slope == pytest.approx((ahead - behind).item() / (2 * step), rel=1e-5)
    assert abs(slope) > 1.0


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_is_the_image_at_the_lite_tier(task: str) -> None:
    """But for truncation to integers, and half a fine pixel where crop or background move."""
    env = stirred(task)
    image, soft = env.save().observation.double(), env.soft_observation()
    assert soft.shape == image.shape and soft.dtype == env.dtype
    difference = (soft - image).abs()
    assert difference.mean() < 0.45
    assert soft.min() >= 0 and soft.max() <= 255


@pytest.mark.parametrize("task", ["shapematch", "run"])
@torch.no_grad()
def test_silhouette_at_full_size(task: str) -> None:
    """Nearer to the reference's raster of a random layout than that of another layout is."""
    env = begun(TorchEnv(task, 2))
    image = env.save().observation
    on, soft = silhouette(image), soft_silhouette(env.soft_observation())
    wrong = (on ^ (soft > 0.5)).sum((1, 2))
    assert wrong.max() <= 26
    if task == "shapematch":
        assert wrong.max() < (on[0] ^ on[1]).sum()
    assert (soft.sum((1, 2)) / on.sum((1, 2))).tolist() == pytest.approx([1.0, 1.0], abs=0.05)


def test_background_moves_without_steps() -> None:
    """A drawn box, as the window follows the robot: linear between edges of pixels, and near the true picture."""
    env = stirred("obstacle")
    x, v = env.state.x.detach(), env.state.v.detach()
    values = []
    for shift in (0.0, 0.0005, 0.001):
        state = moment(env, x + torch.tensor([shift, 0.0]), v)
        soft = soft_observation(env.model, state)[:, 0]
        image = observe(env.model, state)[:, 0].double()
        values.append(soft)
        assert (soft - image).abs().max() <= 255 / 8 + 1
    changed = [(b - a).abs().sum() for a, b in pairwise(values)]
    assert all(change > 100 for change in changed)


def test_soil_has_no_velocity_and_broken_particles_are_not_seen() -> None:
    env = stirred("dig")
    robot = env.model.num_robot_particles
    x, v = (t.detach().clone().requires_grad_() for t in (env.state.x, env.state.v))
    with torch.no_grad():
        x[0, 3], v[1, 5] = torch.nan, torch.inf
    state = moment(env, x, v)
    state = replace(state, centre=env.env_state.centre, origin=env.env_state.origin)
    image = soft_observation(env.model, state)
    of_x, of_v = torch.autograd.grad(image.square().sum(), (x, v))
    assert image.isfinite().all() and of_x.isfinite().all() and of_v.isfinite().all()
    assert (of_v[:, robot:] == 0).all() and of_v[:, :robot].abs().max() > 0
    assert (of_x[0, 3] == 0).all() and (of_v[1, 5] == 0).all()


def test_boxes_that_touch() -> None:
    """In the same pixel, and at the upper end of the picture; their rule is by left and upper edges of fine pixels."""
    zero, half = torch.zeros(1, 1, dtype=torch.float64), 0.5 / RASTER
    boxes = [Box(-half, 2.25 / 128), Box(2.25 / 128, 4 / 128 - half), Box(bottom=1.0 - 1 / 128 + half)]
    fraction = box_fraction(boxes, torch.zeros(1, 2, dtype=torch.float64), zero, zero)[0]
    assert fraction[0].tolist() == pytest.approx([1.0] * 64)
    assert fraction[1:].tolist() == [pytest.approx([1.0] * 4 + [0.0] * 60)] * 63
