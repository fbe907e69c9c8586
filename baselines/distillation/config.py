"""Options of a distillation."""

from dataclasses import dataclass

from baselines.common.grid import Grid, find_grid
from baselines.planning.gradient import GradientPlannerConfig
from cfp.config import Config, Particles, StagedConfig, check_training_seeds
from cfp.validation import check_at_least, check_fraction, check_positive


@dataclass(frozen=True, kw_only=True)
class DistillConfig(GradientPlannerConfig, StagedConfig):
    """A distillation; num_envs robots move side by side. Stages are listed coarsest first.

    The environment options say where the student is evaluated; train_particles, where it is taught.
    """

    algo: str = "distill"
    """Which algorithm."""
    teacher: str = "shac"
    """mpc (plans from every state), shac or gradient (trained first), or a policy: a run folder, policy.safetensors."""
    train_particles: Particles = "lite"
    """Particles of the simulations in training."""
    rollout_steps: int = 64
    """Control steps of a round, after which the student is updated."""
    updates: int = 48
    """Gradient steps after a round."""
    batch_size: int = 256
    """Labels in a gradient step."""
    student_noise: bool = True
    """The student acts with the noise of its policy."""
    student_learning_rate: float = 1e-3
    """Adam's step size at the beginning of each stage; it falls to a tenth."""
    max_grad_norm: float = 1.0
    """Largest norm of the gradient."""
    beta_decay: float = 0.7
    """Factor by which beta, the probability that the teacher acts, falls from round to round; it starts at 1."""
    switch_every: int = 8
    """Control steps after which it is drawn anew whether teacher or student acts on a robot."""
    dropout: float = 0.0
    """Probability with which entries of the student's observations and actions are set to 0, in half of them, so that
    it learns to do without."""
    capacity: int = 100_000
    """Labels that are kept; an image takes 12 KiB, an action on the smaller grid of teacher and student 8 R R bytes."""
    max_episode_steps: int = 400
    """Control steps after which a training episode is truncated; the first ones are truncated at staggered ages."""
    num_layouts: int = 64
    """Particle layouts that training episodes start from in turn."""
    planner_grid: Grid = "coarse"
    """Action grid of the teacher mpc."""

    def for_training(self: Config) -> Config:
        """These options, with the environment that the student is taught in."""
        assert isinstance(self, DistillConfig)
        return self.simulated_with(self.train_particles)

    @property
    def planner_resolution(self) -> int:
        """Action grid R of the teacher mpc."""
        return find_grid("planner_grid", self.task, self.planner_grid)

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next: a round of all robots."""
        return self.rollout_steps * self.num_envs

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        self.check_planner()
        _ = self.planner_resolution  # checks planner_grid
        check_at_least(1, rollout_steps=self.rollout_steps, updates=self.updates, batch_size=self.batch_size)
        check_at_least(1, switch_every=self.switch_every, capacity=self.capacity)
        check_at_least(1, max_episode_steps=self.max_episode_steps, num_layouts=self.num_layouts)
        check_training_seeds("num_layouts", self.num_layouts, self.num_envs, len(self.resolutions))
        check_positive(student_learning_rate=self.student_learning_rate, max_grad_norm=self.max_grad_norm)
        check_fraction(beta_decay=self.beta_decay, dropout=self.dropout)
