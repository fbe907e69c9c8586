"""Sections of a run's options that do not belong to the algorithm: environment, networks, reports."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from cfp.agent.actor import EncoderKind, Interpolation
from cfp.errors import ConfigError
from cfp.validation import check_at_least, check_positive
from dittogym.action import ActionIndexing, default_indexing
from dittogym.spec import CONTROL_STEP, DT

#: Particle count: the paper's, about 2,000, a number, or one number for the robot and one for the object.
Particles: TypeAlias = Literal["full", "lite"] | int | tuple[int, int]

#: Fields of ``EnvironmentConfig`` that are options of some tasks only.
TASK_OPTIONS = ("target", "variant")

#: Duration of a substep, s, in the simulations of gradient methods and planners in ``LONG_DT_TASKS``.
LONG_DT = 2e-4
#: Tasks in which it changes no more than another layout of particles does (benchmarks/long_substeps.py).
LONG_DT_TASKS = ("run",)


@dataclass(frozen=True)
class EnvironmentConfig:
    """Options of `dittogym.TorchEnv`."""

    num_envs: int = 16
    """Number of robots simulated side by side."""
    particles: Particles = "lite"
    """Particles: full (the paper's), lite (about 2,000), a count, or one count for robot and one for object."""
    substeps: int | None = None
    """Substeps of a control step; None: as many as take 10 ms."""
    dt: float = DT
    """Duration of a substep, s."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the physics."""
    backend: str = "auto"
    """Backend of the physics: auto, eager, compile, ..."""
    action_layout: ActionIndexing | None = None
    """Orientation of the action array: image (as the observation) or grid (the reference's); None: by parity."""
    parity: Literal["clean", "reference"] = "clean"
    """clean: without the reference's faults in observations and resets; reference: with them."""
    resample: bool = False
    """Draw the particles anew at every reset."""
    target: str | None = None
    """Target shape, for tasks that have one: star, I, M, T, or the path of an image; None: the task's default."""
    variant: str | None = None
    """For tasks that have variants: in SLOT the material, that of the registered environment (registered, also None) or
    of the published training run (published)."""

    def task_options(self) -> dict[str, Any]:
        """The options that belong to the task, for `dittogym.make_spec`."""
        return {name: value for name in TASK_OPTIONS if (value := getattr(self, name)) is not None}

    @property
    def action_indexing(self) -> ActionIndexing:
        """Orientation of the action array that these options result in."""
        return self.action_layout or default_indexing(self.parity)

    @property
    def control_step(self) -> float:
        """Duration of an environment step, s."""
        return CONTROL_STEP if self.substeps is None else self.substeps * self.dt

    def with_dt(self, dt: float, option: str = "dt") -> EnvironmentConfig:
        """These options with the same environment step in substeps of ``dt`` s, the value of an option."""
        check_positive(**{option: dt})
        ratio = self.control_step / dt
        substeps = round(ratio) if math.isfinite(ratio) else 0
        if not math.isclose(substeps * dt, self.control_step):
            raise ConfigError(f"{option} must divide an environment step of {self.control_step} s, got {dt}")
        return self if dt == self.dt else replace(self, dt=dt, substeps=substeps)

    def for_optimisation(
        self, task: str, particles: Particles | None = None, dt: float | None = None
    ) -> EnvironmentConfig:
        """These options for the simulations of a gradient method or a planner.

        Args:
            task: The task.
            particles: As in `with_particles`; None: these options as they are.
            dt: Duration of a substep, s; None: `LONG_DT` in `LONG_DT_TASKS` if these options leave ``substeps`` and
                ``dt`` at their defaults, else as it is.
        """
        if dt is None:
            is_default = self.substeps is None and self.dt == DT
            dt = LONG_DT if is_default and task in LONG_DT_TASKS else self.dt
        return (self if particles is None else self.with_particles(particles)).with_dt(dt, "train_dt")

    def with_particles(self, particles: Particles) -> EnvironmentConfig:
        """These options with other particles, without the reference's faults, and with actions oriented as here."""
        layout = self.action_layout if self.parity == "clean" else self.action_indexing
        return replace(self, particles=particles, parity="clean", action_layout=layout)

    def for_evaluation(self, particles: Particles) -> EnvironmentConfig:
        """These options with other particles; if few, without the reference's faults, which make the robot lighter."""
        return replace(self, particles=particles) if particles == "full" else self.with_particles(particles)

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        check_at_least(1, num_envs=self.num_envs)
        if self.substeps is not None:
            check_at_least(1, substeps=self.substeps)
        check_positive(dt=self.dt)


@dataclass(frozen=True)
class NetworkConfig:
    """Options of the networks, see `cfp.agent.actor.ActorSpec`."""

    interpolation: Interpolation = "half_pixel"
    """Bicubic upsampling: half_pixel (as the environment, blended on its patch) or aligned (the reference's)."""
    split: bool = False
    """Separate narrow encoders for observation and action."""
    gate_scale: float = 1.0
    """Largest gate value (the reference: 0.25 with split encoders)."""
    encoder: EncoderKind = "paper"
    """paper (the paper's), or small (half the size and width; actions join its features)."""

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        check_positive(gate_scale=self.gate_scale)


@dataclass(frozen=True)
class ReportConfig:
    """What is measured and written while training."""

    eval_every: int = 10_000
    """Environment steps between evaluations; 0: none."""
    eval_episodes: int = 5
    """Episodes of an evaluation and of the final table."""
    eval_deterministic: bool = False
    """Evaluate without action noise."""
    patience: int = 0
    """End a stage early after this many evaluations in a row without a new best one; 0: never."""
    checkpoint_every: int = 1_000
    """Environment steps between checkpoints."""
    log_every: int = 500
    """Environment steps between rows of progress.csv and TensorBoard points."""
    video: bool = True
    """Record video.mp4 at the end."""
    video_every: int = 0
    """Environment steps between videos of one episode in videos/; 0: none."""
    wandb: Literal["off", "offline", "online"] = "off"
    """Weights & Biases: off, offline (kept in the folder of the run), or online (uploads)."""
    wandb_project: str = "torchmpm"
    """Weights & Biases project."""

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        check_at_least(
            1, eval_episodes=self.eval_episodes, checkpoint_every=self.checkpoint_every, log_every=self.log_every
        )
        check_at_least(0, eval_every=self.eval_every, video_every=self.video_every, patience=self.patience)
        if self.patience and not self.eval_every:
            raise ConfigError(f"patience must be 0 without evaluations (eval_every 0), got {self.patience}")
