"""The state file of a run's checkpoint: written in one move, read without running code from it."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from cfp.config import RunConfig, to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.files import parse_json, write_atomically
from cfp.from_dict import flatten

VERSION = 1


@dataclass(frozen=True)
class Position:
    """Where a run stands.

    Attributes:
        level: Index of the stage in training, 0 is the first.
        offset: Environment steps that the stages before it took.
    """

    level: int = 0
    offset: int = 0


class StateFile:
    """The ``checkpoint`` folder of a run.

    A crash at any moment leaves the previous checkpoint whole.

    Args:
        folder: ``RUN/checkpoint``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / "state.pt"

    def exists(self) -> bool:
        """Whether a whole checkpoint is there."""
        return self.path.exists()

    def write(self, config: RunConfig, position: Position, content: dict[str, Any]) -> None:
        """Replace the state.

        Args:
            config: The run's options, compared at resume.
            position: Where the run stands.
            content: What the algorithm needs to go on: tensors and plain values by name.
        """
        state = {
            "version": VERSION,
            "config": json.dumps(to_json(config)),
            "level": position.level,
            "offset": position.offset,
            **content,
        }
        packed = BytesIO()  # straight into a file, torch reports a full disk as a fault of its own
        torch.save(state, packed)
        write_atomically(self.path, lambda file: file.write(packed.getbuffer()))

    def load(self) -> dict[str, Any]:
        """Read the state.

        Raises:
            CheckpointError: It is missing, damaged, or of another version.
        """
        try:
            state = torch.load(self.path, map_location="cpu", weights_only=True)
        except FileNotFoundError as error:
            raise CheckpointError(f"{self.path}: there is no checkpoint") from error
        except (OSError, RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError) as error:
            raise CheckpointError(
                f"{self.path}: the checkpoint is damaged ({type(error).__name__}) and cannot be resumed; "
                "the policy.safetensors of the run may still be whole"
            ) from error
        if not isinstance(state, dict) or state.get("version") != VERSION:
            found = state.get("version") if isinstance(state, dict) else type(state).__name__
            raise CheckpointError(f"{self.path}: got checkpoint version {found}, allowed {VERSION}")
        try:
            parse_json(state["config"])
            if min(state["level"], state["offset"], state["model"]["num_timesteps"]) < 0:
                raise ValueError("a count is negative")
        except (KeyError, TypeError, ValueError) as error:
            raise self.misfit(error) from error
        return state

    def misfit(self, error: Exception) -> CheckpointError:
        """What to raise when a state cannot be put into a model."""
        reason = f"{type(error).__name__}: {error}"
        return CheckpointError(f"{self.path}: the checkpoint does not fit this program ({reason})")


def check_same(stored: dict[str, Any], given: RunConfig) -> None:
    """Compare the options of a checkpoint with those of the command that wants to resume it.

    Raises:
        ConfigError: Naming the first option that differs and may not, with both values.
    """
    old, new = flatten(stored), flatten(json.loads(json.dumps(to_json(given))))
    for name in {**old, **new}:
        if name.startswith(given.changeable) or old.get(name) == new.get(name):
            continue
        allowed = ", ".join(option.rstrip(".") for option in given.changeable)
        raise ConfigError(
            f"{name.split('.')[-1]}: the run was started with {old.get(name)!r}, got {new.get(name)!r}; "
            f"a resumed run may change only: {allowed}"
        )
