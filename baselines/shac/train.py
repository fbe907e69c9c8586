"""Short-horizon actor-critic: a policy trained by gradients through the simulation (Xu et al., ICLR 2022)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from baselines.common.grid import GridConfig
from baselines.shac.networks import ImageActor, StateActor, StatePolicy, image_critic
from cfp.analytic.config import WindowConfig
from cfp.analytic.critic import BETAS, Critic, mlp
from cfp.analytic.features import StateFeatures
from cfp.analytic.reward import RewardConfig
from cfp.analytic.stateful import Stateful
from cfp.analytic.window import WINDOW_METRICS, Window, WindowCollector, reward_warnings, short_horizon_loss
from cfp.config import RunConfig
from cfp.envs.make import choose_device, make_torch_env
from cfp.envs.seeding import seeded
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.algorithm import Algorithm, Position, Scalars, Sees
from cfp.experiment.folder import start_path
from cfp.experiment.schedules import linear_decay
from cfp.policy import KIND, ActorPolicy, copy_policy, load, policy_for, read_policy
from cfp.presets import ON_SPEED, sac_preset
from cfp.sections import ReportConfig
from cfp.validation import check_at_least

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


@dataclass(frozen=True)
class ShacConfig(WindowConfig, GridConfig):
    """A run of short-horizon actor-critic; num_envs robots learn side by side.

    The environment options say where the policy is evaluated; train_particles, where it is trained.
    """

    algo: str = "shac"
    """Which algorithm."""
    steps: int = 13_000
    """Environment steps of all robots together."""
    sees: Literal["state", "image"] = "state"
    """Input of the policy: the privileged state (matter, deformation, clock), or the image like CFP's."""
    start_from: str | None = None
    """Policy of the image with one stage from which the actor starts, except for its standard deviation."""
    noise: float = 0.1
    """Standard deviation of actions before tanh (an image policy keeps its network's own, about 0.1)."""
    deformation: bool = True
    """A policy of the state sees deformation."""
    clock: bool = True
    """A policy of the state sees a clock."""
    displacement: bool = False
    """A policy of the state sees the robot's displacement since the reset."""

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (self.steps,)

    def ineffective(self) -> dict[str, str]:
        """Parts of the state have no effect where the policy sees the image."""
        parts = {} if self.sees == "state" else dict.fromkeys(("deformation", "clock", "displacement"), "sees state")
        return super().ineffective() | parts

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, steps=self.steps)
        if self.start_from is not None and self.sees != "image":
            raise ConfigError(f"start_from is allowed with sees 'image' only, got sees {self.sees!r}")
        check_at_least(0, noise=self.noise)


