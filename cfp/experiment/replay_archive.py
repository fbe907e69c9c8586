"""The replay buffer on disk: chunks that are written once and deleted when the buffer has overwritten their rows."""

from __future__ import annotations

import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from cfp.errors import CheckpointError
from cfp.files import write_atomically
from dittogym.trajectories import ZIP_ERRORS

FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_COMPRESSED = ("observations", "next_observations")  # images shrink thirtyfold, actions are noise


@dataclass(frozen=True)
class Chunk:
    """Rows ``start`` to ``stop`` (a row is one batched step), counted from the beginning of the stage."""

    file: str
    start: int
    stop: int


class ReplayArchive:
    """Copies of a replay buffer's rows in a folder; a crash at any moment leaves those that the last checkpoint needs.

    A chunk is written before the checkpoint that names it and deleted after the first one that does not.
    """

    def __init__(self, folder: Path, stage: int) -> None:
        self.folder, self.stage = folder, stage
        self.chunks: list[Chunk] = []

    def save(self, buffer: ReplayBuffer, rows: int) -> list[dict[str, Any]]:
        """Write the rows that no chunk has yet, and return the list of chunks for the checkpoint."""
        oldest = max(0, rows - buffer.buffer_size)
        start = max(oldest, self.chunks[-1].stop if self.chunks else 0)
        if start < rows:
            chunk = Chunk(f"stage{self.stage}-{start:09d}-{rows:09d}.npz", start, rows)
            index = np.arange(start, rows) % buffer.buffer_size
            arrays = {name: getattr(buffer, name)[index] for name in FIELDS}
            write_atomically(self.folder / chunk.file, lambda file: _write_arrays(file, arrays))
            self.chunks.append(chunk)
        self.chunks = [chunk for chunk in self.chunks if chunk.stop > oldest]
        return [asdict(chunk) for chunk in self.chunks]

    def prune(self) -> None:
        """Delete every chunk that the list does not name; call it once the checkpoint is in place."""
        listed = {chunk.file for chunk in self.chunks}
        for path in self.folder.glob("stage*"):
            if path.name not in listed:
                path.unlink()

    def load(self, buffer: ReplayBuffer, rows: int, chunks: list[dict[str, Any]]) -> None:
        """Fill a fresh ring from the chunks that a checkpoint names."""
        self.chunks = [Chunk(**chunk) for chunk in chunks]
        oldest = stop = max(0, rows - buffer.buffer_size)
        for chunk in self.chunks:
            if (first := max(oldest, chunk.start)) != stop:
                raise CheckpointError(f"{self.folder}: rows {stop} to {first} of the replay buffer are missing")
            stop = chunk.stop
            if Path(chunk.file).name != chunk.file:
                raise CheckpointError(f"{self.folder}: chunks must be files in this folder, got {chunk.file!r}")
            index = np.arange(first, chunk.stop) % buffer.buffer_size
            for name, values in _read_arrays(self.folder / chunk.file).items():
                ring = getattr(buffer, name)
                if values.shape[1:] != ring.shape[1:]:
                    raise ValueError(f"{chunk.file}: {name} must have shape {ring.shape[1:]}, got {values.shape[1:]}")
                ring[index] = values[first - chunk.start :]
        if stop != rows:
            raise CheckpointError(f"{self.folder}: rows {stop} to {rows} of the replay buffer are missing")
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
    except (OSError, ValueError, KeyError, EOFError, MemoryError, *ZIP_ERRORS) as error:
        raise CheckpointError(f"{path}: this part of the replay buffer is missing or damaged ({error})") from error
