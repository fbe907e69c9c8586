"""What a run needs of a learner beside stable-baselines3's interface, and the stages of the coarse-to-fine policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from cfp.agent.actor import Actor, ActorSpec, SmallEncoder
from cfp.config import RunConfig, StagedConfig
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import ConfigError
from cfp.experiment.cli import StopSignals
from cfp.experiment.folder import policy_path, start_path
from cfp.hub import Shareable
from cfp.policy import (
    KIND,
    ActorPolicy,
    Policy,
    copy_policy,
    load,
    policy_for,
    read_policy,
    report_mismatch,
    write_policy,
)
from dittogym import TorchEnv
from dittogym.render.recording import attached

#: What a policy may look at: the observation; the full state; the simulator, to plan with; nothing.
Sees = Literal["image", "state", "simulator", "nothing"]
#: Values to log by name; None for those that do not exist yet.
Scalars = Mapping[str, float | None]
#: Fraction of the learning rate that is left at the end of a stage.
FINAL_FRACTION = 0.1


class Learner(ABC):
    """Interface of an algorithm: a class whose objects learn one stage of a run.

    It is a stable-baselines3 algorithm as well, or an object with the same ``learn``. The class methods concern the
    whole run; `create` makes the object for a stage. The callbacks that a run passes to ``learn`` log, evaluate and
    write checkpoints when a rollout begins and at the end of a stage; they raise an exception to stop the training.

    Attributes:
        sees: What its policies look at, ``"image"``, ``"state"``, ``"simulator"`` or ``"nothing"``, for tables; their
            training may use more.
        presets: Names of its presets.
        keeps_best: Whether the policy of a run is that of the best evaluation, or else the newest.
        config: Options of the run, a `cfp.config.RunConfig`.
        stage: The stage that it learns, 1 for the first.
        num_timesteps: Environment steps taken in this stage.
        starts_trained: Whether the stage begins with a trained policy, which is evaluated before the first step.
        replay_buffer: Transitions to keep in checkpoints; None for none.
    """

    sees: ClassVar[Sees] = "image"
    presets: ClassVar[tuple[str, ...]] = ("quick", "paper")
    keeps_best: ClassVar[bool] = True
    config: Any
    stage: int = 1
    num_timesteps: int = 0
    starts_trained: bool = False
    replay_buffer: ReplayBuffer | None = None
    #: A method that takes at least a number of environment steps and learns from them, with the arguments of
    #: stable-baselines3's ``learn``.
    learn: Callable[..., Any]

    @property
    def logger(self) -> Logger:
        """Where scalars are logged, a logger of stable-baselines3."""
        raise NotImplementedError

    @staticmethod
    @abstractmethod
    def preset(task: str, name: str) -> RunConfig:
        """Return the default options.

        Args:
            task: A task name, or ``"MODULE:NAME"``.
            name: Name of a preset, one of `presets`.
        """

    @classmethod
    def begin(cls, config: Any, folder: Path) -> tuple[int, int]:
        """Put what a new run needs into its folder.

        Args:
            config: Options of the run.
            folder: Its folder.

        Returns:
            The first stage to learn, and the environment steps of the run that count as taken before it.
        """
        return 1, 0

    @classmethod  # noqa: B027  (most learners need nothing)
    def prepare(cls, config: Any, folder: Path, signals: StopSignals) -> None:
        """Do what precedes the first stage, such as training a teacher.

        Args:
            config: Options of the run.
            folder: Its folder.
            signals: Tells whether the user wants to stop.
        """

    @classmethod
    @abstractmethod
    def create(cls, config: Any, stage: int, folder: Path) -> Learner:
        """Make the learner at the beginning of a stage; if the run is resumed, `load_state_dict` follows.

        Args:
            config: Options of the run.
            stage: The stage, 1 for the first.
            folder: Folder of the run, which holds the policies of earlier stages.
        """

    @classmethod
    def warnings(cls, config: Any, folder: Path, first_stage: int) -> list[str]:
        """Return what a user should know before a training begins, such as stages too short to learn anything.

        Args:
            config: Options of the run.
            folder: Its folder.
            first_stage: The stage with which the run begins.

        Returns:
            Lines to print.
        """
        return []

    @classmethod
    @abstractmethod
    def load_policy(cls, path: Path, device: str = "cpu") -> Policy:
        """Load a policy that `save_policy` wrote.

        Args:
            path: The file ``.safetensors``.
            device: Device of its tensors.
        """

    @abstractmethod
    def set_logger(self, logger: Logger) -> None:
        """Set where scalars are logged, a ``logger`` of stable-baselines3."""

    @property
    def steps_without_change(self) -> int:
        """Environment steps at the beginning of the stage in which the policy does not change yet."""
        return 0

    def log_row(self) -> None:  # noqa: B027
        """Record values for the row of the logs that is about to be written, beside those recorded already."""

    def images(self) -> dict[str, np.ndarray]:
        """Return pictures to log at an evaluation, (H, W, 3) uint8 by name."""
        return {}

    @property
    @abstractmethod
    def trained_policy(self) -> Policy:
        """The policy that has been learned so far."""

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy that has been learned so far, see `cfp.ActorPolicy.save`.

        Args:
            path: The file, whose name ends in ``.safetensors``.
            description: What the run knows of the policy, see `cfp.policy.Policy.description`.
        """
        policy = cast(Shareable, self.trained_policy)
        policy.description = description | policy.description
        policy.save(path)

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return what learning needs to continue besides ``num_timesteps`` and ``replay_buffer``.

        Returns:
            Tensors and plain values by name, for a checkpoint.
        """

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned, in a learner that was made with the same options.

        Args:
            state: Tensors and plain values by name.
        """


