"""Film, poster and replay of a task, with the policy that comes with the package or a travelling wave."""

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import cfp
import dittogym
from cfp.weights import shipped
from dittogym.render.recording import Recording


def record_task(task: str, seed: int = 0) -> Recording:
    """One episode of a task at the lite tier."""
    policy = cfp.load(task) if task in shipped() else None
    env = dittogym.TorchEnv(task, particles="lite", resolution=policy.resolution if policy else "coarse")
    grid = np.arange(env.action_resolution, dtype=np.float32) / env.action_resolution

    def wave(_: np.ndarray) -> np.ndarray:
        step = float(env.env_state.steps[0])
        column, row = np.meshgrid(grid, grid)
        directions = np.sin(2 * math.pi * (column + 0.15 * step)), np.cos(2 * math.pi * (row - 0.1 * step))
        return np.stack(directions)[None].astype(np.float32)

    with torch.random.fork_rng():
        torch.manual_seed(seed)  # policies act with noise
        return env.film(policy or wave, seed=seed)


def write_media(recording: Recording, stem: Path, size: int = 384) -> None:
    """Write ``stem.webp`` (the film), ``stem.png`` (a picture of it) and ``stem.html`` (the replay)."""
    recording.save(stem.with_suffix(".webp"), size=size, rate=25)
    Image.fromarray(recording.picture(0.6 * recording.duration, size=size)).save(stem.with_suffix(".png"))
    recording.save(stem.with_suffix(".html"))
