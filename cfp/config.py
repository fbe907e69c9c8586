"""All options of a run as frozen dataclasses, and their JSON form."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

from cfp.actor import ActorSpec
from cfp.errors import ConfigError
from cfp.losses import Precision
from cfp.merging import merge as merge
from cfp.networks import RESOLUTIONS, Interpolation
from dittogym import TASKS, make_spec
from dittogym.action import Layout

Preset = Literal["quick", "paper"]

EVALUATION_SEED = 10_000
"""Added to a run's seed for evaluations, so that they start from particle layouts not trained on."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """Where the robot lives: options of `dittogym.TorchEnv`."""

    num_envs: int = 16
    """Robots simulated side by side."""
    particles: Literal["full", "lite"] | int | tuple[int, int] = "lite"
    """Particles: full (the paper's), lite (about 2,000), a count, or one count for robot and one for object."""
    substeps: int = 100
    """Physics steps in one environment step."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the physics."""
    backend: str = "auto"
    """How the physics is computed: auto, eager, compile, ..."""
    action_layout: Literal["image", "grid"] | None = None
    """Orientation of the action array: image (as the observation) or grid (the reference's); None: by parity."""
    parity: Literal["clean", "reference"] = "clean"
    """clean: the reference's faults that only hide the truth are mended; reference: they are kept."""
    resample: bool = False
    """Draw the particles anew at every reset."""
    target: str | None = None
    """SHAPE MATCH: star, I, M, T or the path of an image; None: the task's default."""

    @property
    def layout(self) -> Layout:
        """Orientation of the action array: as asked for, else by parity."""
        return self.action_layout or ("grid" if self.parity == "reference" else "image")

    def task_options(self) -> dict[str, Any]:
        """What of it belongs to the task, for `dittogym.make_spec`."""
        return {} if self.target is None else {"target": self.target}


@dataclass(frozen=True)
class NetworkConfig:
    """Choices inside the networks."""

    interpolation: Interpolation = "half_pixel"
    """Bicubic upsampling: half_pixel (the environment's rule, blended on its patch) or aligned (the reference's)."""
    split: bool = False
    """Separate narrow encoders for observation and action (DIG)."""
    gate_scale: float = 1.0
    """Largest gate value (the reference: 0.25 with split encoders)."""


@dataclass(frozen=True)
class LearningConfig:
    """Soft actor-critic."""

    learning_rate: float = 3e-4
    """Adam's step size for actor and critics."""
    actor_rate: float | None = None
    """Adam's step size for the actor alone; None: the same as for the critics."""
    actor_start: int = 0
    """Environment steps of each level in which only the critics learn: a trained actor waits for their judgement."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Polyak factor of the target critics."""
    batch_size: int = 256
    """Transitions in an update."""
    buffer_size: int = 200_000
    """Transitions in the replay ring."""
    gradient_steps: int = 1
    """Updates after each batched step of num_envs robots."""
    update_start: int = 256
    """Updates begin when more transitions than this are stored."""
    anchor: float = 100.0
    """With refine: weight of the mean square by which actions differ from those of the policy that is refined."""
    reward_momentum: float = 0.99
    """Momentum of the running reward mean and variance."""
    max_grad_norm: float = 10.0
    """Largest gradient norm of one parameter tensor."""
    precision: Precision = "float32"
    """Of the networks in updates: float32, bfloat16, or auto (bfloat16 on CPUs with instructions for it)."""
    compile: bool = False
    """Run the updates through torch.compile."""
    warm_critic: bool = False
    """Each level begins with critics and reward statistics of the one before (the reference: anew)."""


@dataclass(frozen=True)
class ReportConfig:
    """What is measured and written while training."""

    eval_every: int = 10_000
    """Environment steps between evaluations; 0: none."""
    eval_episodes: int = 5
    """Episodes of an evaluation and of the final table."""
    eval_deterministic: bool = False
    """Evaluate without action noise (the reference does so in SHAPE MATCH only)."""
    patience: int = 0
    """Evaluations in a row without a new best that end a stage early (the last: the run); 0: only steps count."""
    checkpoint_every: int = 1_000
    """Environment steps between checkpoints."""
    log_every: int = 500
    """Environment steps between rows of progress.csv and TensorBoard points."""
    video: bool = True
    """Record video.mp4 at the end."""