class NetworksPolicy(BasePolicy):
    """The networks of an `UpdateLoop`, as the policy that stable-baselines3 saves; the algorithm's ``predict`` acts.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        networks: By name.
    """

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], **networks: nn.Module
    ) -> None:
        super().__init__(observation_space, cast(spaces.Box, action_space), normalize_images=False)
        for name, network in networks.items():
            self.add_module(name, network)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        raise NotImplementedError("call predict of the algorithm, which prepares images or looks at the simulation")


class UpdateLoop(BaseAlgorithm, Learner):
    """A stable-baselines3 algorithm that is neither off-policy nor on-policy: `update` both simulates and learns.

    Subclasses make simulation and networks in ``_setup_model``, and call `after_step` after each control step of all
    robots, in `update`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"NetworksPolicy": NetworksPolicy}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: Any,
        config: Any = None,
        stage: int = 1,
        device: str | torch.device = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        rate = 0.0 if config is None else config.learning_rate
        super().__init__(
            policy, env, rate, device=device, support_multi_env=True, supported_action_spaces=(spaces.Box,)
        )
        self.config, self.stage = config, stage
        self.progress = 0.0
        if _init_setup_model:
            if config is None:
                raise TypeError("config must be the options of a training, such as cfp.preset(task), got None")
            self._setup_model()

    @property
    def simulation(self) -> TorchEnv:
        """The environment in torch, for gradients."""
        env = getattr(self.env, "unwrapped", None)
        if not isinstance(env, TorchVecEnv):  # stable-baselines3 makes another one of a Gymnasium environment
            raise TypeError(f"env must be a TorchVecEnv, got {env!r}")
        simulation: TorchEnv = env.torch_env
        return simulation

    def begin_episodes(self) -> None:
        """Start new episodes in all elements of the simulation."""
        raise NotImplementedError

    def update(self) -> bool:
        """Simulate some control steps and learn from them; False if a callback stops the training."""
        raise NotImplementedError

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> UpdateLoop:
        """Take at least ``total_timesteps`` environment steps, see stable-baselines3; rows are logged by update.

        Rates fall over the steps that the options give the stage, or over those that are taken if they are more, as in
        a second stage that is prolonged.
        """
        resets = reset_num_timesteps or self._last_obs is None  # as `_setup_learn` does
        # Callbacks find the name, which stands for all steps then, among the locals.
        total_timesteps, self._callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if resets:
            self.begin_episodes()
        self._callback.on_training_start(locals(), globals())
        updates, end = 0, max(total_timesteps, self.config.stage_steps(self.stage))
        while self.num_timesteps < total_timesteps:
            self._callback.on_rollout_start()
            self.progress = self.num_timesteps / end
            if not self.update():
                break
            updates += 1
            if log_interval is not None and updates % log_interval == 0:
                self.log_row()
                self.logger.dump(self.num_timesteps)
        self._callback.on_training_end()
        return self

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Act by what has been learned so far, with the signature of stable-baselines3's ``predict``.

        Args:
            observation: Images of the environment; a policy of the state looks at the simulation instead.
            state: Memory of the policy, if it has one.
            episode_start: (B,) bool.
            deterministic: Act without noise.

        Returns:
            Actions, and the memory for the next call.
        """
        policy = self.trained_policy if self.env is None else attached(self.trained_policy, self.simulation)
        actions, memory = policy.predict(observation, state, episode_start, deterministic)
        return actions, memory

    def after_step(self, done: np.ndarray, infos: list[dict[str, Any]]) -> bool:
        """Count a control step of all robots and tell the callbacks; False if one stops the training."""
        self.num_timesteps += len(done)
        self._callback.update_locals({"dones": done, "infos": infos})
        return self._callback.on_step()

    def record(self, scalars: Scalars) -> None:
        """Record values for the next row of the logs."""
        for name, value in scalars.items():
            self.logger.record(name, value)


