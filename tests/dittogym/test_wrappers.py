"""Wrappers: ours for other resolutions, and Gymnasium's own around our environments."""

import warnings
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from tiny import SMALL, begun, make_vec
from torch.nn.functional import interpolate

from dittogym.wrappers import action_resolution, observation_resolution

NAME = "dittogym/run-coarse-v0"


def single(**options) -> gymnasium.Env:
    return gymnasium.make(NAME, **{**SMALL, **options})


def batch(autoreset_mode: str = "NextStep", **options) -> gymnasium.vector.VectorEnv:
    return make_vec(autoreset_mode=autoreset_mode, **options)


def bicubic(action: np.ndarray, size: int) -> np.ndarray:
    """What is expected of the enlargement: PyTorch's bicubic interpolation, saturated like the muscles."""
    planes = torch.as_tensor(action).reshape(-1, 1, *action.shape[-2:])
    large = interpolate(planes, size=(size, size), mode="bicubic", align_corners=False).clamp(-1.0, 1.0)
    return large.reshape(*action.shape[:-2], size, size).numpy()


@pytest.mark.parametrize("make", [single, batch])
@pytest.mark.parametrize(("size", "pixels"), [(1, 1), (3, 48), (8, 64)])
def test_spaces(make, size: int, pixels: int) -> None:
    env = observation_resolution(action_resolution(make(), size), pixels)
    prefix = "single_" if make is batch else ""
    assert getattr(env, prefix + "action_space") == gymnasium.spaces.Box(-1.0, 1.0, (2, size, size), np.float32)
    assert getattr(env, prefix + "observation_space") == gymnasium.spaces.Box(0, 255, (3, pixels, pixels), np.uint8)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


def test_ranges_and_stacks_of_the_wrappers_inside_are_kept() -> None:
    stacked = observation_resolution(wrappers.FrameStackObservation(single(), 2), 16)
    assert stacked.observation_space == gymnasium.spaces.Box(0, 255, (2, 3, 16, 16), np.uint8)
    assert stacked.observation_space.contains(stacked.reset(seed=0)[0])
    positive = action_resolution(wrappers.RescaleAction(single(), np.float32(0.0), np.float32(2.0)), 4)
    assert positive.action_space == gymnasium.spaces.Box(0.0, 2.0, (2, 4, 4), np.float32)
    assert positive.action(positive.action_space.high) == pytest.approx(np.full((2, 8, 8), 2.0), abs=1e-5)


@pytest.mark.parametrize("size", [1, 3, 4, 8])
def test_actions_are_enlarged_by_bicubic_interpolation(size: int) -> None:
    """A wrapped environment does what the bare one does with the enlarged action; the same for a batch."""
    wrapped, bare = action_resolution(single(), size), single()
    vector, bare_vector = action_resolution(batch(), size), batch()
    for e in (wrapped, bare, vector, bare_vector):
        e.reset(seed=0)
    vector.action_space.seed(0)
    for _ in range(2):
        actions = vector.action_space.sample()
        large = bicubic(actions, 8)
        assert wrapped.action(actions[0]) == pytest.approx(large[0], abs=1e-5)
        assert vector.actions(actions) == pytest.approx(large, abs=1e-5)
        assert bare.action_space.contains(wrapped.action(np.sign(actions[0])))  # although interpolation overshoots
        ours, theirs = wrapped.step(actions[0]), bare.step(large[0])
        assert np.abs(ours[0].astype(int) - theirs[0]).max() <= 1 and ours[1] == pytest.approx(theirs[1], abs=1e-4)
        ours, theirs = vector.step(actions), bare_vector.step(large)
        assert np.abs(ours[0].astype(int) - theirs[0]).max() <= 1 and ours[1] == pytest.approx(theirs[1], abs=1e-4)


