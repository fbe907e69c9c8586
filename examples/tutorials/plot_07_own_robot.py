r"""
Use a custom robot
==================

A robot's body can be an image file, an array, or the corners of an outline. This tutorial applies the same actions to
a stool, a ring and a boot in the same task.
"""

# %%
# Bright pixels belong to the robot. The body is scaled to the area of the task's own robot and placed where that one
# stands, so that rewards and limits keep their meaning.

import math
import tempfile
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch

import dittogym

drawing = np.zeros((120, 120), np.uint8)
for corner, opposite in (((10, 30), (110, 60)), ((10, 60), (35, 100)), ((85, 60), (110, 100))):
    cv2.rectangle(drawing, corner, opposite, 255, cv2.FILLED)
folder = tempfile.TemporaryDirectory()
path = Path(folder.name) / "stool.png"
cv2.imwrite(str(path), drawing)

distance = np.hypot(*np.mgrid[-50:51, -50:51])
BODIES = {
    "a file": str(path),
    "an array": (distance < 50) & (distance > 20),
    "an outline": [(0, 0), (5, 0), (5, 2), (2, 2), (2, 5), (0, 5)],
}

# %%
# All of them get the same actions.


def wave(env: dittogym.TorchEnv, step: int) -> torch.Tensor:
    """A wave that travels through the horizontal muscles."""
    column = torch.arange(env.action_resolution) / env.action_resolution
    return 0.5 * torch.sin(2 * math.pi * (column + 0.15 * step)).expand(1, *env.action_shape)


figure, axes = plt.subplots(2, len(BODIES), figsize=(9, 6))
reached = {}
for column, (name, body) in enumerate(BODIES.items()):
    env = dittogym.TorchEnv("run", body=body, particles="lite")
    env.reset(seed=0)
    axes[0, column].imshow(env.render(size=300))
    axes[0, column].set(title=name)
    with torch.no_grad():
        for step in range(40):
            *_, info = env.step(wave(env, step))
    axes[1, column].imshow(env.render(muscles=True, size=300))
    reached[name] = info["displacement"].item()
    assert info["finite"].all()
for axis in axes.flat:
    axis.set(xticks=[], yticks=[])
figure.tight_layout()
print({name: f"{100 * far:.1f} cm" for name, far in reached.items()})

# %%
# The same options work in `gymnasium.make`. A target for SHAPE MATCH can be given in the same forms; its centroid
# should be in the middle of the image, because the observed region is centred on the robot.

row, column = np.mgrid[-32:32, -32:32]
plus = ((abs(row) < 5) & (abs(column) < 16)) | ((abs(column) < 5) & (abs(row) < 16))
match = dittogym.TorchEnv("shapematch", target=plus, particles="lite")
match.reset(seed=0)
*_, info = match.step(torch.zeros(1, *match.action_shape))
figure, axis = plt.subplots(figsize=(3, 3))
axis.imshow(match.render(size=300))
axis.set(xticks=[], yticks=[])
print(f"intersection over union of disc and plus: {info['iou'].item():.2f}")
folder.cleanup()

assert 0.3 < info["iou"].item() < 0.8
assert len(set(reached.values())) == len(BODIES), "the bodies move differently"
