"""Files of episodes: NumPy archives, and Minari datasets."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import gymnasium
import numpy as np

from dittogym.env import Env
from dittogym.files import replacing
from dittogym.trajectories.episode import Episode
from torchmpm import checks

FORMAT, VERSION = "dittogym-episodes", 1
#: What zipfile raises for damaged archives, besides ``OSError`` and ``EOFError``.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, NotImplementedError)
ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")


def save_episodes(path: str | os.PathLike[str], episodes: Sequence[Episode]) -> Path:
    """Write episodes to a compressed NumPy archive, and return its path.

    The archive holds of each episode i arrays such as ``i/actions`` and ``i/particles/x``, and a JSON string ``about``
    with seeds and tasks.

    Args:
        path: A file ``.npz``.
        episodes: At least one.

    Raises:
        ValueError: The file has another suffix, or there is no episode.
        TypeError: An item is not an :class:`Episode`.
    """
    file = check_archive(path)
    _check(episodes)
    arrays: dict[str, Any] = {}
    for i, episode in enumerate(episodes):
        arrays |= {f"{i}/{name}": getattr(episode, name) for name in ARRAYS}
        arrays |= {f"{i}/particles/{name}": values for name, values in episode.particles.items()}
    listed = [{"seed": episode.seed, "task": episode.task, "fields": list(episode.particles)} for episode in episodes]
    about = json.dumps({"format": FORMAT, "version": VERSION, "episodes": listed})
    with replacing(file) as aside:
        np.savez_compressed(aside, about=np.array(about), **arrays)
    return file


def _check(episodes: Sequence[Episode]) -> None:
    checks.instances("episodes", episodes, Episode)
    if not episodes:
        raise ValueError("episodes must hold at least 1 episode, got 0")


def load_episodes(path: str | os.PathLike[str]) -> list[Episode]:
    """Read what :func:`save_episodes` wrote; nothing is unpickled.

    Args:
        path: The file.

    Raises:
        ValueError: It is damaged, or not such a file.
        OSError: It cannot be opened.
    """
    with open(path, "rb") as file:
        try:
            return _read(file)
        except (OSError, LookupError, AttributeError, TypeError, ValueError, EOFError, *ZIP_ERRORS) as error:
            form = f"a {FORMAT} file of version {VERSION}"
            raise ValueError(f"path must be {form}, got {str(path)!r} ({error})") from error


def _read(file: BinaryIO) -> list[Episode]:
    if file.read(2) != b"PK":  # for other files NumPy recommends to unpickle them
        raise ValueError("it is no npz archive")
    file.seek(0)
    with np.load(file, allow_pickle=False) as archive:
        about = json.loads(str(archive["about"]))
        if (about["format"], about["version"]) != (FORMAT, VERSION):
            raise ValueError(f"its format is {about['format']} {about['version']}")
        return [
            Episode(
                **{name: archive[f"{i}/{name}"] for name in ARRAYS},
                particles={name: archive[f"{i}/particles/{name}"] for name in episode["fields"]},
                seed=episode["seed"],
                task=episode["task"],
            )
            for i, episode in enumerate(about["episodes"])
        ]


def check_archive(path: str | os.PathLike[str]) -> Path:
    """The path of an archive; a ``ValueError`` if it has another suffix than ``.npz``."""
    if Path(path).suffix != ".npz":
        raise ValueError(f"path must end in .npz, got {str(path)!r}")
    return Path(path)


def save_minari(dataset_id: str, episodes: Sequence[Episode], env: gymnasium.Env[Any, Any], **metadata: Any) -> Any:
    """Write episodes as a Minari dataset (HDF5), in which the particles are ``infos``. Needs the extra ``minari``.

    Args:
        dataset_id: Such as ``"dittogym/run/cfp-v0"``; Minari keeps it below ``MINARI_DATASETS_PATH``.
        episodes: At least one.
        env: The Gymnasium environment that they are of, which Minari makes anew from its specification.
        metadata: Further arguments of ``minari.create_dataset_from_buffers``, such as ``algorithm_name``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        ImportError: Minari or h5py is not installed.
        ValueError: There is no episode, or they are of several tasks, or the environment has another task or other
            actions.
        TypeError: An item is not an :class:`Episode`, or the environment is not a Gymnasium environment of this
            package.
    """
    minari = _minari()
    _check(episodes)
    if len(tasks := {episode.task for episode in episodes}) > 1:
        raise ValueError(f"episodes must be of one task, got {', '.join(sorted(tasks))}")
    inner: Any = getattr(env, "unwrapped", env)
    if not isinstance(inner, Env):
        raise TypeError(f"env must be a Gymnasium environment of this package, got {env!r}")
    given = f"{inner.torch_env.spec.name} with actions {inner.action_space.shape}"
    if given != (allowed := f"{episodes[0].task} with actions {episodes[0].actions.shape[1:]}"):
        raise ValueError(f"env must be of task {allowed}, got {given}")
    buffers = [
        minari.data_collector.EpisodeBuffer(
            id=i,
            seed=episode.seed,
            observations=list(episode.observations),
            actions=list(episode.actions),
            rewards=list(episode.rewards),
            terminations=list(episode.terminations),
            truncations=list(episode.truncations),
            infos=dict(episode.particles),
        )
        for i, episode in enumerate(episodes)
    ]
    options = {"data_format": "hdf5", "jpeg_encoding": False, "description": episodes[0].task} | metadata
    dataset = minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **options)
    dataset.storage.update_metadata({"task": episodes[0].task})
    return dataset


def load_minari(dataset_id: str) -> list[Episode]:
    """Read what :func:`save_minari` wrote: the dataset ``dataset_id``. Needs the extra ``minari``."""
    dataset = _minari().load_dataset(dataset_id)
    seeds = [about["seed"] for about in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    task = dataset.storage.metadata["task"]
    return [
        Episode(
            **{name: np.asarray(getattr(episode, name)) for name in ARRAYS},
            particles={name: np.asarray(values) for name, values in (episode.infos or {}).items()},
            seed=int(seed),
            task=task,
        )
        for episode, seed in zip(dataset.iterate_episodes(), seeds, strict=True)
    ]


def _minari() -> Any:
    """The package Minari, which is an extra."""
    try:
        import h5py  # noqa: F401  (its format)
        import minari
        import minari.data_collector
    except ModuleNotFoundError as error:
        raise ImportError(f"Minari datasets need minari and h5py: pip install 'torchmpm[minari]' ({error})") from error
    return minari
