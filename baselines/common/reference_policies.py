"""Floors of a comparison: what a robot earns that rests, twitches at random, or follows a wave. Nothing is learned."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

import cfp
from baselines.common.algorithm import Algorithm, Callback, GridConfig, Sees
from baselines.common.open_loop import OpenLoop
from cfp.config import ReportConfig
from cfp.evaluation.evaluate import Policy
from cfp.weights import fitting, read_policy, write_policy
from dittogym import make_spec
from dittogym.action import Layout, from_grid_layout


@dataclass(frozen=True)
class FloorConfig(GridConfig):
    """A run without learning: one step, one evaluation."""

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (1,)

    def idle(self) -> dict[str, str]:
        """Nothing is learned side by side."""
        return super().idle() | {"environment.num_envs": "algorithms that learn"}


class Floor(Algorithm):
    """A policy that is given, as an algorithm: so it is evaluated, filmed and compared like any other."""

    sees: ClassVar[Sees] = "nothing"

    def __init__(self, config: FloorConfig, level: int = 0, start: Policy | None = None) -> None:
        self.config = config

    @classmethod
    def preset(cls, task: str, name: str) -> FloorConfig:
        """Defaults of a task: ``quick`` is judged at the lite tier, ``paper`` in the paper's environment.

        Raises:
            ConfigError: No such task or preset.
        """
        environment = cfp.preset(task, name).environment
        return FloorConfig(
            algo=cls.name,
            task=task,
            preset="quick" if name == "quick" else "paper",
            environment=replace(environment, num_envs=1),
            report=ReportConfig(1, checkpoint_every=1, log_every=1),
        )

    @cached_property
    def policy(self) -> OpenLoop | RandomActions:
        """The floor; a wave takes longer to make than a step does."""
        return self.make({})

    @abstractmethod
    def make(self, description: dict[str, Any]) -> OpenLoop | RandomActions:
        """The floor, with what it is and comes from."""

    def learn(self, total_timesteps: int, callback: Callback) -> Floor:
        """Count the steps: there is nothing to learn."""
        self.num_timesteps += total_timesteps
        callback({})
        return self

    def save(self, path: Path, description: dict[str, Any]) -> None:
        """Write the floor as a policy."""
        self.make(description).save(path)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> Policy:
        """Load a sequence of actions."""
        return OpenLoop.load(path)

    def state_dict(self) -> dict[str, Any]:
        """Nothing: all follows from the options."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to undo."""


class Zero(Floor):
    """Leaves every muscle slack."""

    name: ClassVar[str] = "zero"

    def make(self, description: dict[str, Any]) -> OpenLoop:
        """A sequence of no actions."""
        size = self.config.resolution(0)
        return OpenLoop(torch.zeros(0, 2, size, size), description)


class Scripted(Floor):
    """Drives every muscle by a moving wave, see `wave`."""

    name: ClassVar[str] = "scripted"

    def make(self, description: dict[str, Any]) -> OpenLoop:
        """The wave, for as long as an episode lasts."""
        steps, size = make_spec(self.config.task).horizon, self.config.resolution(0)
        return OpenLoop(wave(steps, size, self.config.environment.layout), description)


class Random(Floor):
    """Acts at random, see `RandomActions`."""

    name: ClassVar[str] = "random"

    def make(self, description: dict[str, Any]) -> RandomActions:
        """Random actions."""
        return RandomActions(self.config.resolution(0), description)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> RandomActions:
        """Load random actions."""
        return RandomActions.load(path)


def wave(steps: int, size: int, layout: Layout) -> Tensor:
    """The drive by which the reference figures of the tasks were recorded, (T, 2, R, R).

    In step t = 1, 2, ... the muscle of direction c in column x and row y of the action grid, counted to the right and
    upwards, is driven with ``sin(0.3 t + 0.7 x + 1.1 y + 2 c)``, the same in the world for every layout.

    Args:
        steps: T.
        size: R.
        layout: Of the actions.
    """
    t, c, x, y = np.ogrid[1 : steps + 1, 0:2, 0:size, 0:size]
    drive = np.sin(0.3 * t + 0.7 * x + 1.1 * y + 2.0 * c)
    return from_grid_layout(torch.from_numpy(drive.astype(np.float32)), layout)


class RandomActions:
    """Uniform actions in [-1, 1], independent in every cell and step, from torch's generator.

    Args:
        resolution: Action grid R.
        description: What it is and comes from.
    """

    deterministic_by_default = False
    sees_image = False

    def __init__(self, resolution: int, description: dict[str, Any] | None = None) -> None:
        self.resolution = resolution
        self.description = description or {}

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions (B, 2, R, R), or (2, R, R) for one image; ``deterministic`` changes nothing."""
        shape: tuple[int, ...] = (2, self.resolution, self.resolution)
        if not (isinstance(observation, np.ndarray) and observation.ndim == 3):
            shape = (len(observation), *shape)
        return (2.0 * torch.rand(shape) - 1.0).numpy(), state

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        write_policy(path, {}, self.description)

    @classmethod
    def load(cls, path: Path) -> RandomActions:
        """Load what `save` wrote.

        Raises:
            CheckpointError: No such file, a damaged one, or one that is not such a policy.
        """
        _, description = read_policy(path)
        with fitting(path):
            return cls(description["resolution"], description)
