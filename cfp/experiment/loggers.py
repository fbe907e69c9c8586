"""Loggers of a run beside its tables: TensorBoard, and optionally Weights & Biases."""

from __future__ import annotations

import importlib
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Image, KVWriter, Logger, TensorBoardOutputFormat, filter_excluded_keys
from torch.utils.tensorboard import SummaryWriter

from cfp.config import RunConfig, to_json
from cfp.errors import ConfigError
from cfp.files import write_text
from cfp.tables import CSVTable
from dittogym.render.film import available

#: Scalars of an evaluation in TensorBoard.
EVALUATION_METRICS: dict[str, str] = {
    "eval/return": "mean undiscounted return of an evaluation's episodes (the column mean of evaluations.csv)",
    "eval/std": "standard deviation of these returns",
    "eval/success": "share of successes among them, where the task defines success",
}


class ProgressTable(KVWriter):
    """A logger output that appends to ``progress.csv``; stable-baselines3's own starts the file anew."""

    def __init__(self, table: CSVTable) -> None:
        self.table = table

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append one row."""
        values = filter_excluded_keys(key_values, key_excluded, "csv")
        self.table.add({"step": step, **{key: values[key] for key in sorted(values)}})

    def close(self) -> None:
        """Nothing is held open."""


class EventFile(TensorBoardOutputFormat):
    """TensorBoard events that, on a resumed run, replace what was logged past the checkpoint."""

    def __init__(self, folder: Path, step: int) -> None:
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=step + 1 if step else None)
        self._is_closed = False


def check_trackers(config: RunConfig) -> None:
    """Refuse options that need a package that is not installed, before anything is written."""
    every, wandb, install = config.video_every, config.wandb, "install it with: pip install 'torchmpm"
    if every and not available():
        raise ConfigError(f"video_every must be 0 without imageio and its ffmpeg, got {every}; {install}[video]'")
    if wandb != "off":
        try:
            importlib.import_module("wandb")
        except ImportError as error:
            message = f"wandb must be 'off' without the package wandb, got {wandb!r}; {install}[wandb]'"
            raise ConfigError(message) from error


class WandbWriter(KVWriter):
    """A logger output to Weights & Biases; a resumed run continues the same curve."""

    def __init__(self, config: RunConfig, folder: Path) -> None:
        self.wandb = importlib.import_module("wandb")
        identity = folder / "wandb-id.txt"
        if not identity.exists():
            write_text(identity, uuid.uuid4().hex[:8])
        self.run = self.wandb.init(
            project=config.wandb_project,
            name=config.name,
            id=identity.read_text().strip(),
            resume="allow",
            mode=config.wandb,
            dir=str(folder),
            config=to_json(config),
        )
        # The steps of a resumed run may begin before the last one that was sent, which its own counter refuses.
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Send one point; what does not exist yet (None) is left out."""
        given = {name: value for name, value in key_values.items() if value is not None}
        images = {name: self.wandb.Image(value.image) for name, value in given.items() if isinstance(value, Image)}
        self.run.log({**given, **images, "step": step})

    def film(self, path: Path, step: int) -> None:
        """Send a video."""
        self.run.log({"video": self.wandb.Video(str(path), format="mp4"), "step": step})

    def close(self) -> None:
        """End the session."""
        self.run.finish()


class Tracker:
    """The places to which a run's rows go besides its tables, and pictures and films that only they take."""

    def __init__(self, config: RunConfig, folder: Path, step: int) -> None:
        self.wandb = WandbWriter(config, folder) if config.wandb != "off" else None
        events = EventFile(folder / "tensorboard", step)
        self.writers: list[KVWriter] = [events, self.wandb] if self.wandb else [events]
        self._logger = Logger(None, self.writers)

    def show(self, step: int, values: Mapping[str, float | np.ndarray | None]) -> None:
        """Write scalars and pictures, uint8 (H, W, 3), at once and without a row in a table."""
        for name, value in values.items():
            self._logger.record(name, Image(value, "HWC") if isinstance(value, np.ndarray) else value)
        self._logger.dump(step)

    def film(self, step: int, path: Path) -> None:
        """Send a video to Weights & Biases, if asked for; TensorBoard takes no files."""
        if self.wandb:
            self.wandb.film(path, step)
