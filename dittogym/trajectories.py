"""Episodes as arrays, to learn from: recording them, and storing them in NumPy archives and Minari datasets.

Import the module by its name, ``from dittogym import trajectories``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from dittogym.bodies.positions import MAX_SEED
from dittogym.env import Env
from dittogym.files import ZIP_ERRORS, open_npz, replacing
from dittogym.render.recording import as_function, play
from dittogym.torch_env import TorchEnv
from torchmpm import checks

__all__ = ["Episode", "load_episodes", "load_minari", "record", "save_episodes", "save_minari"]

#: Attributes of :class:`torchmpm.ParticleState`.
FIELDS = ("x", "v", "C", "F", "Jp")
ARRAYS = ("observations", "actions", "rewards", "terminations", "truncations")
ABOUT = ("seed", "task", "environment")
FORMAT, VERSION = "dittogym-episodes", 2


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps of a simulation of N particles.

    Attributes:
        observations: (T + 1, 3, 64, 64) uint8, from the reset to the end.
        actions: (T, 2, R, R), as the policy chose them; they saturate at [-1, 1] after their interpolation.
        rewards: (T,) float64.
        terminations: (T,) bool, whether the task ended the episode in this step.
        truncations: (T,) bool, whether a time limit ended the episode in this step.
        particles: Fields of :class:`torchmpm.ParticleState` at the reset and after each step, by name: ``x``
            (T + 1, N, 2), m, ``v`` (T + 1, N, 2), m/s, and others on request.
        seed: Seed of the reset.
        task: Name of the task.
        environment: Options of the environment, as JSON values. Custom robots and obstacles are not among them, and of
            the constants that ``options["physics"]`` set, only the names are.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    particles: dict[str, np.ndarray]
    seed: int
    task: str
    environment: dict[str, Any]


def record(
    env: Any, policy: Any, seed: int = 0, *, fields: Sequence[str] = ("x", "v"), max_steps: int | None = None
) -> Episode:
    """Reset an environment, play an episode, and record it as arrays.

    The same actions in an environment with the same options give the same episode again, to the last bit on the same
    kind of processor.

    Args:
        env: A :class:`dittogym.TorchEnv` of one simulation, or a Gymnasium environment of this package. Gymnasium's
            time limit may wrap it; other wrappers are refused, as they would have no effect.
        policy: A function of observations or an object with a method ``predict``, see :meth:`dittogym.TorchEnv.film`,
            or, for a Gymnasium environment, :meth:`dittogym.Env.film`.
        seed: Seed of the reset and of the policy's noise, from 0 to 2**32 - 1.
        fields: Which fields of the particles to keep: any of ``"x"``, ``"v"``, ``"C"``, ``"F"`` and ``"Jp"``.
        max_steps: Truncate a longer episode after so many steps; ``None`` for the time limit of ``env``, at most the
            task's horizon.

    Raises:
        TypeError: The environment, the policy or ``fields`` is of another kind.
        ValueError: The environment has more than one simulation or other wrappers, there is no such field, ``seed`` or
            ``max_steps`` is out of range, or the policy returns something else than actions.

    Examples:
        >>> import dittogym, numpy as np
        >>> from dittogym import trajectories
        >>> env = dittogym.TorchEnv("run", particles=300, substeps=10)
        >>> episode = trajectories.record(env, lambda observation: np.zeros((1, 2, 8, 8)), seed=0, max_steps=5)
        >>> episode.observations.shape, episode.particles["x"].shape
        ((6, 3, 64, 64), (6, 300, 2))
    """
    seed = checks.whole("seed", seed, 0, MAX_SEED)  # a file stores it as a number
    inner: Any = env.unwrapped if isinstance(env, gymnasium.Env) else env
    torch_env = inner.torch_env if isinstance(inner, Env) else inner
    if not isinstance(torch_env, TorchEnv):
        raise TypeError(f"env must be a TorchEnv or a Gymnasium environment of this package, got {env!r}")
    limit = _time_limit(env, torch_env.spec.horizon)
    if max_steps is not None:
        limit = min(limit, checks.whole("max_steps", max_steps, 1))
    if torch_env.num_envs != 1:
        raise ValueError(f"env must have 1 simulation, got {torch_env.num_envs}")
    checks.instances("fields", fields, str)
    if unknown := [name for name in fields if name not in FIELDS]:
        raise ValueError(f"fields must be among {', '.join(FIELDS)}, got {', '.join(unknown)}")
    act = inner.acting(policy) if isinstance(inner, Env) else as_function(policy, torch_env)
    observations, actions, ends, states = [], [], [], []
    for images, chosen, end in islice(play(torch_env, act, seed), limit + 1):
        observations.append(images.copy())
        states.append([getattr(torch_env.state, name)[0].cpu().numpy().copy() for name in fields])
        if chosen is not None:
            actions.append(chosen.copy())
            ends.append([value.item() for value in end[:3]])
    rewards, terminations, truncations = (np.array(values) for values in zip(*ends, strict=True))
    truncations[-1] |= len(ends) == limit
    particles = {name: np.stack(values) for name, values in zip(fields, zip(*states, strict=True), strict=True)}
    images, done = np.concatenate(observations), (terminations, truncations)
    options = _options(torch_env) | {"physics": sorted(torch_env.env_state.physics)}
    task, played = torch_env.spec.name, np.concatenate(actions)
    return Episode(images, played, rewards, *done, particles, seed, task, options)


def _options(env: TorchEnv) -> dict[str, Any]:
    """`Episode.environment`."""
    conditions = None if env.conditions is None else asdict(env.conditions)
    return {
        "particles": list(env.model.counts),
        "substeps": env.model.substeps,
        "dt": env.model.solver.dt,
        "dtype": str(env.dtype).removeprefix("torch."),
        "resolution": env.action_resolution,
        "action_layout": env.action_layout,
        "conditions": json.loads(json.dumps(conditions, default=np.generic.item)),
    }


def save_episodes(path: str | os.PathLike[str], episodes: Sequence[Episode]) -> Path:
    """Write episodes to a compressed NumPy archive.

    The archive holds arrays such as ``i/actions`` and ``i/particles/x`` for each episode i, and a JSON string ``about``
    with the seeds, tasks and options of the environments.

    Args:
        path: A file whose name ends in ``.npz``.
        episodes: One or more episodes.

    Returns:
        The path.

    Raises:
        ValueError: The file has another suffix, or there is no episode.
        TypeError: An item is not an :class:`Episode`.
    """
    file = Path(path)
    if file.suffix != ".npz":
        raise ValueError(f"path must end in .npz, got {str(path)!r}")
    _check(episodes)
    arrays: dict[str, Any] = {}
    for i, episode in enumerate(episodes):
        arrays |= {f"{i}/{name}": getattr(episode, name) for name in ARRAYS}
        arrays |= {f"{i}/particles/{name}": values for name, values in episode.particles.items()}
    listed = [
        {name: getattr(episode, name) for name in ABOUT} | {"fields": [*episode.particles]} for episode in episodes
    ]
    about = json.dumps({"format": FORMAT, "version": VERSION, "episodes": listed})
    with replacing(file) as aside:
        np.savez_compressed(aside, about=np.array(about), **arrays)
    return file


def load_episodes(path: str | os.PathLike[str]) -> list[Episode]:
    """Read the episodes that :func:`save_episodes` wrote; nothing is unpickled.

    Args:
        path: The file.

    Returns:
        The episodes.

    Raises:
        ValueError: The file is damaged, or not such a file.
        FileNotFoundError: There is no such file.
    """
    try:
        with open_npz(path) as archive:
            about = json.loads(str(archive["about"]))
            if (about["format"], about["version"]) != (FORMAT, VERSION):
                raise ValueError(f"its format is {about['format']} {about['version']}")
            return [
                Episode(
                    **{name: archive[f"{i}/{name}"] for name in ARRAYS},
                    particles={name: archive[f"{i}/particles/{name}"] for name in episode["fields"]},
                    **{name: episode[name] for name in ABOUT},
                )
                for i, episode in enumerate(about["episodes"])
            ]
    except FileNotFoundError:
        raise
    except (OSError, LookupError, AttributeError, TypeError, ValueError, EOFError, *ZIP_ERRORS) as error:
        form = f"a {FORMAT} file of version {VERSION}"
        raise ValueError(f"path must be {form}, got {str(path)!r} ({error})") from error


def save_minari(dataset_id: str, episodes: Sequence[Episode], env: gymnasium.Env[Any, Any], **metadata: Any) -> Any:
    """Write episodes as a Minari dataset (HDF5), in which the particles are ``infos``. Needs the extra ``minari``.

    Args:
        dataset_id: Name of the dataset, such as ``"dittogym/run/cfp-v0"``; Minari keeps it in the folder that the
            environment variable ``MINARI_DATASETS_PATH`` names.
        episodes: One or more episodes.
        env: The Gymnasium environment of the episodes, whose specification the dataset stores.
        metadata: Further arguments of ``minari.create_dataset_from_buffers``, such as ``algorithm_name``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        ImportError: Minari or h5py is not installed.
        ValueError: There is no episode, or the episodes and the environment are not all of one task with the same
            options.
        TypeError: An item is not an :class:`Episode`, or the environment is not a Gymnasium environment of this
            package.
    """
    minari = _minari()
    _check(episodes)
    inner: Any = getattr(env, "unwrapped", env)
    if not isinstance(inner, Env):
        raise TypeError(f"env must be a Gymnasium environment of this package, got {env!r}")
    own = {"task": inner.torch_env.spec.name, **_options(inner.torch_env)}
    for i, episode in enumerate(episodes):
        for name, value in {"task": episode.task, **episode.environment}.items():
            if value != own.get(name, value):  # physics is given to a reset
                raise ValueError(f"env must have {name} {value} as episodes[{i}], got {own[name]}")
    buffers = [
        minari.data_collector.EpisodeBuffer(
            id=i,
            seed=episode.seed,
            observations=list(episode.observations),
            actions=list(episode.actions.astype(inner.action_space.dtype)),
            rewards=list(episode.rewards),
            terminations=list(episode.terminations),
            truncations=list(episode.truncations),
            infos=dict(episode.particles),
        )
        for i, episode in enumerate(episodes)
    ]
    options = {"data_format": "hdf5", "jpeg_encoding": False, "description": episodes[0].task} | metadata
    dataset = minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **options)
    dataset.storage.update_metadata({"task": episodes[0].task, "environment": json.dumps(episodes[0].environment)})
    return dataset


def load_minari(dataset_id: str) -> list[Episode]:
    """Read the episodes of a Minari dataset that :func:`save_minari` wrote. Needs the extra ``minari``.

    Args:
        dataset_id: Name of the dataset.

    Returns:
        The episodes.

    Raises:
        ImportError: Minari or h5py is not installed.
        FileNotFoundError: There is no such dataset.
    """
    dataset = _minari().load_dataset(dataset_id)
    seeds = [about["seed"] for about in dataset.storage.get_episode_metadata(dataset.episode_indices)]
    about = dataset.storage.metadata
    return [
        Episode(
            **{name: np.asarray(getattr(episode, name)) for name in ARRAYS},
            particles={name: np.asarray(values) for name, values in (episode.infos or {}).items()},
            seed=int(seed),
            task=about["task"],
            environment=json.loads(about["environment"]),
        )
        for episode, seed in zip(dataset.iterate_episodes(), seeds, strict=True)
    ]


def _time_limit(env: Any, limit: int) -> int:
    """The least of the time limits of an environment's wrappers and ``limit``; refuses other wrappers."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, TimeLimit):  # whose specification lacks it where the environment has none
            limit = min(limit, env.get_wrapper_attr("_max_episode_steps"))
        elif not isinstance(env, PassiveEnvChecker | OrderEnforcing):
            instead = "use env.unwrapped, with max_steps for a time limit"
            raise ValueError(f"env must have no wrappers, which would have no part in it, got {env}; {instead}")
        env = env.env
    return limit


def _check(episodes: Sequence[Episode]) -> None:
    checks.instances("episodes", episodes, Episode)
    if not episodes:
        raise ValueError("episodes must hold at least 1 episode, got 0")


def _minari() -> Any:
    """The package Minari, which is an extra."""
    try:
        import h5py  # noqa: F401  (its format)
        import minari
        import minari.data_collector
    except ModuleNotFoundError as error:
        raise ImportError(f"Minari datasets need minari and h5py: pip install 'torchmpm[minari]' ({error})") from error
    return minari
