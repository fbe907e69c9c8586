"""Draw all tasks in one image: each in its initial state, and below it under a wave of muscle contraction.

Run `python examples/contact_sheet.py tasks.png`.
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
import torch

import dittogym

STEPS = 100
SIZE = 320
#: Without gravity and floor, strong waves tear the robot.
STRENGTH = {"shapematch": 0.5}


def wave(env: dittogym.TorchEnv, t: int) -> torch.Tensor:
    """Actions: a wave to the left in the horizontal muscles, and one downwards in the vertical muscles."""
    row, column = torch.meshgrid(
        *[torch.arange(float(env.action_resolution)) / env.action_resolution] * 2, indexing="ij"
    )
    across, along = torch.sin(2 * math.pi * (column + 0.15 * t)), torch.cos(2 * math.pi * (row - 0.1 * t))
    return STRENGTH.get(env.spec.name, 1.0) * torch.stack((across, along))[None]


def pictures(task: str, particles: str, backend: str) -> tuple[np.ndarray, np.ndarray]:
    """Draw a task in its initial state and after the wave."""
    env = dittogym.TorchEnv(task, particles=particles, backend=backend)
    env.reset(seed=0)
    rest = env.render(size=SIZE)
    with torch.no_grad():
        for t in range(min(STEPS, env.spec.horizon)):
            _, _, terminated, _, info = env.step(wave(env, t))
            if terminated:
                break
    print(f"{task:12s} {t + 1:3d} steps, centre of mass {[round(c, 3) for c in info['com'][0].tolist()]}")
    assert info["finite"].all()
    return rest, env.render(size=SIZE)


def titled(picture: np.ndarray, title: str) -> np.ndarray:
    """Add a line of text above an image."""
    head = np.full((28, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(head, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack((head, picture))


def sheet(particles: str, backend: str) -> np.ndarray:
    """Arrange the images of all tasks, four tasks side by side."""
    columns = []
    for task in dittogym.TASKS:
        rest, driven = pictures(task, particles, backend)
        column = np.vstack((titled(rest, task), driven))
        columns.append(np.pad(column, ((4, 4), (4, 4), (0, 0)), constant_values=255))
    half = len(columns) // 2
    return np.vstack((np.hstack(columns[:half]), np.hstack(columns[half:])))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--particles", default="lite", help="full or lite")
    parser.add_argument("--backend", default="auto", help="of the solver")
    arguments = parser.parse_args()
    image = sheet(arguments.particles, arguments.backend)
    if not cv2.imwrite(str(arguments.out), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
        raise SystemExit(f"out: cannot write {arguments.out}")
