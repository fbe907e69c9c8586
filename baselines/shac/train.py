"""Short-horizon actor-critic: a policy trained by gradients through the simulation (Xu et al., ICLR 2022)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

import cfp
from baselines.common.episodes import Episodes
from baselines.common.grid import GridConfig
from baselines.shac.features import StateFeatures
from baselines.shac.networks import ImageActor, StateActor, StatePolicy, fix_std, image_critic, state_critic
from baselines.shac.reward import RewardConfig
from baselines.shac.rollout import Rollout, Window
from cfp.agent.actor_policy import ActorPolicy
from cfp.config import RunConfig, check_training_layouts
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.algorithm import Algorithm, Scalars, Sees
from cfp.policy import Policy
from cfp.sections import Particles, ReportConfig
from cfp.validation import check_at_least, check_fraction, check_positive
from cfp.weights import KIND, load, policy_for, read_policy, save_policy

BETAS = (0.7, 0.95)
FINAL_RATE = 0.1
"""Share of the learning rate that is left at the end of its straight decay."""
PATIENCE = 10
"""Updates in a row without a finite gradient after which training gives up."""

METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted true return of the episodes that ended since the last row, None for none",
    "train/reward": "mean training reward of a step, before its scale",
    "train/true_reward": "mean true reward of a step, at the particle count of training",
    "train/value": "mean value that the target critic gives to the window's states",
    "train/critic_loss": "mean squared error of the critic in the last of its updates",
    "train/gradient_norm": "norm of the actor's gradient before it is clipped",
    "train/learning_rate": "Adam's step size",
    "train/episodes": "episodes ended in this stage",
    "train/terminated": "those that ended before their time",
    "train/nonfinite": "simulations that were not finite and were reset",
    "train/dropped": "gradients of single actions that were not finite and were left out",
    "train/skipped": "updates without a finite gradient, not made",
}
"""Every scalar that `Shac.update` logs, and what it means."""


@dataclass(frozen=True)
class ShacConfig(GridConfig):
    """A run of short-horizon actor-critic; num_envs robots learn side by side.

    The environment options say how the result is judged; train_particles, where it is trained.
    """

    algo: str = "shac"
    """Which algorithm."""
    steps: int = 13_000
    """Environment steps of all robots together."""
    sees: Literal["state", "image"] = "state"
    """What the policy is given: the privileged state (matter, deformation, clock), or the image like CFP's."""
    start_from: str | None = None
    """Policy of one level on the image, whatever trained it, whose weights the actor begins with, all but its width."""
    train_particles: Particles = "lite"
    """Particles of the simulations that are learned from."""
    window: int = 16
    """Control steps that a gradient reaches back."""
    gamma: float = 0.98
    """Discount factor."""
    td_lambda: float = 0.95
    """Mixes the critic's targets from the window's rewards (1) and single steps (0)."""
    learning_rate: float = 1e-3
    """Adam's step size for actor and critic at the beginning; it falls to a tenth."""
    critic_updates: int = 16
    """Updates of the critic after each window."""
    tau: float = 0.4
    """Share of the critic that goes into its target after each window."""
    max_grad_norm: float = 1.0
    """Largest norm of a gradient, of actor and critic each."""
    noise: float = 0.1
    """Standard deviation of actions before tanh (an image policy keeps its network's own, about 0.1)."""
    max_episode_steps: int = 400
    """Control steps after which an episode of training is cut; the first ones are cut at staggered ages."""
    num_layouts: int = 16
    """Particle layouts that training goes through."""
    deformation: bool = True
    """A policy that sees the state sees deformation."""
    clock: bool = True
    """A policy that sees the state sees a clock."""
    displacement: bool = False
    """A policy that sees the state sees how far it has come."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (self.steps,)

    def ineffective(self) -> dict[str, str]:
        """Which parts of the state are seen, where it is not."""
        parts = {} if self.sees == "state" else dict.fromkeys(("deformation", "clock", "displacement"), "sees state")
        return super().ineffective() | parts

    def check(self) -> None:
        """Check what the types cannot, see `RunConfig.check`."""
        super().check()
        check_at_least(
            1,
            steps=self.steps,
            window=self.window,
            critic_updates=self.critic_updates,
            max_episode_steps=self.max_episode_steps,
            num_layouts=self.num_layouts,
        )
        if self.start_from is not None and self.sees != "image":
            raise ConfigError(f"start_from: got a policy, allowed with sees 'image', got {self.sees!r}")
        check_training_layouts("num_layouts", self.num_layouts, self.environment.num_envs)
        check_fraction(gamma=self.gamma, td_lambda=self.td_lambda, tau=self.tau)
        check_positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        check_at_least(0, noise=self.noise)


class Shac(Algorithm):
    """Actor and critic on windows of differentiable simulation.

    The actor maximises the discounted rewards of a window plus the target critic's value of its end, through the
    simulation; the critic learns TD(lambda) targets from the same window.
    """

    sees: ClassVar[Sees] = "state"

    def __init__(self, config: ShacConfig, stage: int = 1, start: Policy | None = None) -> None:
        self.config = config
        own = replace(config, environment=config.environment.for_training(config.train_particles))
        self.env = make_torch_env(own, config.resolution(stage))
        self.features = StateFeatures(config.deformation, config.clock, config.displacement)
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            torch.manual_seed(config.seed)
            self._make_networks()
        if start is not None:
            assert isinstance(self.actor, ImageActor) and isinstance(start, ActorPolicy)
            self.actor.actor.load_state_dict(start.actor.state_dict())
            fix_std(self.actor.actor)  # the width is not learned: that of the policy would stay
        self.target.load_state_dict(self.critic.state_dict())
        self.target.requires_grad_(False)
        learning = [p for p in self.actor.parameters() if p.requires_grad]
        self.actor_adam = torch.optim.Adam(learning, config.learning_rate, BETAS)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), config.learning_rate, BETAS)
        self.skipped, self.skipped_in_a_row = 0, 0
        episodes = Episodes(self.env, config.seed, config.max_episode_steps, config.num_layouts)
        self.rollout = Rollout(episodes, self.observe, config.reward, config.window, config.noise, config.seed)

    def _make_networks(self) -> None:
        size, device = self.features.size(len(self.env.spec.bodies) - 1), self.env.device
        resolution = self.env.action_resolution
        self.actor: StateActor | ImageActor
        if self.config.sees == "state":
            self.actor = StateActor(size, resolution).to(device)
            critics: list[nn.Module] = [state_critic(size), state_critic(size)]
        else:
            self.actor = ImageActor(resolution).to(device)
            critics = [image_critic(), image_critic()]
        self.critic, self.target = (critic.to(device) for critic in critics)

    @staticmethod
    def preset(task: str, name: str) -> ShacConfig:
        """Defaults of a task: ``quick`` takes minutes and is judged at the lite tier.

        ``paper`` trains four times as long in smaller steps and is judged in the paper's environment. Both train at the
        lite tier. RUN and OBSTACLE are trained on speed, the others on their own smooth reward.

        Raises:
            ConfigError: No such task or preset.
        """
        environment = replace(cfp.preset(task, name).environment, num_envs=4)
        running = task in ("run", "obstacle")
        quick = name == "quick"
        return ShacConfig(
            task=task,
            preset="quick" if quick else "paper",
            steps=13_000 if quick else 52_000,
            learning_rate=1e-3 if quick else 5e-4,
            environment=environment,
            report=ReportConfig(0 if name == "paper" else 3200, 3, task == "shapematch", log_every=320),
            displacement=not running,
            reward=RewardConfig("speed") if running else RewardConfig(),
        )

    @classmethod
    def initial_policy(cls, config: ShacConfig) -> ActorPolicy | None:
        """The policy that the actor begins with, if the options name one."""
        if config.start_from is None:
            return None
        policy, wanted = policy_for(config, config.start_from), (config.resolution(1),)
        if policy.spec.resolutions != wanted:
            raise ConfigError(f"start_from: got a policy of levels {policy.spec.resolutions}, allowed {wanted}")
        return policy

    def observe(self) -> Tensor:
        """What the networks are given for the present state, (B, ...)."""
        if self.config.sees == "state":
            return self.features(self.env).float()
        return self.env.soft_observation().float() * (2.0 / 255.0) - 1.0

    def value(self, critic: nn.Module, seen: Tensor) -> Tensor:
        """Values (B,) that a ``critic`` gives to what is ``seen``, (B, ...)."""
        value: Tensor = critic(seen)[..., 0] / max(1.0 - self.config.gamma, 1e-2)
        return value

    @property
    def policy(self) -> StatePolicy | ActorPolicy:
        """What has been learned so far; one that sees the state must be shown an environment."""
        return self._policy({"deterministic": self.config.report.eval_deterministic})

    def _policy(self, description: dict[str, Any]) -> StatePolicy | ActorPolicy:
        if isinstance(self.actor, StateActor):
            return StatePolicy(self.actor, self.features, self.config.noise, description)
        policy = ActorPolicy(self.actor.spec, self.config.report.eval_deterministic)
        policy.actor.load_state_dict(self.actor.actor.state_dict())
        return policy.to(self.env.device)

    def attached(self, env: Any) -> Any:
        """The present policy, looking at the environment ``env``."""
        policy = self.policy
        return policy.attached(env) if isinstance(policy, StatePolicy) else policy

    def row(self) -> Scalars:
        """Scalars of the last update, and of the episodes that have ended since the last row."""
        self.rollout.episodes.recent_returns = []
        return self.scalars

    def update(self) -> Scalars:
        """Play one window, and learn from it.

        Raises:
            NonFiniteError: Ten updates in a row had no finite gradient, or actions are not finite.
        """
        rate = self.config.learning_rate * (1.0 - (1.0 - FINAL_RATE) * min(self.num_timesteps / self.config.steps, 1.0))
        for adam in (self.actor_adam, self.critic_adam):
            adam.param_groups[0]["lr"] = rate
        window = self.rollout.collect(self.actor, lambda seen: self.value(self.target, seen))
        norm = self._improve_actor(window)
        error = self._improve_critic(window)
        with torch.no_grad():
            for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                slow.lerp_(fast, self.config.tau)
        self.num_timesteps += self.config.window * self.env.num_envs
        return self.rollout.episodes.scalars() | {
            "train/reward": float(window.rewards.detach().mean()) / self.config.reward.scale,
            "train/true_reward": window.true_reward,
            "train/value": float(window.next_values.detach().mean()),
            "train/critic_loss": error,
            "train/gradient_norm": norm,
            "train/learning_rate": rate,
            "train/skipped": float(self.skipped),
        }

    def _improve_actor(self, window: Window) -> float | None:
        """One step of Adam; returns the gradient's norm, None if it was not finite and the step not made."""
        self.actor_adam.zero_grad()
        actor_loss(window, self.config.gamma).backward()
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
                f"{PATIENCE} updates in a row had no finite gradient after {self.num_timesteps} environment steps; "
                "the last checkpoint is untouched"
            )
        return None

    def _improve_critic(self, window: Window) -> float:
        targets = td_lambda_targets(window, self.config.gamma, self.config.td_lambda).flatten()
        seen, loss = window.observations.flatten(0, 1), torch.zeros(())
        for _ in range(self.config.critic_updates):
            self.critic_adam.zero_grad()
            loss = (self.value(self.critic, seen) - targets).square().mean()
            loss.backward()
            nn.utils.clip_grad_norm_(self.critic.parameters(), self.config.max_grad_norm)
            self.critic_adam.step()
        return float(loss.detach())

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy; one that sees the image becomes a policy of CFP."""
        description = {**description, "sees": self.config.sees}
        policy = self._policy(description)
        if isinstance(policy, StatePolicy):
            policy.save(path)
        else:
            network = {"resolutions": [policy.resolution]}
            save_policy(
                path, policy.actor, description | {"kind": KIND, "network": network, "trained_by": self.config.algo}
            )

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> StatePolicy | ActorPolicy:
        """Load a policy of either kind."""
        return load(path, device) if read_policy(path)[1]["kind"] == KIND else StatePolicy.load(path, device)

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, episodes in progress, generators and counts."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "target": self.target.state_dict(),
            "actor_adam": self.actor_adam.state_dict(),
            "critic_adam": self.critic_adam.state_dict(),
            "skipped": [self.skipped, self.skipped_in_a_row],
            "rollout": self.rollout.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        for name in ("actor", "critic", "target", "actor_adam", "critic_adam", "rollout"):
            getattr(self, name).load_state_dict(state[name])
        self.skipped, self.skipped_in_a_row = state["skipped"]


def actor_loss(window: Window, gamma: float) -> Tensor:
    """Negative discounted rewards of a window and final values of its episodes, mean over simulations and steps.

    The sum of ``gamma^t r_t`` over the steps of an episode within the window, plus ``gamma^h V(s_h)`` after the last of
    them (Xu et al., ICLR 2022, equation 5).

    Args:
        window: With its autograd graph.
        gamma: Discount factor.
    """
    steps = len(window.rewards)
    total, discount = torch.zeros_like(window.rewards[0]), torch.ones_like(window.rewards[0])
    for step, (reward, value, done) in enumerate(zip(window.rewards, window.next_values, window.done, strict=True)):
        total = total + discount * reward
        total = total + torch.where(done | (step + 1 == steps), gamma * discount * value, 0.0)
        discount = torch.where(done, 1.0, gamma * discount)
    return -total.mean() / steps


@torch.no_grad()
def td_lambda_targets(window: Window, gamma: float, td_lambda: float) -> Tensor:
    """TD(lambda) targets (T, B) of the values of a window's observations.

    Args:
        window: Rewards, values and ends of episodes.
        gamma: Discount factor.
        td_lambda: Weight of the following target against the value after a single step.
    """
    targets = torch.empty_like(window.rewards)
    target = window.next_values[-1]
    for step in reversed(range(len(targets))):
        value = window.next_values[step]
        target = torch.where(window.done[step], value, (1.0 - td_lambda) * value + td_lambda * target)
        target = targets[step] = window.rewards[step] + gamma * target
    return targets
