"""Obstacles and task specifications as data."""

import dataclasses
import math

import pytest
import torch

import dittogym
from dittogym.geometry import Obstacle, floor, side_walls, solid


@pytest.mark.parametrize("obstacle", [floor(), solid("box", (60, 66), (None, 24), friction=math.inf), side_walls(60)])
def test_another_friction(obstacle: Obstacle) -> None:
    rules = obstacle.with_friction(0.3).velocity_rules
    assert rules == tuple(dataclasses.replace(rule, friction=0.3) for rule in obstacle.velocity_rules)


def test_open_ends_reach_the_edges_of_the_window() -> None:
    ground = solid("ground", (None, None), (None, 60))
    (box,) = ground.boxes
    assert (box.left, box.right, box.bottom, box.top) == (-math.inf, math.inf, -math.inf, 60 / 128)
    assert [rule.direction for rule in ground.velocity_rules] == ["-y"]
    spec = dataclasses.replace(dittogym.make_spec("shapematch"), obstacles=(ground,))
    env = dittogym.TorchEnv(spec, 1, particles=100, substeps=1)
    image = env.reset(seed=0)[0][0, 0]
    assert (image[-1] == 255).all() and torch.equal(image[-1], env.soft_observation()[0, 0, -1].byte())


def test_specifications_keep_their_values() -> None:
    """Lists that the caller changes later do not reach it."""
    obstacles, boxes = [floor()], list(solid("box", (60, 66), (None, 24)).boxes)
    spec = dataclasses.replace(dittogym.make_spec("run"), obstacles=obstacles)
    box = Obstacle("box", boxes)
    for given in (obstacles, boxes):
        given.append("nonsense")
    assert spec.obstacles == (floor(),) and len(box.boxes) == 1