class Shac(Stateful, Algorithm):
    """Actor and critic on windows of differentiable simulation.

    The actor maximises the discounted rewards of a window plus the target critic's value of its end, through the
    simulation; the critic learns TD(lambda) targets from the same window.
    """

    sees: ClassVar[Sees] = "state"
    parts = ("actor", "actor_adam", "critic", "collector")
    values = ("generator", "skipped", "skipped_in_a_row")

    def __init__(self, config: ShacConfig, stage: int = 1, start: ActorPolicy | None = None) -> None:
        self.config = config
        self.env = make_torch_env(config.for_training(), config.resolution(stage))
        self.features = StateFeatures(config.deformation, config.clock, config.displacement)
        with seeded(config.seed):
            self.actor, critic = self._make_networks()
        if start is not None:
            assert isinstance(self.actor, ImageActor)
            self.actor.actor.load_state_dict(start.actor.state_dict())
            self.actor.actor.fix_std()
        self.critic = Critic(critic, config)
        trained = [parameter for parameter in self.actor.parameters() if parameter.requires_grad]
        self.actor_adam = torch.optim.Adam(trained, config.learning_rate, BETAS)
        self.skipped, self.skipped_in_a_row = 0, 0
        self.generator = torch.Generator().manual_seed(config.seed)
        self.collector = WindowCollector(self.env, self.observe, config)

    def _make_networks(self) -> tuple[StateActor | ImageActor, nn.Module]:
        grid, device = self.env.action_resolution, self.env.device
        if self.config.sees == "image":
            return ImageActor(grid).to(device), image_critic().to(device)
        size = self.features.size(len(self.env.spec.bodies) - 1)
        return StateActor(size, grid).to(device), mlp(size, 1).to(device)

    def observe(self) -> Tensor:
        """Inputs (B, ...) of the networks in the present state."""
        if self.config.sees == "state":
            return self.features(self.env).float()
        return self.env.soft_observation().float() * (2.0 / 255.0) - 1.0

    def act(self, observation: Tensor) -> Tensor:
        """Actions (B, 2, R, R) with noise for an ``observation`` (B, ...), with the autograd graph of the actor."""
        mean: Tensor = self.actor(observation)
        noise = torch.randn(mean.shape, generator=self.generator).to(mean)
        return (mean + self.config.noise * noise).tanh()

    def update(self) -> Scalars:
        """Learn from one more window; a `NonFiniteError` if actions, or ten gradients in a row, are not finite."""
        config = self.config
        learning_rate = config.learning_rate * linear_decay(self.progress)
        self.actor_adam.param_groups[0]["lr"] = learning_rate
        window = self.collector.collect(self.act, self.critic)
        gradient_norm = self._update_actor(window)
        critic_loss = self.critic.update(window, learning_rate)
        self.num_timesteps += config.window * self.env.num_envs
        return self.collector.scalars(window) | {
            "train/critic_loss": critic_loss,
            "train/gradient_norm": gradient_norm,
            "train/learning_rate": learning_rate,
            "train/skipped": float(self.skipped),
        }

    def _update_actor(self, window: Window) -> float | None:
        """Take one step of Adam; returns the gradient's norm, or None if it was not finite and no step was taken."""
        self.actor_adam.zero_grad()
        short_horizon_loss(window, self.config.gamma).backward()
        self.env.detach()
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

    def row(self) -> Scalars:
        """Scalars of the last update, with the mean return of the episodes that ended since the last row."""
        self.collector.episodes.recent_returns = []
        return self.scalars

    @property
    def policy(self) -> StatePolicy | ActorPolicy:
        """What has been learned so far; a policy of the state must be attached to an environment."""
        deterministic = self.config.report.eval_deterministic
        if isinstance(self.actor, StateActor):
            return StatePolicy(self.actor, self.features, self.config.noise, {"deterministic": deterministic})
        return ActorPolicy(self.actor.spec, deterministic, self.actor.actor)

    @staticmethod
    def preset(task: str, name: str) -> ShacConfig:
        """Defaults of a task: ``quick`` takes minutes and is evaluated with lite particles.

        ``paper`` trains four times as long in smaller steps and is evaluated in the paper's environment. Both train
        with lite particles. RUN and OBSTACLE are trained on speed, the others on their own smooth reward.
        """
        base = sac_preset(task, name)
        quick, on_speed = name == "quick", task in ON_SPEED
        return ShacConfig(
            task=task,
            preset="quick" if quick else "paper",
            steps=13_000 if quick else 52_000,
            learning_rate=1e-3 if quick else 5e-4,
            environment=replace(base.environment, num_envs=4),
            report=ReportConfig(
                eval_every=3200 if quick else 0,
                eval_episodes=3,
                eval_deterministic=base.report.eval_deterministic,
                log_every=320,
            ),
            displacement=not on_speed,
            reward=RewardConfig("speed" if on_speed else "task"),
        )

    @classmethod
    def warnings(cls, config: ShacConfig, folder: Path, first_stage: int) -> list[str]:
        """A reward without gradient."""
        return reward_warnings(config)

    @classmethod
    def initialize(cls, config: ShacConfig, folder: Path) -> Position:
        """Copy the policy from which the actor starts into the folder, if the options name one."""
        if config.start_from is None:
            return Position()
        policy, resolutions = policy_for(config, config.start_from), (config.resolution(1),)
        if policy.spec.resolutions != resolutions:
            raise ConfigError(f"start_from must have the resolutions {resolutions}, got {policy.spec.resolutions}")
        if policy.spec.encoder != "paper":
            raise ConfigError(f"start_from must be a policy with encoder paper, got {policy.spec.encoder}")
        copy_policy(config.start_from, start_path(folder))
        return Position()

    @classmethod
    def create(cls, config: ShacConfig, stage: int, folder: Path) -> Shac:
        """Networks and environment, with the policy from which the actor starts."""
        if config.start_from is None:
            return cls(config)
        algorithm = cls(config, start=load(start_path(folder), choose_device(config.device)))
        algorithm.starts_trained = True
        return algorithm

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy; one of the image becomes a policy of CFP."""
        policy = self.policy
        policy.description = {**description, "sees": self.config.sees}
        if isinstance(policy, ActorPolicy):
            network = {"resolutions": [policy.resolution]}
            policy.description |= {"kind": KIND, "network": network, "trained_by": self.config.algo}
        policy.save(path)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> StatePolicy | ActorPolicy:
        """Load a policy of either kind."""
        return load(path, device) if read_policy(path)[1]["kind"] == KIND else StatePolicy.load(path, device)
