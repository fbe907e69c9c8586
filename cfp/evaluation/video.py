"""A film of one episode, H.264 in MP4, which every browser plays."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import EVALUATION_SEED, RunConfig
from cfp.envs.make import make_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.evaluation.episodes import SeededPolicy, attached
from cfp.policy_protocols import Policy

FRAMES_PER_SECOND = 10


class VideoUnavailable(RuntimeError):
    """The optional packages that write videos are not installed."""


def available() -> bool:
    """Whether the optional packages that write videos are installed."""
    return bool(find_spec("imageio") and find_spec("imageio_ffmpeg"))


def film(config: RunConfig, policy: Policy) -> Iterator[np.ndarray]:
    """Pictures of one episode of a policy as it is evaluated; one made for a single layout is filmed there."""
    seed = policy.description.get("layout", config.seed + EVALUATION_SEED)
    return film_episode(config, policy, policy.resolution, policy.deterministic_by_default, seed)


def film_episode(
    config: RunConfig, policy: PolicyPredictor, size: int, deterministic: bool, seed: int
) -> Iterator[np.ndarray]:
    """Pictures of one episode, uint8 (512, 512, 3), to be taken all at once: the start, then one per step."""
    venv = make_env(config, size, 1).venv
    assert isinstance(venv, TorchVecEnv)
    acting = SeededPolicy(attached(policy, venv), seed)
    venv.seed(seed)
    observation = venv.reset()
    yield venv.torch_env.render(0)
    done, memory, start = False, None, np.array([True])
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        while not done:
            with torch.no_grad():
                action, memory = acting.predict(observation, memory, start, deterministic)
                moves = torch.as_tensor(action, device=venv.torch_env.device)
                seen, _, terminated, truncated, _ = venv.torch_env.step(moves)
            observation, done, start = seen.cpu().numpy(), bool(terminated[0] or truncated[0]), np.array([False])
            yield venv.torch_env.render(0)


def write_video(path: Path, frames: Iterable[np.ndarray]) -> None:
    """Write an MP4 file from one or more pictures, uint8 (H, W, 3), and show the last one a second longer."""
    if not available():
        raise VideoUnavailable("no video: it needs imageio with ffmpeg; pip install 'torchmpm[video]'")
    import imageio.v2 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}.part.mp4")
    options: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 8}
    writer: Any = imageio.get_writer(aside, format="FFMPEG", fps=FRAMES_PER_SECOND, **options)
    try:
        with closing(writer):  # its own `with` leaves ffmpeg running where there is an error
            for frame in frames:
                writer.append_data(frame)
            for _ in range(FRAMES_PER_SECOND):
                writer.append_data(frame)
        os.replace(aside, path)
    except BaseException:  # a simulation that fails, a second Ctrl-C
        aside.unlink(missing_ok=True)
        raise