@dataclass(frozen=True)
class RunConfig:
    """Options of a training run that every algorithm has.

    Training goes through one or more stages; what an algorithm says about them here is what its runs are made of.
    """

    algo: str = "cfp"
    """Which algorithm."""
    task: str = "shapematch"
    """Which task: see the presets."""
    preset: Preset = "quick"
    """Where defaults come from: quick (minutes on two cores) or paper (the published numbers)."""
    seed: int = 0
    """Controls everything that is random."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    report: ReportConfig = field(default_factory=ReportConfig)

    changeable: ClassVar[tuple[str, ...]] = ("device", "report.", "environment.backend")
    """Options that a resumed run may change (a dot at the end: the whole group)."""

    @property
    def name(self) -> str:
        """Of the run, for a folder."""
        return f"{self.algo}-{self.task}-{self.preset}-{self.seed}"

    def ends(self) -> tuple[int, ...]:
        """Environment steps since the beginning of the run after which each stage ends."""
        raise NotImplementedError

    def resolution(self, level: int) -> int:
        """Action grid R of a stage (0 is the first)."""
        raise NotImplementedError

    def action_size(self, level: int) -> int:
        """Rows and columns of the actions that the environment of a stage takes."""
        return self.resolution(level)

    def evaluation(self, level: int) -> tuple[int, int]:
        """Seed of the first layout, and episodes, by which a stage is evaluated while it trains."""
        return self.seed + EVALUATION_SEED, self.report.eval_episodes

    def adapted(self, base: RunConfig) -> RunConfig:
        """These options with what follows from those that differ from ``base``, unless it was changed too."""
        return self

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        at_least_one(
            num_envs=self.environment.num_envs,
            substeps=self.environment.substeps,
            eval_episodes=self.report.eval_episodes,
            checkpoint_every=self.report.checkpoint_every,
            log_every=self.report.log_every,
        )
        if self.report.eval_every < 0:
            raise ConfigError(f"eval_every: got {self.report.eval_every}, allowed 0 (never) or more")
        if self.report.patience < 0 or (self.report.patience and not self.report.eval_every):
            raise ConfigError(f"patience: got {self.report.patience}, allowed 0, or more with evaluations (eval_every)")


def at_least_one(**counts: int) -> None:
    """Check counts by name.

    Raises:
        ConfigError: One is below 1.
    """
    for name, value in counts.items():
        if value < 1:
            raise ConfigError(f"{name}: got {value}, allowed 1 or more")


@dataclass(frozen=True)
class StageConfig:
    """One level of the ladder, as `Config.stage` cuts it out."""

    resolution: int
    steps: int
    random_steps: int
    alpha: float
    gate_penalty: float


@dataclass(frozen=True)
class LadderConfig(RunConfig):
    """A run that trains the levels of the coarse-to-fine policy. Levels are listed coarsest first."""

    steps: int = 20_000
    """Environment steps of all levels together."""
    handover: tuple[int, ...] = (10_000,)
    """Environment steps after which each level hands over to the next (one less than levels)."""
    resolutions: tuple[int, ...] = (8, 16)
    """Action grids R of the levels."""
    gate_bias: tuple[float, ...] = (-1.0,)
    """Bias of the gate's logit (one less than levels)."""
    network: NetworkConfig = field(default_factory=NetworkConfig)

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)
    per_level: ClassVar[tuple[str, ...]] = ()
    """Options with one value for each level."""
    per_residual: ClassVar[tuple[str, ...]] = ("handover", "gate_bias")
    """Options with one value for each level but the first."""

    def ends(self) -> tuple[int, ...]:
        """Environment steps since the beginning of the run after which each level ends."""
        return (*self.handover, self.steps)

    def resolution(self, level: int) -> int:
        """Action grid R of a level."""
        return self.resolutions[level]

    def action_size(self, level: int) -> int:
        """Rows and columns of the actions that the environment of a level takes, see `ActorSpec.patch`."""
        return self.actor_spec(level).action_size

    def adapted(self, base: RunConfig) -> RunConfig:
        """Other steps move the handovers in proportion."""
        assert isinstance(base, LadderConfig)
        if self.steps == base.steps or self.handover != base.handover:
            return self
        share = self.steps / base.steps
        return replace(self, handover=tuple(round(step * share) for step in base.handover))

    def actor_spec(self, level: int) -> ActorSpec:
        """The networks of the actor at a level (0 is the coarsest), with all coarser ones."""
        return ActorSpec(
            self.resolutions[: level + 1],
            self.gate_bias[:level],
            self.network.split,
            self.network.gate_scale,
            self.network.interpolation,
            None if self.network.interpolation == "aligned" else make_spec(self.task).patch,
        )

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        levels = len(self.resolutions)
        growing = list(self.resolutions) == sorted(set(self.resolutions))
        if not levels or not growing or not set(self.resolutions) <= set(RESOLUTIONS):
            raise ConfigError(f"resolutions: got {self.resolutions}, allowed is a growing choice of {RESOLUTIONS}")
        counts = dict.fromkeys(self.per_level, levels) | dict.fromkeys(self.per_residual, levels - 1)
        for name, count in counts.items():
            given = len(getattr(self, name))
            if given != count:
                raise ConfigError(f"{name}: got {given} values, allowed {count} for resolutions {self.resolutions}")
        if self.task in TASKS and self.resolutions[-1] > (patch := make_spec(self.task).patch):
            raise ConfigError(f"resolutions: got {self.resolutions}, allowed in {self.task} is at most {patch}")
        if any(late <= early for early, late in pairwise((0, *self.ends()))):
            raise ConfigError(f"handover: got {self.handover} of {self.steps} steps, allowed are growing steps between")
        super().check()


