"""What an algorithm must offer to be trained, resumed, evaluated and compared like any other."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import RunConfig
from cfp.envs.make import choose_device
from cfp.evaluation.evaluate import Policy
from cfp.experiment.books import Books
from cfp.experiment.estimate import Cost
from cfp.experiment.process import StopSignals
from cfp.experiment.run import Run
from cfp.experiment.state_file import Position
from cfp.weights import origin
from dittogym import make_spec

Sees = Literal["image", "state", "simulator", "nothing"]
"""What a policy may look at: the observation; all that the simulation knows; the simulator, to plan with; nothing."""

Callback = Callable[[Mapping[str, float | None]], None]
"""Called by `Algorithm.learn` between two updates, with scalars to log by name; raises to stop the training."""


SEEDED = {"environment.resample": "soft actor-critic (cfp, coarse, fine, gnn-*, transformer-*)"}
"""What `RunConfig.idle` says where every episode begins on a layout that is counted from the seed."""

Grid = int | Literal["coarse", "fine"]
"""Action grid R: coarse, fine (the task's), or a number."""


def grid_size(task: str, grid: Grid) -> int:
    """Rows and columns of an action grid in a task."""
    spec = make_spec(task)
    return {"coarse": spec.coarse, "fine": spec.fine}[grid] if isinstance(grid, str) else grid


@dataclass(frozen=True)
class GridConfig(RunConfig):
    """Options of a run on one action grid."""

    grid: Grid = "coarse"
    """Action grid R: coarse, fine (the task's), or a number."""

    def resolution(self, level: int) -> int:
        """Action grid R."""
        return grid_size(self.task, self.grid)

    def idle(self) -> dict[str, str]:
        """Layouts are counted from the seed."""
        return super().idle() | SEEDED


@dataclass(frozen=True)
class Entry:
    """An algorithm in the registry.

    Attributes:
        sees: What its policies look at; their training may use more.
        preset: From task and preset to options.
        open: Opens a run: options, folder, whether to resume, stop signals.
        load: Loads a policy file onto a device.
    """

    sees: Sees
    preset: Callable[[str, str], RunConfig]
    open: Callable[[RunConfig, Path, bool, StopSignals], Run]
    load: Callable[[Path, str], Policy]


class Algorithm(ABC):
    """Trains a policy through one stage of a run; method names are those of stable-baselines3.

    Args:
        config: The run's options.
        level: Index of the stage.
        start: Policy of the stage before, None in the first.

    Attributes:
        num_timesteps: Environment steps taken in this stage.
        period: Environment steps after which the work of learning repeats, for estimates of time.
    """

    name: ClassVar[str]
    sees: ClassVar[Sees] = "image"
    num_timesteps: int = 0
    period: int = 1

    @abstractmethod
    def __init__(self, config: Any, level: int = 0, start: Any = None) -> None: ...

    @staticmethod
    @abstractmethod
    def preset(task: str, name: str) -> RunConfig:
        """Defaults of a task.

        Args:
            task: Its name.
            name: ``"quick"`` or ``"paper"``.

        Raises:
            ConfigError: No such task or preset.
        """

    @classmethod
    def start(cls, config: Any) -> Policy | None:
        """What the first stage of a run begins with, where there is no checkpoint; asked before anything is written.

        Raises:
            CFPError: An option names a policy that cannot be read or does not fit.
        """
        return None

    @abstractmethod
    def learn(self, total_timesteps: int, callback: Callback) -> Algorithm:
        """Take some more environment steps and learn from them.

        Args:
            total_timesteps: How many at least.
            callback: Called between updates, with scalars to log.
        """

    def written(self) -> None:  # noqa: B027  (most scalars tell of the last update only)
        """Called when the latest scalars have become a row of the logs."""

    @property
    @abstractmethod
    def policy(self) -> PolicyPredictor:
        """What has been learned so far."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Choose actions.

        Args:
            observation: (B, 3, 64, 64) uint8.
            state: What the last call returned, None at the beginning; arrays with a leading B.
            episode_start: (B,) bool, which elements begin anew.
            deterministic: Without noise.

        Returns:
            Actions (B, 2, R, R), and the policy's memory for the next step.
        """
        return self.policy.predict(observation, state, episode_start, deterministic)

    @abstractmethod
    def save(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy, see `cfp.weights.write_policy`.

        Args:
            path: The ``.safetensors`` file.
            description: What it is and comes from.
        """

    @classmethod
    @abstractmethod
    def load(cls, path: Path, device: str = "cpu") -> Policy:
        """Load the policy that `save` wrote to ``path``, onto a device."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """All that learning needs to go on, as tensors and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the ``state`` that `state_dict` gave, in an algorithm made with the same options."""

    @classmethod
    def entry(cls) -> Entry:
        """For the registry."""
        return Entry(cls.sees, cls.preset, partial(AlgorithmRun, cls), cls.load)


class AlgorithmRun(Run):
    """Trains an `Algorithm` in its folder, see `cfp.experiment.run.Run`.

    Args:
        kind: Class of the algorithm.
        config: The run's options.
        folder: Its folder.
        resume: Go on from the folder's checkpoint.
        signals: Whether the user wants to stop.
    """

    def __init__(
        self, kind: type[Algorithm], config: RunConfig, folder: Path, resume: bool, signals: StopSignals
    ) -> None:
        self.kind = kind
        self.start: Policy | None = None
        super().__init__(config, folder, resume, signals)

    def begin(self) -> Position:
        """Read the policy that the first stage begins with."""
        self.start = self.kind.start(self.config)
        return super().begin()

    def begins_trained(self, level: int) -> bool:
        """Also where the first stage begins with a policy; a session that goes on from a checkpoint has none."""
        return super().begins_trained(level) or self.start is not None

    def make_model(self, level: int) -> Algorithm:
        """The algorithm at the beginning of a stage."""
        start = self.load(self.folder / f"stage{level}.safetensors") if level else self.start
        return self.kind(self.config, level, start)

    def restore(self, model: Algorithm, state: dict[str, Any]) -> None:
        """Put the state of a checkpoint into an algorithm that has just been made."""
        try:
            model.load_state_dict(state["model"])
        except (KeyError, RuntimeError, ValueError, TypeError) as error:
            raise self.checkpoint.misfit(error) from error
        model.num_timesteps = state["model"]["num_timesteps"]

    def save(self, model: Algorithm) -> None:
        """Write a checkpoint of the algorithm."""
        state = {**model.state_dict(), "num_timesteps": model.num_timesteps}
        self.checkpoint.write(self.config, self.position, {"model": state})

    def keep(self, model: Algorithm, level: int, step: int) -> None:
        """Write the policy as ``policy.safetensors``."""
        model.save(self.folder / "policy.safetensors", origin(self.config, self.kind.name, level, step))

    def learn(self, model: Algorithm, steps: int, books: Books) -> None:
        """Train for some more steps, with the books kept between updates."""
        offset, last, latest = self.position.offset, model.num_timesteps, {}

        def turn(scalars: Mapping[str, float | None]) -> None:
            nonlocal last, latest
            latest = dict(scalars)
            books.advance(model.num_timesteps - last)
            last = model.num_timesteps
            books.turn(offset + last, row)

        def row() -> Mapping[str, float | None]:
            model.written()
            return latest

        books.open(offset + last)
        model.learn(steps, turn)
        books.close(offset + last, row)

    def measure(self, model: Algorithm) -> Cost:
        """Time what the algorithm does in a period; the first time counts as well."""

        class Enough(Exception):
            """The period is over."""

        def stop(_: Mapping[str, float | None]) -> None:
            if model.num_timesteps >= model.period:
                raise Enough

        start = time.perf_counter()
        try:
            model.learn(model.period, stop)
        except Enough:
            pass
        return Cost((time.perf_counter() - start) / max(1, model.num_timesteps))

    def load(self, path: Path) -> Policy:
        """Load a policy of the run."""
        return self.kind.load(path, choose_device(self.config.device))
