"""The options of the learner ``analytic``, and of what differentiates simulations or plans in them in general."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from cfp.analytic.reward import RewardConfig
from cfp.config import RESAMPLE_NEEDS_SAC, CoarseToFineConfig, Learner, RunConfig, check_training_layouts
from cfp.sections import EnvironmentConfig, Particles
from cfp.validation import check_at_least, check_decay, check_fraction, check_positive


@dataclass(frozen=True, kw_only=True)
class OptimisationConfig(RunConfig):
    """A run that differentiates simulations, or plans in them; they may have fewer particles and longer substeps."""

    train_particles: Particles | None = None
    """Particles of the simulations in training, at most the environment's; None: as many."""
    train_dt: float | None = None
    """Duration of a substep in training, s; None: 2e-4 in RUN unless substeps or dt are given, else as in the
    environment."""

    @property
    def training_environment(self) -> EnvironmentConfig:
        """Options of the simulations in training."""
        return self.environment.for_optimisation(self.task, self.train_particles, self.train_dt)


@dataclass(frozen=True, kw_only=True)
class WindowConfig(OptimisationConfig):
    """Options of all learners that differentiate windows of simulation and value their ends by a critic."""

    train_particles: Particles = "lite"
    """Particles of the simulations in training."""
    window: int = 16
    """Control steps that a gradient reaches back."""
    gamma: float = 0.98
    """Discount factor."""
    learning_rate: float = 1e-3
    """Adam's step size for actor and critic at the beginning of a stage; it falls to a tenth."""
    td_lambda: float = 0.95
    """Lambda of the critic's TD(lambda) targets: 0 for single steps, 1 for the whole window."""
    critic_updates: int = 16
    """Updates of the critic after each window."""
    tau: float = 0.4
    """Rate at which the target critic follows the critic after each window: target = (1 - tau) target + tau critic."""
    max_grad_norm: float = 1.0
    """Largest norm of a gradient of the networks, of actor and critic each."""
    max_episode_steps: int = 400
    """Control steps after which a training episode is truncated, if the task's horizon is not shorter; the first ones
    are truncated at staggered ages."""
    num_layouts: int = 16
    """Particle layouts that training episodes start from in turn."""
    reward: RewardConfig = field(default_factory=RewardConfig)

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, window=self.window, critic_updates=self.critic_updates)
        check_at_least(1, max_episode_steps=self.max_episode_steps, num_layouts=self.num_layouts)
        check_fraction(gamma=self.gamma, td_lambda=self.td_lambda, tau=self.tau)
        check_positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        check_training_layouts("num_layouts", self.num_layouts, self.environment.num_envs)


@dataclass(frozen=True, kw_only=True)
class AnalyticConfig(WindowConfig, CoarseToFineConfig):
    """A run of the coarse-to-fine policy that learns by gradients through the simulation.

    The environment options say where the policy is evaluated; train_particles and train_dt, where it is trained.
    """

    learner: Learner = "analytic"
    train_dt: float | None = None
    """Duration of a substep in training, s; None: as in the environment."""
    action_step: tuple[float, ...]
    """Root mean square of each step on the actions of a window, for each stage."""
    final_step: float = 0.4
    """Fraction of action_step at the end of a stage; it falls linearly."""
    minibatches: int = 16
    """Steps of the regression after each window."""
    minibatch_size: int = 64
    """Images in a step of the regression."""
    windows_kept: int = 4
    """Latest windows that the regression draws from."""
    weight_average: float = 0.95
    """Decay of the average of the actor's weights, which is the policy; 0: the actor itself."""
    warmup: int = 15
    """Windows at the beginning of a stage that starts from a trained policy, in which only the critic learns."""
    displacement: bool = True
    """The critic sees the robot's displacement since the reset."""

    own_learner: ClassVar[Learner] = "analytic"
    per_stage: ClassVar[tuple[str, ...]] = ("action_step",)

    @property
    def name(self) -> str:
        """Name of the run, used for its folder; with learner sac it begins with the algorithm."""
        return f"{self.learner}{super().name.removeprefix(self.algo)}"

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next: a window of all robots."""
        return self.window * self.environment.num_envs

    @property
    def training_environment(self) -> EnvironmentConfig:
        """Options of the simulations in training."""
        environment = self.environment.with_particles(self.train_particles)
        return environment if self.train_dt is None else environment.with_dt(self.train_dt, "train_dt")

    def ineffective(self) -> dict[str, str]:
        """Options without effect: layouts are counted from the seed."""
        return super().ineffective() | RESAMPLE_NEEDS_SAC

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(0, warmup=self.warmup)
        check_at_least(1, minibatches=self.minibatches, minibatch_size=self.minibatch_size)
        check_at_least(1, windows_kept=self.windows_kept)
        check_fraction(final_step=self.final_step)
        check_decay(weight_average=self.weight_average)
        for size in self.action_step:
            check_positive(action_step=size)
