"""Everything a run needs to continue after a stop or a crash: the state file and the replay chunks it names."""

from __future__ import annotations

import json
import pickle
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from torch import Tensor

from cfp.config import RunConfig, differences, to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.files import parse_json, write_atomically
from cfp.learner import Learner
from cfp.sac.replay import FIELDS
from dittogym.files import ZIP_ERRORS, open_npz

VERSION = 4
#: What torch raises for damaged files, besides ``pickle.UnpicklingError``.
UNREADABLE = (OSError, RuntimeError, ValueError, LookupError, AttributeError, EOFError)

#: Transitions in a chunk at most, so that several threads can write what a GPU has collected.
LARGEST_CHUNK = 2**15
#: These threads; each copies a chunk from the GPU.
WRITERS = 8
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
            length = max(1, LARGEST_CHUNK // buffer.n_envs)
            stops = [*range(start + length, rows, length), rows]
            chunks = [
                Chunk(f"stage{self.stage}-{first:09d}-{stop:09d}.npz", first, stop)
                for first, stop in pairwise([start, *stops])
            ]
            with ThreadPoolExecutor(WRITERS) as pool:  # compression leaves Python's lock to the others
                list(pool.map(partial(self._write, buffer), chunks))
            self.chunks += chunks
        self.chunks = [chunk for chunk in self.chunks if chunk.stop > oldest]
        return [asdict(chunk) for chunk in self.chunks]

    def _write(self, buffer: ReplayBuffer, chunk: Chunk) -> None:
        index = np.arange(chunk.start, chunk.stop) % buffer.buffer_size
        arrays = {name: torch.as_tensor(getattr(buffer, name)[index]).cpu().numpy() for name in FIELDS}
        write_atomically(self.folder / chunk.file, lambda file: _write_arrays(file, arrays))

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
                values = values[first - chunk.start :]
                ring[index] = torch.from_numpy(values).to(ring.device) if isinstance(ring, Tensor) else values
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
        with open_npz(path) as archive:
            return {name: archive[name] for name in FIELDS}
    except (OSError, ValueError, KeyError, EOFError, MemoryError, *ZIP_ERRORS) as error:
        raise CheckpointError(f"{path}: this part of the replay buffer is missing or damaged ({error})") from error


class Checkpoint:
    """The ``checkpoint`` folder of a run; a crash at any moment leaves the previous checkpoint whole.

    The state file is replaced in one move, and names its replay chunks, which are immutable.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "state.pt"
        self.archive = ReplayArchive(folder / "replay", 1)

    def save(self, learner: Learner, config: RunConfig, offset: int, evaluation_due: bool = False) -> None:
        """Replace the checkpoint; the next session begins with an evaluation if one is due.

        Args:
            learner: In training, between two updates.
            config: Options of the run.
            offset: Environment steps of the stages before.
            evaluation_due: Whether a signal stopped the training during an evaluation.
        """
        state = {
            "version": VERSION,
            "config": json.dumps(to_json(config)),
            "stage": learner.stage,
            "offset": offset,
            "num_timesteps": learner.num_timesteps,
            "evaluation_due": evaluation_due,
            "learner": learner.state_dict(),
        }
        if (buffer := learner.replay_buffer) is not None:
            if learner.stage != self.archive.stage:
                self.archive = ReplayArchive(self.archive.folder, learner.stage)
            rows = learner.num_timesteps // buffer.n_envs
            state |= {"rows": rows, "chunks": self.archive.save(buffer, rows)}
        packed = BytesIO()  # when it writes into a file, torch reports a full disk as a fault of its own
        torch.save(state, packed)
        write_atomically(self.path, lambda file: file.write(packed.getbuffer()))
        self.archive.prune()

    def read(self) -> dict[str, Any]:
        """Read the state; `CheckpointError` where it is missing, damaged, or of another version."""
        try:
            state = torch.load(self.path, map_location="cpu", weights_only=True)
        except (*UNREADABLE, pickle.UnpicklingError) as error:
            raise CheckpointError(f"{self.path}: the checkpoint is damaged ({type(error).__name__})") from error
        if not isinstance(state, dict) or state.get("version") != VERSION:
            found = state.get("version") if isinstance(state, dict) else type(state).__name__
            raise CheckpointError(f"{self.path}: checkpoint version must be {VERSION}, got {found}")
        try:
            parse_json(state["config"])
            if min(state["stage"] - 1, state["offset"], state["num_timesteps"]) < 0:
                raise ValueError("a count is negative")
        except (KeyError, TypeError, ValueError) as error:
            raise self.does_not_fit(error) from error
        return state

    def restore(self, learner: Learner, state: dict[str, Any]) -> None:
        """Put a state into a learner that has just been created with the same options."""
        try:
            if learner.replay_buffer is not None:
                self.archive = ReplayArchive(self.archive.folder, state["stage"])
                self.archive.load(learner.replay_buffer, state["rows"], state["chunks"])
            learner.load_state_dict(state["learner"])
            learner.num_timesteps = state["num_timesteps"]
        except (KeyError, RuntimeError, ValueError, TypeError) as error:
            raise self.does_not_fit(error) from error

    def does_not_fit(self, error: Exception) -> CheckpointError:
        """The error for a state that cannot be put into a learner."""
        reason = f"{type(error).__name__}: {error}"
        return CheckpointError(f"{self.path}: the checkpoint does not fit this program ({reason})")


def check_same(stored: dict[str, Any], given: RunConfig) -> None:
    """Refuse to resume a checkpoint with other options than its own, but for those that may change."""
    for name, (old, new) in differences(stored, json.loads(json.dumps(to_json(given)))).items():
        if name not in given.changeable:
            raise ConfigError(
                f"{name}: the run was started with {old!r}, got {new!r}; a resumed run may change only: "
                + ", ".join(given.changeable)
            )
