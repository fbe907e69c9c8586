"""The hyperparameters of `cfp.agent.sac.CFP`, declared once for constructor, presets and command line."""

from __future__ import annotations

from dataclasses import dataclass

from cfp.agent.actor import RESOLUTIONS
from cfp.errors import ConfigError
from cfp.validation import check_at_least, check_decay, check_fraction, check_positive


@dataclass(frozen=True)
class LearningConfig:
    """Hyperparameters of soft actor-critic that are the same in every stage."""

    learning_rate: float = 3e-4
    """Adam's step size for actor and critics."""
    actor_rate: float | None = None
    """Adam's step size for the actor alone; None: the same as for the critics."""
    actor_start: int = 0
    """Environment steps of each stage before the first actor update; until then only the critics learn. The value of a
    preset is scaled down with fewer steps."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Polyak factor of the target critics."""
    batch_size: int = 256
    """Transitions in an update."""
    buffer_size: int = 200_000
    """Transitions in the replay buffer."""
    gradient_steps: int = 1
    """Updates after each batched step of num_envs robots."""
    update_start: int = 256
    """Updates begin when more transitions than this are stored."""
    anchor: float = 100.0
    """With refine: weight of the mean squared difference to the mean actions of the policy that is refined."""
    reward_momentum: float = 0.99
    """Momentum of the running mean and variance of the rewards."""
    max_grad_norm: float = 10.0
    """Largest gradient norm of each parameter tensor."""
    noise_cells: int = 0
    """Rows and columns of cells with equal exploration noise, held for some steps; 0: the policy's own noise alone."""
    noise_scale: tuple[float, float] = (0.05, 0.4)
    """Standard deviation of that noise before tanh, of the first and of the last robot; a single one has the first."""
    n_steps: int = 1
    """Steps whose rewards a critic's target sums up."""
    final_rate: float = 1.0
    """Fraction of the learning rates at the end of a stage; they fall linearly."""
    weight_average: float = 0.0
    """Decay of the average of the actor's weights over updates, which is the policy; 0: the actor itself."""

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        check_at_least(2, batch_size=self.batch_size)  # rewards are divided by their deviation in the batch
        check_at_least(
            1, buffer_size=self.buffer_size, gradient_steps=self.gradient_steps, update_start=self.update_start
        )
        if self.buffer_size < self.batch_size:
            raise ConfigError(f"buffer_size must be at least batch_size, {self.batch_size}, got {self.buffer_size}")
        check_at_least(1, n_steps=self.n_steps)
        if self.n_steps > 1 and self.gamma == 1:
            raise ConfigError("gamma must be below 1 with several n_steps, got 1")
        check_fraction(gamma=self.gamma, tau=self.tau, reward_momentum=self.reward_momentum, final_rate=self.final_rate)
        check_decay(weight_average=self.weight_average)
        check_positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        if self.actor_rate is not None:
            check_positive(actor_rate=self.actor_rate)
        check_at_least(0, actor_start=self.actor_start, anchor=self.anchor)
        if self.noise_cells not in (allowed := (0, 1, 2, *RESOLUTIONS)):
            raise ConfigError(f"noise_cells must be one of {allowed}, got {self.noise_cells}")
        for scale in self.noise_scale:
            check_positive(noise_scale=scale)


@dataclass(frozen=True)
class Hyperparameters(LearningConfig):
    """All hyperparameters of one stage: those of `LearningConfig` and those that differ between stages."""

    alpha: float = 0.01
    """Entropy temperature."""
    gate_penalty: float = 0.0
    """Weight rho of the gate penalty ``mean ||g||_2 / R`` in the actor loss of a residual actor."""
    random_steps: int = 500
    """Environment steps with uniformly random actions at the start."""

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        super().check()
        check_at_least(0, alpha=self.alpha, gate_penalty=self.gate_penalty, random_steps=self.random_steps)