class CoarseToFine(Learner):
    """Learns the coarse-to-fine policy, each stage over the frozen policy of the coarser one (paper, Section 4.2)."""

    config: StagedConfig
    spec: ActorSpec  # structure of the actor of the stage

    @classmethod
    def begin(cls, config: Any, folder: Path) -> tuple[int, int]:
        """Take the first stages from a policy if the options say so; its steps count as those before its handover."""
        if config.start_from is None:
            return 1, 0
        policy, refine = policy_for(config, config.start_from), config.refine
        stages, resolutions = len(policy.spec.resolutions), config.resolutions
        if policy.spec.resolutions != resolutions[:stages] or (stages == len(resolutions) and not refine):
            rest = "" if refine else ", but not all of them without refine"
            allowed = f"the first resolutions of {resolutions}{rest}"
            raise ConfigError(f"start_from must be a policy of {allowed}, got {policy.spec.resolutions}")
        if policy.spec.encoder != config.encoder:
            raise ConfigError(f"start_from must be a policy with encoder {config.encoder}, got {policy.spec.encoder}")
        spec = replace(policy.spec, fill_missing=config.fill_missing)  # it changes no weights
        if stages > 1 and spec != (allowed_spec := config.actor_spec(stages)):
            raise ConfigError(f"start_from must have networks {allowed_spec}, got {spec}")
        stage = stages if refine else stages + 1
        copy_policy(config.start_from, start_path(folder) if refine else policy_path(folder, stages))
        return stage, (0, *config.ends())[stage - 1]

    @classmethod
    def load_policy(cls, path: Path, device: str = "cpu") -> ActorPolicy:
        """Load a policy."""
        return load(path, device)

    @property
    @abstractmethod
    def trained_actor(self) -> Actor:
        """The actor that is the policy."""

    @property
    def trained_policy(self) -> ActorPolicy:
        """What has been learned so far."""
        return ActorPolicy(self.spec, self.config.eval_deterministic, self.trained_actor)

    @classmethod
    def warm_start(cls, config: Any, stage: int, folder: Path, actor: Actor) -> bool:
        """Copy into a new ``actor`` the trained weights that its stage starts from; False if there are none."""
        device = str(next(actor.parameters()).device)
        if refines(config, folder, stage):
            actor.load_state_dict(load(start_path(folder), device).actor.state_dict())
        elif stage > 1:
            path = policy_path(folder, stage - 1)
            with report_mismatch(path):
                copy_coarse_weights(actor, load(path, device).actor)
        else:
            return False
        return True

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the actor with its frozen coarser stages."""
        own = {"kind": KIND, "trained_by": self.config.algo, "network": asdict(self.spec)}
        write_policy(path, self.trained_actor.state_dict(), description | own)


def copy_coarse_weights(actor: Actor, coarse: Actor) -> None:
    """Copy a trained coarse actor into the new stage above it, and its small encoder too."""
    actor.get_submodule("coarse").load_state_dict(coarse.state_dict())
    if isinstance(actor.encoder, SmallEncoder):  # heads and critics start from trained features
        actor.encoder.load_state_dict(coarse.encoder.state_dict())


def refines(config: Any, folder: Path, stage: int) -> bool:
    """Whether the actor of a stage begins as the one that is refined."""
    start = start_path(folder)
    return config.refine and start.exists() and bool(read_policy(start)[1]["stage"] == stage)


def linear_decay(progress: float, final: float = FINAL_FRACTION) -> float:
    """Factor that falls from 1 to ``final`` along a line as ``progress`` goes from 0 to 1."""
    return 1.0 - (1.0 - final) * progress


def follow(average: nn.Module, module: nn.Module, decay: float) -> None:
    """Move the weights of an exponential ``average`` towards those of a ``module``, by ``1 - decay`` of the way."""
    get_ema_multi_avg_fn(decay)(list(average.parameters()), list(module.parameters()), 1)
