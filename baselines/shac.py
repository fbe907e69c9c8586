"""Short-horizon actor-critic (SHAC; Xu et al., ICLR 2022): a policy trained by gradients through the simulation."""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from baselines.common.grid import GridConfig, long_dt
from baselines.common.policies import StateBasedPolicy, load_network
from cfp.analytic.critic import BETAS, Critic, StateFeatures, mlp
from cfp.analytic.window import WINDOW_METRICS, Window, WindowCollector, reward_warnings, short_horizon_loss
from cfp.config import RunConfig, WindowConfig
from cfp.envs.make import choose_device, make_env, seeded
from cfp.errors import NonFiniteError, check_at_least
from cfp.learner import NetworksPolicy, Sees, UpdateLoop, linear_decay
from cfp.policy import Memory, read_policy, report_mismatch, write_policy
from cfp.presets import ON_SPEED, sac_preset
from cfp.resumable import Resumable
from dittogym import TorchEnv
from dittogym.spec import TaskSpec

#: Updates in a row without a finite gradient after which training gives up.
PATIENCE = 10

#: Every scalar that ``Shac.update`` logs, and what it means.
METRICS: dict[str, str] = {
    **WINDOW_METRICS,
    "train/critic_loss": "mean squared error of the critic in the last of its updates",
    "train/gradient_norm": "norm of the actor's gradient before it is clipped",
    "train/learning_rate": "Adam's step size",
    "train/skipped": "updates without a finite gradient, which were not made",
}


@dataclass(frozen=True, kw_only=True)
class ShacConfig(GridConfig, WindowConfig):
    """Options of short-horizon actor-critic, in which num_envs robots learn side by side.

    The environment options apply to evaluations, train_particles and train_dt to the simulations in training.
    """

    algo: str = "shac"
    """Name of the algorithm."""
    steps: int = 13_000
    """Environment steps of all robots together."""
    noise: float = 0.1
    """Standard deviation of the noise on actions, before tanh."""
    displacement: bool = False
    """The policy observes the robot's displacement since the reset."""

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (self.steps,)

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, steps=self.steps)
        check_at_least(0, noise=self.noise)


class StateActor(nn.Module):
    """Mean action before tanh, (B, 2, R, R), from features (B, D)."""

    def __init__(self, inputs: int, resolution: int) -> None:
        super().__init__()
        self.inputs, self.resolution = inputs, resolution
        self.body = mlp(inputs, 2 * resolution**2)

    def forward(self, features: Tensor) -> Tensor:
        """Mean before tanh."""
        output: Tensor = self.body(features)
        return output.unflatten(1, (2, self.resolution, self.resolution))


