"""Pictures of the output of a policy for one observation."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from cfp.agent.actor import Actor
from dittogym.observation import silhouette
from dittogym.render.frame import GROUND, TARGET
from dittogym.render.scene import ROBOT

#: Pictures of every evaluation (TensorBoard only), and what they show.
PICTURES: dict[str, str] = {
    "picture/observation": "what the first training robot shows: red occupancy, green and blue velocity in x and y",
    "picture/action": "the mean action for it, x-muscles left, y-muscles right: red contracts, blue expands",
    "picture/gate": "the gate of a residual actor in the same way: white keeps the coarse action, red replaces it",
}

#: Colour of the robot's pixels outside the target.
MISPLACED = (206, 60, 52)
SIZE = 192  # rows of a picture, pixels


@torch.no_grad()
def policy_pictures(actor: Actor, observation: Tensor) -> dict[str, np.ndarray]:
    """Pictures, uint8 (H, W, 3), of one observation and what an actor makes of it without noise."""
    sample = actor.sample(observation, deterministic=True)
    pictures = {
        "picture/observation": _enlarged(observation[0].permute(1, 2, 0).cpu().numpy()),
        "picture/action": muscles(sample.action[0]),
    }
    if sample.gate is not None:
        pictures["picture/gate"] = muscles(sample.gate[0])
    return pictures


def muscles(image: Tensor) -> np.ndarray:
    """Both channels of an image (2, R, R) in [-1, 1] side by side, from blue through white to red, uint8 (H, W, 3)."""
    values = image.float().clamp(-1, 1).cpu().numpy()
    fading = 1 - np.abs(values)
    colours = np.stack([np.where(values < 0, fading, 1), fading, np.where(values > 0, fading, 1)], axis=-1)
    left, right = (_enlarged((255 * colour).round().astype(np.uint8)) for colour in colours)
    return np.concatenate([left, np.zeros((SIZE, 2, 3), np.uint8), right], axis=1)


def match_pictures(target: np.ndarray, observation: np.ndarray) -> tuple[dict[str, np.ndarray], float]:
    """How well the robot matches a target (64, 64): pictures by name, and the intersection over union.

    Args:
        target: Bool.
        observation: (3, 64, 64) uint8.
    """
    robot = silhouette(torch.from_numpy(observation)[None])[0].numpy()
    layers = {
        "target": [(target, TARGET)],
        "result": [(robot, ROBOT)],
        "overlap": [(target, TARGET), (robot, MISPLACED), (robot & target, ROBOT)],
    }
    pictures = {}
    for name, painted in layers.items():
        pictures[name] = np.full((*target.shape, 3), GROUND, np.uint8)
        for mask, colour in painted:
            pictures[name][mask] = colour
    return pictures, float((robot & target).sum() / (robot | target).sum())


def _enlarged(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(np.ascontiguousarray(pixels), (SIZE, SIZE), interpolation=cv2.INTER_NEAREST))
