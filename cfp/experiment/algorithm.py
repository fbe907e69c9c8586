"""The interface by which an algorithm is trained, stopped, resumed, evaluated and compared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger

from cfp.config import RunConfig
from cfp.envs.make import choose_device
from cfp.experiment.folder import policy_path
from cfp.experiment.process import StopSignals
from cfp.policy import Policy

#: What a policy may look at: the observation; the full state; the simulator, to plan with; nothing.
Sees = Literal["image", "state", "simulator", "nothing"]

#: Values to log by name; None for those that do not exist yet.
Scalars = Mapping[str, float | None]


@dataclass(frozen=True)
class Position:
    """Where a run stands."""

    stage: int = 1  # in training, 1 is the first
    offset: int = 0  # environment steps that the stages before it took


class Algorithm(ABC):
    """Trains a policy through one stage of a run; method names are those of stable-baselines3.

    The class methods concern the whole run; an object, which `create` makes, is one stage. A subclass implements
    `update`, one turn of the training loop, or `learn`, the whole loop.

    Args:
        config: Options of the run. A subclass with other arguments than these overrides `create`.
        stage: Which stage, 1 is the first.
        start: Policy of the stage before, if there is one.
    """

    sees: ClassVar[Sees] = "image"  # what its policies look at; their training may use more
    presets: ClassVar[tuple[str, ...]] = ("quick", "paper")
    keeps_best: ClassVar[bool] = True  # the policy of a run is that of the best evaluation, otherwise the newest
    num_timesteps: int = 0  # environment steps taken in this stage
    config: Any  # options of the run, a RunConfig
    stage: int = 1  # in training, 1 is the first
    starts_trained: bool = False  # with a policy that is then evaluated before the first step
    finished: bool = False  # whether the stage is over before its last step
    replay_buffer: ReplayBuffer | None = None  # transitions to keep in checkpoints
    logger: Logger
    scalars: Scalars = {}  # of the last update

    @abstractmethod
    def __init__(self, config: Any, stage: int = 1, start: Any = None) -> None: ...

    @staticmethod
    @abstractmethod
    def preset(task: str, name: str) -> RunConfig:
        """Default options for a ``task``; the ``name`` of a preset is one of `presets`."""

    @classmethod
    def initialize(cls, config: Any, folder: Path) -> Position:
        """Put what the first stage of a new run needs into its ``folder``, and return which stage that is."""
        return Position()

    @classmethod  # noqa: B027  (most algorithms need nothing)
    def prepare(cls, config: Any, folder: Path, signals: StopSignals) -> None:
        """Do what precedes the first stage, such as training a teacher; ``signals`` tell whether to stop."""

    @classmethod
    def create(cls, config: Any, stage: int, folder: Path) -> Algorithm:
        """The algorithm at the beginning of a stage, also where a checkpoint is loaded into it later."""
        start = cls.load(policy_path(folder, stage - 1), choose_device(config.device)) if stage > 1 else None
        algorithm = cls(config, stage, start)
        algorithm.starts_trained = stage > 1
        return algorithm

    @classmethod
    def warnings(cls, config: Any, folder: Path, first_stage: int) -> list[str]:
        """One line for each stage, from ``first_stage`` on, that will not train as one may expect."""
        return []

    @classmethod
    @abstractmethod
    def load(cls, path: Path, device: str = "cpu") -> Policy:
        """Load the policy that `save_policy` wrote to ``path``, onto a device."""

    def set_logger(self, logger: Logger) -> None:
        """Set where scalars go."""
        self.logger = logger

    @property
    def steps_without_change(self) -> int:
        """Environment steps at the beginning of the stage in which its policy is not trained yet."""
        return 0

    @property
    def progress(self) -> float:
        """Fraction of the stage that is done, 0 to 1; a stage after one that ended early is longer, and stays at 1."""
        return min(self.num_timesteps / self.config.stage_steps(self.stage), 1.0)

    def learn(self, total_timesteps: int, callback: BaseCallback | None = None) -> Algorithm:
        """Take at least ``total_timesteps`` environment steps and learn from them.

        For the ``callback``, a rollout starts before each update and a step ends after it; it may raise to stop.
        """
        callback = callback or CallbackList([])
        callback.init_callback(cast(BaseAlgorithm, self))
        callback.on_training_start(locals(), globals())
        end = self.num_timesteps + total_timesteps
        while self.num_timesteps < end and not self.finished:
            callback.on_rollout_start()
            self.scalars = self.update()
            callback.on_step()
        callback.on_training_end()
        return self

    def update(self) -> Scalars:
        """Take some environment steps, add them to `num_timesteps`, and learn from them; returns scalars to log."""
        raise NotImplementedError

    def row(self) -> Scalars:
        """Scalars for the next row of the logs, which is being written: those of the last update."""
        return self.scalars

    def images(self) -> dict[str, np.ndarray]:
        """What to show at an evaluation, uint8 (H, W, 3) by name."""
        return {}

    @property
    @abstractmethod
    def policy(self) -> Policy:
        """What has been learned so far."""

    @abstractmethod
    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy and its ``description`` as a ``.safetensors`` file, see `cfp.files.write_policy`."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """All that learning needs to continue besides `num_timesteps` and `replay_buffer`: tensors and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from the ``state`` of `state_dict`, in an algorithm made with the same options."""