@dataclass(frozen=True)
class Config(LadderConfig):
    """A run of CFP. Levels are listed coarsest first; one value per level unless said otherwise."""

    random_steps: tuple[int, ...] = (500, 100)
    """Uniformly random environment steps at the start of each level (none where a policy is refined)."""
    alpha: tuple[float, ...] = (0.01, 0.01)
    """Entropy temperature of each level."""
    gate_penalty: tuple[float, ...] = (0.01,)
    """Weight of the gate penalty (one less than levels)."""
    start_from: str | None = None
    """Policy of the first levels, a run folder or policy.safetensors: training begins with the level after it."""
    refine: bool = False
    """Training begins with the last level of start_from itself, which goes on learning."""
    learning: LearningConfig = field(default_factory=LearningConfig)

    per_level: ClassVar[tuple[str, ...]] = ("random_steps", "alpha")
    per_residual: ClassVar[tuple[str, ...]] = (*LadderConfig.per_residual, "gate_penalty")

    def stage(self, level: int) -> StageConfig:
        """What the training of one level needs."""
        bounds = (0, *self.ends())
        return StageConfig(
            self.resolutions[level],
            bounds[level + 1] - bounds[level],
            self.random_steps[level],
            self.alpha[level],
            self.gate_penalty[level - 1] if level else 0.0,
        )

    def check(self) -> None:
        """Check what the types cannot, see `LadderConfig.check`."""
        super().check()
        if self.learning.warm_critic and self.start_from is not None:
            raise ConfigError("warm_critic: got True, allowed without start_from (a policy brings no critics)")
        if self.refine and self.start_from is None:
            raise ConfigError("refine: got True, allowed with start_from, which names the policy")
        at_least_one(
            batch_size=self.learning.batch_size,
            buffer_size=self.learning.buffer_size,
            gradient_steps=self.learning.gradient_steps,
            update_start=self.learning.update_start,
        )
        shares = {"gamma": self.learning.gamma, "tau": self.learning.tau, "momentum": self.learning.reward_momentum}
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise ConfigError(f"{name}: got {share}, allowed 0 to 1")
        for name in ("learning_rate", "actor_rate"):
            if (rate := getattr(self.learning, name)) is not None and rate <= 0:
                raise ConfigError(f"{name}: got {rate}, allowed more than 0")
        for name in ("actor_start", "anchor"):
            if (value := getattr(self.learning, name)) < 0:
                raise ConfigError(f"{name}: got {value}, allowed 0 or more")


def to_json(config: RunConfig) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return dataclasses.asdict(config)
