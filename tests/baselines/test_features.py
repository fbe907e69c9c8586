"""What a policy that sees the state is given, and what it is trained on."""

import math
from dataclasses import replace

import pytest
import torch

from baselines import Shac
from cfp.analytic.critic import CELLS, StateFeatures
from cfp.analytic.window import RADIUS, TOLERANCE, Neighbours, training_reward
from dittogym import TorchEnv
from dittogym.pieces import largest_piece


def reset(task="run", count=500):
    env = TorchEnv(task, particles=count, substeps=10, dtype="float64")
    env.reset(seed=0)
    return env


def rasters(env):
    return StateFeatures(clock=False)(env).view(env.num_envs, -1, CELLS, CELLS)


def test_raster_holds_mass_momentum_and_deformation():
    env, velocity = reset(), torch.tensor([0.3, -0.2], dtype=torch.float64)
    env.state.v[:] = velocity
    picture = rasters(env)
    assert picture.shape == (1, 7, CELLS, CELLS) and picture[0, 0].mean().item() == pytest.approx(1.0)
    assert torch.allclose(picture[0, 1:3], velocity[:, None, None] * picture[0, :1])
    assert picture[0, 3:].abs().max() == 0


def test_raster_does_not_depend_on_the_number_of_particles():
    few, many = rasters(reset(count=2000)), rasters(reset(count="full"))
    assert (few - many).abs().mean() < 0.03 * many.abs().mean() * 7


def test_first_index_of_the_raster_is_along_x():
    env = reset()
    env.state.x[..., 0] += 0.1
    moved = rasters(env)[0, 0]
    along = torch.arange(CELLS, dtype=torch.float64) + 0.5
    place = (moved.sum(1) * along).sum() / moved.sum() - CELLS / 2
    patch = env.spec.patch / env.model.solver.grid.resolution
    assert place.item() == pytest.approx(0.1 / patch * CELLS, abs=1e-6)
    assert (moved.sum(0) * along).sum() / moved.sum() < CELLS / 2


def test_object_clock_and_place_are_added():
    env, features = reset("kick"), StateFeatures(displacement=True)
    row = features(env)
    assert row.shape == (1, features.size(1)) == (1, 10 * CELLS**2 + 6 + 2)
    assert row[0, -8:].tolist() == pytest.approx([1, 1, 1, 0, 0, 0, 0, 0])
    env.step(torch.zeros(1, 2, 8, 8))
    angles = [2 * math.pi / period for period in (8, 4, 2)]
    assert features(env)[0, -8:-2].tolist() == pytest.approx([*map(math.cos, angles), *map(math.sin, angles)], abs=1e-6)


def test_integrity_counts_what_drifts_apart():
    line = torch.linspace(0, 0.1, 11, dtype=torch.float64)
    x = torch.stack((line, torch.zeros(11, dtype=torch.float64)), 1)[None]
    neighbours = Neighbours.find(x)
    assert neighbours.drift(x + 1.0).item() == 0
    torn = x.clone()
    torn[:, 6:, 0] += 0.05
    counted = (neighbours.distance < RADIUS).sum()
    crossing = ((neighbours.neighbours > 5) != (torch.arange(11)[:, None] > 5)) & neighbours.is_close
    wanted = crossing.sum() / counted * (0.05 / RADIUS - TOLERANCE) ** 2
    assert neighbours.drift(torn).item() == pytest.approx(wanted.item())


def paid(moved, **changes):
    """What training pays for a step, with nothing but the changes to its reward."""
    none = {"reward": "task", "split_weight": 0.0, "integrity_weight": 0.0, "reward_scale": 1.0}
    return training_reward(replace(Shac.preset("run", "quick"), **none | changes), *moved)


def test_speed_is_what_is_paid_for():
    env = reset()
    neighbours, before = Neighbours.find(env.state.x), env.env_state.centre
    env.state.v[..., 0] = 0.5
    _, smooth, _, _, info = env.step(torch.zeros(1, 2, 8, 8), soft=True)
    moved = env, before, smooth, info, neighbours
    assert paid(moved, reward="speed").item() == pytest.approx(60 * (info["com"] - before)[0, 0].item() / 0.001)
    assert paid(moved, reward="speed").item() == pytest.approx(30, rel=0.05)
    assert paid(moved) == smooth
    lost = smooth - paid(moved, split_weight=1000.0, split_margin=0.5)
    assert lost.item() == pytest.approx(1000 * (info["split"].item() / env.spec.split_limit - 0.5) ** 2)


def test_torn_off_mass_costs_its_share_in_every_step():
    env = TorchEnv("run", 2, substeps=1, dtype="float64")
    env.reset(seed=0)
    torn = env.state.x[1]
    torn[torn[:, 0] > torn[:, 0].quantile(0.7), 0] += 0.1
    neighbours, before = Neighbours.find(env.state.x), env.env_state.centre
    _, smooth, _, _, info = env.step(torch.zeros(2, 2, 8, 8), soft=True)
    moved = env, before, smooth, info, neighbours
    free, charged = (paid(moved, piece_weight=weight, reward_scale=0.5) for weight in (0.0, 20.0))
    whole, broken = largest_piece(env.state.x, env.env_state.origin)
    assert whole == 1 and broken == pytest.approx(0.7, abs=0.02)
    assert (free - charged).tolist() == pytest.approx([0.0, 0.5 * 20 * (1 - broken)])
