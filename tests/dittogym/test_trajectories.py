"""Recorded episodes: they are what happened, and files give them back."""

import dataclasses
import sys

import gymnasium
import numpy as np
import pytest
import torch

import dittogym
from dittogym import trajectories
from dittogym.trajectories import ABOUT, ARRAYS

OPTIONS = {"particles": 100, "substeps": 1}
ID = "dittogym/shapematch-coarse-v0"


def noise(seed=0):
    generator = np.random.default_rng(seed)
    return lambda observation: generator.uniform(-1, 1, (*observation.shape[:-3], 2, 32, 32)).astype(np.float32)


@pytest.fixture(scope="module")
def env():
    return gymnasium.make(ID, **OPTIONS)


@pytest.fixture(scope="module")
def episodes(env):
    return [trajectories.record(env, noise(seed), seed=seed, fields=("x", "v", "C", "F", "Jp")) for seed in (0, 7)]


def assert_same(one, other):
    assert all(getattr(one, name) == getattr(other, name) for name in ABOUT)
    assert one.particles.keys() == other.particles.keys()
    mine, theirs = (
        [getattr(each, name) for name in ARRAYS] + [each.particles[name] for name in one.particles]
        for each in (one, other)
    )
    for array, expected in zip(mine, theirs, strict=True):
        assert array.dtype == expected.dtype and np.array_equal(array, expected)


def test_episode_is_what_the_environment_did(env, episodes):
    episode = episodes[1]
    assert (episode.task, episode.seed, len(episode.rewards)) == ("shapematch", 7, 30)
    observation, _ = env.reset(seed=7)
    for t, action in enumerate(episode.actions):
        assert np.array_equal(observation, episode.observations[t])
        for name, values in episode.particles.items():
            assert np.array_equal(getattr(env.unwrapped.state, name)[0].numpy(), values[t]), name
        observation, reward, terminated, truncated, _ = env.step(action)
        assert reward == episode.rewards[t] and terminated == episode.terminations[t]
    assert truncated and episode.truncations.tolist() == [False] * 29 + [True]
    assert np.array_equal(observation, episode.observations[30]) and episode.particles["x"].shape == (31, 100, 2)


def test_wrappers_that_would_be_ignored_are_refused():
    env = gymnasium.wrappers.TransformReward(gymnasium.make(ID, **OPTIONS), lambda reward: reward / 2)
    with pytest.raises(ValueError, match="env must have no wrappers"):
        trajectories.record(env, noise())
    assert len(trajectories.record(env.unwrapped, noise()).rewards) == 30


def test_time_limits_truncate_what_is_recorded(env):
    limited = gymnasium.make(ID, max_episode_steps=10, **OPTIONS)
    doubly, bare = (gymnasium.wrappers.TimeLimit(each, 4) for each in (limited, dittogym.Env("shapematch", **OPTIONS)))
    own = {"max_steps": 3}
    for given, options, steps in ((limited, {}, 10), (doubly, {}, 4), (bare, {}, 4), (limited, own, 3), (env, {}, 30)):
        episode = trajectories.record(given, noise(), **options)
        assert episode.truncations.tolist() == [False] * (steps - 1) + [True], steps
        assert len(episode.observations) == len(episode.particles["x"]) == steps + 1


def test_episodes_tell_options_of_their_environment(episodes):
    own = episodes[0].environment
    assert (own["particles"], own["substeps"], own["resolution"], own["conditions"]) == ([100], 1, 32, None)
    changed = dittogym.TorchEnv("shapematch", conditions=dittogym.Conditions(latency=(0, np.int64(2))), **OPTIONS)
    other = trajectories.record(changed, noise(), max_steps=1).environment
    assert other["conditions"]["latency"] == [0, 2]
    stiffer = dittogym.TorchEnv("shapematch", **OPTIONS)
    stiffer.reset(seed=0, options={"physics": {"mu": 900.0}})
    assert trajectories.record(stiffer, noise(), max_steps=1).environment["physics"] == ["mu"]


