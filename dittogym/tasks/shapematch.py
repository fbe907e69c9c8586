"""SHAPE MATCH: take the shape of a picture, without gravity."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from dittogym.bodies.shapes import Disc
from dittogym.geometry import ceiling, floor
from dittogym.observation.smooth import soft_silhouette
from dittogym.spec import Body, Moment, Outcome, TaskSpec, Weights
from dittogym.targets import TargetLike, load_target

#: A pixel belongs to the robot if its occupancy code reaches this (21 of 64 fine pixels hit).
ON = 80
#: Cost of a pixel that differs.
PIXEL_COST = 0.1
#: Intersection over union that counts as success (our definition).
MATCH = 0.8


def silhouette(observation: Tensor) -> Tensor:
    """Pixels of the robot in an observation (B, 3, 64, 64): (B, 64, 64) bool."""
    return observation[:, 0] >= ON


def judge(moment: Moment, weights: Weights, *, target: np.ndarray) -> Outcome:
    """Count the pixels in which silhouette and target differ; softly, those to expect."""
    wanted = torch.as_tensor(target, device=moment.observation.device)
    if moment.soft:
        expected = (soft_silhouette(moment.observation) - wanted.to(moment.observation)).abs().sum((1, 2))
        return Outcome(terms={"mismatch": -PIXEL_COST * expected})
    robot = silhouette(moment.observation)
    differing = (robot ^ wanted).sum((1, 2)).to(moment.now.com.dtype)
    union = (robot | wanted).sum((1, 2))
    iou = (robot & wanted).sum((1, 2)) / union
    return Outcome(terms={"mismatch": -PIXEL_COST * differing}, success=iou >= MATCH, info={"iou": iou})


def shapematch(target: TargetLike = "star") -> TaskSpec:
    """The task SHAPE MATCH.

    Args:
        target: ``"star"``, ``"I"``, ``"M"``, ``"T"``, the path of an image, or an array; see
            :func:`dittogym.targets.load_target`.
    """
    picture = load_target(target)
    return TaskSpec(
        name="shapematch",
        horizon=30,
        robot=Body(Disc((0.4, 0.5), 0.17), count=16000),
        mu=500.0,
        yield_stress=62.0,
        max_actuation=82.0,
        obstacles=(floor(), ceiling(119)),
        coarse=32,
        fine=64,
        judge=partial(judge, target=picture),
        weights=Weights(alive=23.0),
        target=picture,
    )
