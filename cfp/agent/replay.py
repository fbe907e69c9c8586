"""The replay memory, and its copy on disk.

On disk it is a list of chunks: each is written once, and deleted when the ring has passed it.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from cfp.agent.composition import Composition
from cfp.errors import CheckpointError
from cfp.files import write_atomically

FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_COMPRESSED = ("observations", "next_observations")  # images shrink thirtyfold, actions are noise


class ReplayRing(ReplayBuffer):
    """stable-baselines3's replay buffer, drawing batches without repetition from a generator of its own.

    Args:
        buffer_size: As for stable-baselines3's `ReplayBuffer`.
        observation_space: As there.
        action_space: Of the executed actions.
        args: As there.
        seed: Seed of the generator.
        composition: If given, actions are stored as its vectors, and made again when a batch is drawn.
        kwargs: As there.

    Raises:
        ValueError: ``optimize_memory_usage`` is asked for.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        seed: int | None = None,
        composition: Composition | None = None,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("optimize_memory_usage"):  # then next observations would be those of the row after
            raise ValueError(
                "optimize_memory_usage: got True, allowed is False, as batches and checkpoints hold next observations"
            )
        stored = spaces.Box(-np.inf, np.inf, (composition.length,), np.float32) if composition else action_space
        super().__init__(buffer_size, observation_space, stored, *args, **kwargs)
        self.generator = np.random.default_rng(seed)
        self.composition = composition

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch uniformly; a transition occurs twice only if there are fewer than ``batch_size``."""
        stored = self.size() * self.n_envs
        picks = self.generator.choice(stored, batch_size, replace=batch_size > stored)
        row, element = np.divmod(picks, self.n_envs)
        ended = self.dones[row, element] * (1 - self.timeouts[row, element])
        arrays = (
            self._normalize_obs(self.observations[row, element], env),
            self.actions[row, element],
            self._normalize_obs(self.next_observations[row, element], env),
            ended[:, None],
            self._normalize_reward(self.rewards[row, element, None], env),
        )
        # Indexing has copied already.
        batch = ReplayBufferSamples(*(self.to_torch(np.asarray(array), copy=False) for array in arrays))
        if self.composition is None:
            return batch
        return batch._replace(actions=self.composition.rebuild(batch.actions).flatten(1))


@dataclass(frozen=True)
class Chunk:
    """Rows ``start`` to ``stop`` (a row is one batched step), counted from the beginning of the stage."""

    file: str
    start: int
    stop: int


class ReplayArchive:
    """Copies of a replay buffer's rows in a folder.

    A checkpoint names its chunks; a chunk is written before the checkpoint that names it and deleted after the first
    one that does not, so that a crash at any moment leaves every chunk that the last checkpoint needs.

    Args:
        folder: Where the chunks are.
        level: Level of the ladder, part of the file names.
    """

    def __init__(self, folder: Path, level: int) -> None:
        self.folder = folder
        self.level = level
        self.chunks: list[Chunk] = []

    def save(self, buffer: ReplayBuffer, rows: int) -> list[dict[str, Any]]:
        """Write the rows that no chunk has yet, and return the list of chunks for the checkpoint.

        Args:
            buffer: The ring.
            rows: Rows stored since the beginning of the stage, overwritten ones included.
        """
        oldest = max(0, rows - buffer.buffer_size)
        start = max(oldest, self.chunks[-1].stop if self.chunks else 0)
        if start < rows:
            chunk = Chunk(f"level{self.level + 1}-{start:09d}-{rows:09d}.npz", start, rows)
            index = np.arange(start, rows) % buffer.buffer_size
            arrays = {name: getattr(buffer, name)[index] for name in FIELDS}
            write_atomically(self.folder / chunk.file, lambda file: _write_arrays(file, arrays))
            self.chunks.append(chunk)
        self.chunks = [chunk for chunk in self.chunks if chunk.stop > oldest]
        return [asdict(chunk) for chunk in self.chunks]

    def prune(self) -> None:
        """Delete every chunk that the list does not name; call it once the checkpoint is in place."""
        wanted = {chunk.file for chunk in self.chunks}
        if self.folder.is_dir():
            for path in self.folder.iterdir():
                if path.name.startswith("level") and path.name not in wanted:
                    path.unlink()

    def load(self, buffer: ReplayBuffer, rows: int, chunks: list[dict[str, Any]]) -> None:
        """Fill a fresh ring from the chunks that a checkpoint names.

        Raises:
            CheckpointError: A chunk is missing or damaged.
            ValueError: A chunk holds rows of another shape than the ring.
        """
        self.chunks = [Chunk(**chunk) for chunk in chunks]
        oldest = max(0, rows - buffer.buffer_size)
        covered = oldest
        for chunk in self.chunks:
            if Path(chunk.file).name != chunk.file:
                raise CheckpointError(f"{self.folder}: got a chunk {chunk.file!r}, allowed are files in this folder")
            first = max(oldest, chunk.start)
            if first != covered:
                raise CheckpointError(f"{self.folder}: rows {covered} to {first} of the replay memory are missing")
            index = np.arange(first, chunk.stop) % buffer.buffer_size
            for name, values in _read_arrays(self.folder / chunk.file).items():
                ring = getattr(buffer, name)
                if values.shape[1:] != ring.shape[1:]:
                    raise ValueError(f"{chunk.file}: got {name} of shape {values.shape[1:]}, allowed {ring.shape[1:]}")
                ring[index] = values[first - chunk.start :]
            covered = chunk.stop
        if covered != rows:
            raise CheckpointError(f"{self.folder}: rows {covered} to {rows} of the replay memory are missing")
        buffer.pos = rows % buffer.buffer_size
        buffer.full = rows >= buffer.buffer_size


def _write_arrays(file: BinaryIO, arrays: dict[str, np.ndarray]) -> None:
    """Write an npz in which each array is compressed or not."""
    with zipfile.ZipFile(file, "w", compresslevel=1) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED if name in _COMPRESSED else zipfile.ZIP_STORED
            with archive.open(entry, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.ascontiguousarray(array), allow_pickle=False)


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with open(path, "rb") as file, np.load(file) as archive:
            return {name: archive[name] for name in FIELDS}
    except (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise CheckpointError(f"{path}: this part of the replay memory is missing or damaged ({error})") from error
