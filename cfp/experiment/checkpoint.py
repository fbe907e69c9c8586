"""Everything a run needs to continue after a stop or a crash: the state file and the replay chunks it names."""

from __future__ import annotations

import json
import pickle
import time
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from cfp.config import RunConfig, to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.algorithm import Algorithm, Position
from cfp.experiment.replay_archive import ReplayArchive
from cfp.files import parse_json, write_atomically
from cfp.from_dict import differences

VERSION = 2
#: What torch raises for damaged files, besides ``pickle.UnpicklingError``.
UNREADABLE = (OSError, RuntimeError, ValueError, LookupError, AttributeError, EOFError)


class Checkpoint:
    """The ``checkpoint`` folder of a run; a crash at any moment leaves the previous checkpoint whole.

    The state file is replaced in one move, and names its replay chunks, which are immutable.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "state.pt"
        self.archive = ReplayArchive(folder / "replay", 1)
        self._before, self._start = 0.0, time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time since this object was made, and of the sessions that led to the checkpoint that was read."""
        return self._before + time.perf_counter() - self._start

    def save(self, algorithm: Algorithm, config: RunConfig, position: Position, evaluation_due: bool = False) -> None:
        """Replace the checkpoint; the next session begins with an evaluation if one is due."""
        state = {
            "version": VERSION,
            "config": json.dumps(to_json(config)),
            "stage": position.stage,
            "offset": position.offset,
            "num_timesteps": algorithm.num_timesteps,
            "seconds": self.seconds,
            "evaluation_due": evaluation_due,
            "algorithm": algorithm.state_dict(),
        }
        if (buffer := algorithm.replay_buffer) is not None:
            if position.stage != self.archive.stage:
                self.archive = ReplayArchive(self.archive.folder, position.stage)
            rows = algorithm.num_timesteps // buffer.n_envs
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
            self._before = float(state["seconds"])
        except (KeyError, TypeError, ValueError) as error:
            raise self.does_not_fit(error) from error
        return state

    def restore(self, algorithm: Algorithm, state: dict[str, Any]) -> None:
        """Put a state into an algorithm that has just been created with the same options."""
        try:
            if algorithm.replay_buffer is not None:
                self.archive = ReplayArchive(self.archive.folder, state["stage"])
                self.archive.load(algorithm.replay_buffer, state["rows"], state["chunks"])
            algorithm.load_state_dict(state["algorithm"])
            algorithm.num_timesteps = state["num_timesteps"]
        except (KeyError, RuntimeError, ValueError, TypeError) as error:
            raise self.does_not_fit(error) from error

    def does_not_fit(self, error: Exception) -> CheckpointError:
        """The error for a state that cannot be put into an algorithm."""
        reason = f"{type(error).__name__}: {error}"
        return CheckpointError(f"{self.path}: the checkpoint does not fit this program ({reason})")


def check_same(stored: dict[str, Any], given: RunConfig) -> None:
    """Refuse to resume a checkpoint with other options than its own, but for those that may change."""
    for name, (old, new) in differences(stored, json.loads(json.dumps(to_json(given)))).items():
        if name not in given.changeable:
            raise ConfigError(
                f"{name.split('.')[-1]}: the run was started with {old!r}, got {new!r}; a resumed run may change only: "
                + ", ".join(each.rpartition(".")[2] for each in given.changeable)
            )