@pytest.mark.parametrize("size", [1, 8, 16, 32])
def test_observations_are_area_means(size: int) -> None:
    """Of blocks, rounded; the three channels and the elements of a batch for themselves."""
    for make in (single, batch):
        wrapped, bare = observation_resolution(make(), size), make()
        width = 64 // size
        action = np.ones(bare.action_space.shape, np.float32)
        for ours, whole in ((wrapped.reset(seed=5), bare.reset(seed=5)), (wrapped.step(action), bare.step(action))):
            blocks = whole[0].reshape(*whole[0].shape[:-2], size, width, size, width).astype(float)
            assert np.abs(ours[0] - blocks.mean((-3, -1))).max() <= 0.5
        assert ours[0].std() > 0


# Gymnasium's wrappers.


def test_truth_values_are_those_of_python() -> None:
    """Gymnasium's vector environments would keep NumPy's as objects; its conversions to other arrays refuse them."""
    env = gymnasium.make("dittogym/catch-coarse-v0", **SMALL)
    for info in (env.reset(seed=0)[1], env.step(env.action_space.sample())[4]):
        assert {name for name, value in info.items() if isinstance(value, bool)} == {"finite", "is_success"} & {*info}
        assert not any(isinstance(value, np.bool_) for value in info.values())
    several = begun(gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make("dittogym/catch-coarse-v0", **SMALL)] * 2))
    info = several.step(several.action_space.sample())[4]
    assert info["finite"].dtype == info["is_success"].dtype == bool


@pytest.fixture
def pygame(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pygame's own imports
        return pytest.importorskip("pygame")


def test_the_window_on_the_screen_shows_the_picture(pygame) -> None:
    env = begun(single(render_mode="human"))
    for _ in range(2):
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
        assert np.array_equal(shown[50:], env.unwrapped.torch_env.render()[50:])  # below caption and legend
        env.step(np.ones((2, 8, 8), np.float32))
    assert pygame.display.get_caption()[0] == "dittogym: run" and env.unwrapped.window_open
    env.close()
    assert not pygame.display.get_init() and not env.unwrapped.window_open


def test_the_window_pauses_steps_and_closes(pygame) -> None:
    def press(*keys: int) -> None:
        for key in keys:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))

    env, action = single(render_mode="human"), np.ones((2, 8, 8), np.float32)
    env.reset(seed=0)
    press(pygame.K_SPACE, pygame.K_RIGHT, pygame.K_RIGHT, pygame.K_SPACE)
    for left in (2, 1, 0):  # paused, two single steps, and on
        env.step(action)
        waiting = pygame.event.get(pygame.KEYDOWN)
        assert len(waiting) == left
        press(*(event.key for event in waiting))
    for closing in (pygame.event.Event(pygame.KEYDOWN, key=pygame.K_q), pygame.event.Event(pygame.QUIT)):
        env = begun(single(render_mode="human"))
        pygame.event.post(closing)
        env.step(action)
        assert not env.unwrapped.window_open and not pygame.display.get_init()
        env.step(action)  # the simulation goes on


def test_a_real_video(tmp_path: Path) -> None:
    """What the extra "video" installs is enough for Gymnasium to write a film."""
    pytest.importorskip("moviepy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # moviepy's
        env = begun(wrappers.RecordVideo(single(render_mode="rgb_array", max_episode_steps=3), str(tmp_path)))
        for _ in range(3):
            env.step(np.zeros(env.action_space.shape, np.float32))
        env.close()
    film = cv2.VideoCapture(str(tmp_path / "rl-video-episode-0.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 4
    assert film.read()[1].shape == (512, 512, 3)


def test_observations_of_environments_that_reset_in_the_same_step() -> None:
    plain, whole_size = (batch(autoreset_mode="SameStep", max_episode_steps=2) for _ in range(2))
    small = observation_resolution(whole_size, 16)
    plain.reset(seed=0)
    assert small.reset(seed=0)[0].shape == (2, 3, 16, 16)
    action = np.zeros(plain.action_space.shape, np.float32)
    for _ in range(2):
        whole, reduced = plain.step(action), small.step(action)
    assert reduced[3].all() and small.observation_space.contains(reduced[0])
    for large, little in zip(whole[4]["final_obs"], reduced[4]["final_obs"], strict=True):
        assert np.array_equal(cv2.resize(large[0], (16, 16), interpolation=cv2.INTER_AREA), little[0])
