"""A film of one episode, H.264 in MP4, which every browser plays."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import closing
from importlib.util import find_spec
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import EVALUATION_SEED, RunConfig
from cfp.envs.make import make_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.evaluation.evaluate import SingleThreaded, attached
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
    """Pictures of one episode, uint8 (512, 512, 3): the start, then one per environment step, as they are asked for."""
    venv = make_env(config, size, 1).venv
    assert isinstance(venv, TorchVecEnv)
    acting = SingleThreaded(attached(policy, venv))
    venv.seed(seed)
    observation = venv.reset()
    yield venv.torch_env.render(0)
    devices = list(range(torch.cuda.device_count()))
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        states = _generator_states()
    done, memory, start = False, None, np.array([True])
    while not done:
        assert isinstance(observation, np.ndarray)
        with torch.random.fork_rng(devices=devices), torch.no_grad():  # over before the caller goes on with a picture
            torch.set_rng_state(states[0])
            torch.cuda.set_rng_state_all(states[1])
            action, memory = acting.predict(observation, memory, start, deterministic)
            states = _generator_states()
            seen, _, terminated, truncated, _ = venv.torch_env.step(
                torch.as_tensor(action, device=venv.torch_env.device)
            )
        observation, done, start = seen.cpu().numpy(), bool(terminated[0] or truncated[0]), np.array([False])
        yield venv.torch_env.render(0)


def _generator_states() -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Where torch's generators are, on the CPU and on every CUDA device."""
    return torch.get_rng_state(), torch.cuda.get_rng_state_all()


def write_video(path: Path, frames: Iterable[np.ndarray], hold: int = FRAMES_PER_SECOND) -> None:
    """Write an MP4 file from pictures, uint8 (H, W, 3), and repeat the last one ``hold`` times."""
    if not available():
        raise VideoUnavailable("no video: it needs imageio with ffmpeg; pip install 'torchmpm[video]'")
    import imageio.v2 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}.part.mp4")
    options: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 8}
    writer: Any = imageio.get_writer(aside, format="FFMPEG", fps=FRAMES_PER_SECOND, **options)
    try:
        with closing(writer):  # its own `with` leaves ffmpeg running where there is an error
            for frame in _held(frames, hold):
                writer.append_data(frame)
        os.replace(aside, path)
    except BaseException:  # a simulation that fails, a second Ctrl-C
        aside.unlink(missing_ok=True)
        raise


def _held(frames: Iterable[np.ndarray], hold: int) -> Iterator[np.ndarray]:
    """Pictures, the last of them again and again."""
    last = None
    for last in frames:
        yield last
    if last is not None:
        yield from repeat(last, hold)