def test_batch_of_one_records_the_same(episodes):
    batch = dittogym.TorchEnv("shapematch", **OPTIONS)
    again = trajectories.record(batch, noise(7), seed=7)
    assert list(again.particles) == ["x", "v"] and np.array_equal(again.particles["x"], episodes[1].particles["x"])
    assert np.array_equal(again.actions, episodes[1].actions) and np.array_equal(again.rewards, episodes[1].rewards)


def test_actions_in_bfloat16_are_recorded():
    env = dittogym.TorchEnv("shapematch", **OPTIONS)
    episode = trajectories.record(env, lambda images: torch.full((1, *env.action_shape), 0.1, dtype=torch.bfloat16))
    assert episode.actions.dtype == np.float32 and (episode.actions == float(torch.tensor(0.1).bfloat16())).all()


def test_archive_gives_the_same_back(episodes, tmp_path):
    path = trajectories.save_episodes(tmp_path / "new" / "episodes.npz", episodes)
    for episode, again in zip(episodes, trajectories.load_episodes(path), strict=True):
        assert_same(again, episode)


def test_minari_gives_the_same_back(env, episodes, tmp_path, monkeypatch):
    pytest.importorskip("h5py")
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    about = {"algorithm_name": "noise", "author": "a", "author_email": "b", "code_permalink": "c", "eval_env": env.spec}
    about["description"] = "Actions without a plan."
    dataset = trajectories.save_minari("dittogym/shapematch/noise-v0", episodes, env, **about)
    assert dataset.total_steps == 60 and (tmp_path / "dittogym/shapematch/noise-v0/data/main_data.hdf5").exists()
    for episode, again in zip(episodes, trajectories.load_minari("dittogym/shapematch/noise-v0"), strict=True):
        assert_same(again, episode)
    read = minari.load_dataset("dittogym/shapematch/noise-v0")  # as its own users read it
    assert np.array_equal(next(read.iterate_episodes()).actions, episodes[0].actions)
    assert read.recover_environment().spec.kwargs["particles"] == 100
    assert read.storage.metadata["description"] == "Actions without a plan."
    with pytest.raises(ValueError, match="env must have task"):
        trajectories.save_minari("a/b-v0", [*episodes, dataclasses.replace(episodes[0], task="run")], env)
    for name, value in (("resolution", 4), ("particles", 90), ("substeps", 2)):
        with pytest.raises(ValueError, match=f"env must have {name}"):
            trajectories.save_minari("a/b-v0", episodes, gymnasium.make(ID, **OPTIONS | {name: value}))
    with pytest.raises(TypeError, match="env must be"):
        trajectories.save_minari("a/b-v0", episodes, None)
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(ImportError, match=r"torchmpm\[minari\]"):
        trajectories.load_minari("a/b-v0")


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04 no", b"\x80\x04K\x05.", None])
def test_other_files_are_refused(content, tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, x=np.ones(3)) if content is None else path.write_bytes(content)
    with pytest.raises(ValueError, match="path must be a dittogym-episodes file of version 2") as error:
        trajectories.load_episodes(path)
    assert "pickle" not in str(error.value)


def test_archive_of_another_version_or_with_pickles_is_refused(episodes, tmp_path):
    path = trajectories.save_episodes(tmp_path / "a.npz", episodes[:1])
    with np.load(path) as archive:
        arrays = dict(archive)
    newer = {"about": np.array(str(arrays["about"]).replace('"version": 2', '"version": 3'))}
    for changed in (newer, {"0/actions": np.array([{}], object)}):
        np.savez(path, **arrays | changed)
        with pytest.raises(ValueError, match="path must be"):
            trajectories.load_episodes(path)


def test_archive_with_a_flipped_bit_is_refused_or_whole(episodes, tmp_path):
    path = trajectories.save_episodes(tmp_path / "a.npz", episodes[:1])
    content, refused = path.read_bytes(), 0
    generator = np.random.default_rng(0)
    for position in generator.choice(len(content), 300, replace=False):
        flipped = content[position] ^ (1 << generator.integers(8))
        path.write_bytes(content[:position] + bytes([flipped]) + content[position + 1 :])
        try:
            (loaded,) = trajectories.load_episodes(path)
        except ValueError as error:
            assert str(path) in str(error)
            refused += 1
        else:
            assert_same(loaded, episodes[0])
    assert refused > 100