class StatePolicy(StateBasedPolicy):
    """A policy that acts on the state of the simulation instead of the image; `baselines.load` returns one.

    It acts in the environment that is given to `attached`. It reads mass, momentum and deformation of the robot, and
    mass and momentum of an object, on 16 x 16 cells of the action patch, and a clock of control steps.

    Args:
        actor: The network.
        features: What it reads of the state.
        noise: Standard deviation of the noise on actions, before tanh.
        description: What it is and where it comes from, see `cfp.policy.Policy.description`.
    """

    def __init__(
        self, actor: StateActor, features: StateFeatures, noise: float, description: dict[str, Any] | None = None
    ) -> None:
        super().__init__(description)
        self.actor, self.features, self.noise = actor, features, noise

    @property
    def resolution(self) -> int:
        """R, rows and columns of its actions."""
        return self.actor.resolution

    @property
    def num_inputs(self) -> int:
        """Number of features that the network takes."""
        return self.actor.inputs

    def num_features(self, spec: TaskSpec) -> int:
        """Number of features of a task."""
        return self.features.size(len(spec.bodies) - 1)

    def _act(self, env: TorchEnv, state: Memory, deterministic: bool) -> tuple[Tensor, Memory]:
        mean = self.actor(self.features(env).float().to(next(self.actor.parameters()).device))
        if not deterministic:
            mean = mean + self.noise * torch.randn_like(mean)
        return mean.tanh(), state

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a file ``.safetensors``, and its description to a file ``.json`` beside it.

        Args:
            path: The file, whose name ends in ``.safetensors``.

        Raises:
            cfp.ConfigError: ``path`` has another suffix, or ``description`` is not complete, as it is for a policy that
                comes from no run.
        """
        own = {"features": dataclasses.asdict(self.features), "noise": self.noise, "inputs": self.actor.inputs}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> StatePolicy:
        """Load a policy that `save` wrote.

        Args:
            path: The file ``.safetensors``, or another form that `cfp.load` takes.
            device: Device of its tensors.

        Raises:
            cfp.CheckpointError: The file is missing, damaged, or not such a policy.
        """
        tensors, description = read_policy(path, device)
        with report_mismatch(path):
            size = description["inputs"], description["resolution"]
            actor = load_network(lambda: StateActor(*size), tensors, device)
            return cls(actor, StateFeatures(**description["features"]), float(description["noise"]), description)


class Shac(Resumable, UpdateLoop):
    """Short-horizon actor-critic (SHAC; Xu et al., ICLR 2022), which acts on the state of the simulation.

    The actor maximises the discounted rewards of a window of control steps plus the target critic's value of its end,
    by gradients through the simulation; the critic learns TD(lambda) targets from the same window. `baselines.fit`
    trains it with evaluations and checkpoints.

    Args:
        policy: ``"NetworksPolicy"``.
        env: A `cfp.TorchVecEnv`, in which it is trained, with the action grid of ``config``.
        config: Options, such as those of ``Shac.preset(task, "quick")``; None only where stable-baselines3 loads a
            saved model.
        stage: The stage, always 1.
        device: Device of the networks, that of the simulation.
        _init_setup_model: Make the networks at once; stable-baselines3 passes False to load a saved model.

    Raises:
        TypeError: ``env`` is not a `cfp.TorchVecEnv`, or ``config`` is None.
    """

    sees: ClassVar[Sees] = "state"
    parts = ("actor", "actor_adam", "critic", "collector")
    values = ("generator", "skipped", "skipped_in_a_row")

    def _setup_model(self) -> None:
        config = self.config
        self.features = StateFeatures(displacement=config.displacement)
        size = self.features.size(len(config.make_spec().bodies) - 1)
        with seeded(config.seed):
            self.actor = StateActor(size, config.resolution(self.stage)).to(self.device)
            critic = mlp(size, 1).to(self.device)
        self.critic = Critic(critic, config)
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), config.learning_rate, BETAS)
        self.skipped, self.skipped_in_a_row = 0, 0
        self.generator = torch.Generator().manual_seed(config.seed)
        networks = {"value": critic, "target": self.critic.target}
        self.policy = NetworksPolicy(self.observation_space, self.action_space, actor=self.actor, **networks)
        if self.env is not None:  # a model can be loaded before it gets one
            self.begin_episodes()

    def begin_episodes(self) -> None:
        """Start new episodes in all elements of the simulation."""
        self.collector = WindowCollector(self.simulation, self.observe, self.config)
        self._last_obs = self.simulation.observation().cpu().numpy()

    def observe(self) -> Tensor:
        """Features (B, D) of the present state."""
        return self.features(self.simulation).float()

    def act(self, observation: Tensor) -> Tensor:
        """Actions (B, 2, R, R) with noise for an ``observation`` (B, D), with the autograd graph of the actor."""
        mean: Tensor = self.actor(observation)
        noise = torch.randn(mean.shape, generator=self.generator).to(mean)
        return (mean + self.config.noise * noise).tanh()

    def update(self) -> bool:
        """Learn from one more window; False if a callback stops the training.

        Raises:
            NonFiniteError: Actions, or ten gradients in a row, are not finite.
        """
        config = self.config
        learning_rate = config.learning_rate * linear_decay(self.progress)
        self.actor_adam.param_groups[0]["lr"] = learning_rate
        window = self.collector.collect(self.act, self.critic, self.after_step)
        self._callback.on_rollout_end()
        if window is None:
            return False
        gradient_norm = self._update_actor(window)
        critic_loss = self.critic.update(window, learning_rate)
        own = {
            "train/critic_loss": critic_loss,
            "train/gradient_norm": gradient_norm,
            "train/learning_rate": learning_rate,
            "train/skipped": float(self.skipped),
        }
        self.record(self.collector.scalars(window) | own)
        return True

    def _update_actor(self, window: Window) -> float | None:
        """Take one step of Adam; returns the gradient's norm, or None if it was not finite and no step was taken."""
        self.actor_adam.zero_grad()
        short_horizon_loss(window, self.config.gamma).backward()
        self.simulation.detach()
        parameters = self.actor_adam.param_groups[0]["params"]
        norm = float(nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm))
        if math.isfinite(norm):
            self.actor_adam.step()
            self.skipped_in_a_row = 0
            return norm
        self.skipped += 1
        self.skipped_in_a_row += 1
        if self.skipped_in_a_row >= PATIENCE:
            raise NonFiniteError(
                f"{PATIENCE} updates in a row had no finite gradient after {self.num_timesteps} environment steps"
            )
        return None

    def log_row(self) -> None:
        """Begin the mean return of the next row."""
        self.collector.episodes.recent_returns = []

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor_adam", "critic.adam"], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self.parts, "generator", "features", "_callback"]

    @property
    def trained_policy(self) -> StatePolicy:
        """What has been learned so far; it must be attached to an environment."""
        description = {"deterministic": self.config.eval_deterministic}
        return StatePolicy(self.actor, self.features, self.config.noise, description)

    @staticmethod
    def preset(task: str, name: str) -> ShacConfig:
        """Defaults of a task: ``quick`` takes minutes and is evaluated with lite particles.

        ``paper`` trains four times as long in smaller steps and is evaluated in the paper's environment. Both train
        with lite particles. RUN and OBSTACLE are trained on speed, the others on their own smooth reward.
        """
        base = sac_preset(task, name)
        quick, on_speed = name == "quick", task in ON_SPEED
        return ShacConfig(
            **(vars(base.environment) | {"num_envs": 4}),
            task=task,
            preset="quick" if quick else "paper",
            steps=13_000 if quick else 52_000,
            learning_rate=1e-3 if quick else 5e-4,
            eval_every=3200 if quick else 0,
            eval_episodes=3,
            eval_deterministic=base.eval_deterministic,
            log_every=320,
            displacement=not on_speed,
            reward="speed" if on_speed else "task",
            train_dt=long_dt(task),
        )

    @classmethod
    def warnings(cls, config: ShacConfig, folder: Path, first_stage: int) -> list[str]:
        """A reward without gradient."""
        return reward_warnings(config)

    @classmethod
    def create(cls, config: ShacConfig, stage: int, folder: Path) -> Shac:
        """Networks and environment."""
        env = make_env(config.for_training(), config.resolution(stage))
        return cls("NetworksPolicy", env, config, stage, choose_device(config.device))

    @classmethod
    def load_policy(cls, path: Path, device: str = "cpu") -> StatePolicy:
        """Load a policy."""
        return StatePolicy.load(path, device)
