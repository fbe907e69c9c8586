"""The options of trainings: one flat dataclass for each algorithm, whose defaults are `cfp.presets`."""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar

from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

import dittogym.tasks
from cfp.agent.actor import RESOLUTIONS, ActorSpec, EncoderKind, Interpolation
from cfp.errors import ConfigError, brief, check_at_least, check_below_one, check_fraction, check_positive
from dittogym import Conditions, make_spec
from dittogym.action import ActionLayout
from dittogym.spec import CONTROL_STEP, DT, TaskSpec
from dittogym.tasks import task_name

Preset = Literal["quick", "long", "paper"]
#: Particle count: the paper's, about 2,000, a number, or one number for the robot and one for the object.
Particles: TypeAlias = Literal["full", "lite"] | int | tuple[int, int]
Value = TypeVar("Value")

LARGEST_SEED = 2**31 - 1
#: Added to a run's seed for evaluations, so that they start from initial positions that are not trained on.
EVALUATION_SEED = 10_000
#: Fields of `EnvironmentConfig` that are options of some tasks only.
TASK_OPTIONS = ("target", "variant")


@dataclass(frozen=True, kw_only=True)
class EnvironmentConfig:
    """Options of the environment, see `dittogym.TorchEnv`."""

    num_envs: int = 16
    """Number of robots simulated side by side."""
    particles: Particles = "lite"
    """Particles: full (the paper's), lite (about 2,000), the robot's number, or the numbers of robot and object."""
    substeps: int | None = None
    """Substeps of a control step; None: as many as take 10 ms."""
    dt: float = DT
    """Duration of a substep, s."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the physics."""
    backend: str = "auto"
    """Implementation of the physics: native (C++ or CUDA kernels), eager (PyTorch), or auto, which chooses."""
    action_layout: ActionLayout = "image"
    """Orientation of the action array: image (as the observation) or grid (the reference's)."""
    resample: bool = False
    """Draw the particles anew at every reset; soft actor-critic only, and without effect in GROW and OBSTACLE."""
    target: str | None = None
    """Target shape, for tasks that have one: star, I, M, T, or the path of an image; None: the task's default."""
    variant: str | None = None
    """Material of SLOT: registered (that of the registered environment, as None) or published (of the training)."""

    def task_options(self) -> dict[str, Any]:
        """Return the options that belong to the task, for `dittogym.make_spec`."""
        return {name: value for name in TASK_OPTIONS if (value := getattr(self, name)) is not None}

    @property
    def control_step(self) -> float:
        """Duration of a control step, s."""
        return CONTROL_STEP if self.substeps is None else self.substeps * self.dt


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Task, algorithm, preset, seed and device of a training, which choose the defaults of all other options."""

    task: str
    """Name of the task; MODULE:NAME for a custom task that the module registers."""
    algo: str
    """Name of the algorithm; MODULE:CLASS for one of your own."""
    preset: Preset = "quick"
    """Set of default options: quick (minutes), long (hours; soft actor-critic only), or paper (published values)."""
    seed: int = 0
    """Seed of everything that is random."""
    device: str = "auto"
    """cpu, cuda, or auto, which chooses one; only a GPU that is named changes the defaults of other options."""


@dataclass(frozen=True, kw_only=True)
class RunConfig(EnvironmentConfig, TaskConfig):
    """Options of a training that every algorithm has.

    Stages are counted from 1. The values of an object are not checked before `check` is called, as `cfp.fit` does.
    """

    eval_every: int = 10_000
    """Environment steps between evaluations; 0: none."""
    eval_episodes: int = 5
    """Episodes of an evaluation and of the final table; a plan is evaluated in the one episode it was made for."""
    eval_deterministic: bool = False
    """Evaluate without action noise, where the policy has some."""
    checkpoint_every: int = 1_000
    """Environment steps between checkpoints."""
    log_every: int = 500
    """Environment steps between rows of progress.csv and TensorBoard points."""
    video: bool = True
    """Record video.mp4 at the end."""
    wandb: Literal["off", "offline", "online"] = "off"
    """Weights & Biases: off, offline (kept in the folder of the run), or online (uploads)."""
    wandb_project: str = "torchmpm"
    """Weights & Biases project."""

    changeable: ClassVar[tuple[str, ...]] = (
        *("device", "backend", "eval_every", "checkpoint_every", "log_every"),
        *("video", "wandb", "wandb_project"),
    )
    """Options that a resumed run may change."""

    @property
    def name(self) -> str:
        """Name of the run, used for its folder."""
        return f"{task_name(self.algo)}-{task_name(self.task)}-{self.preset}-{self.seed}"

    def make_spec(self) -> TaskSpec:
        """Return the task with its options, a `dittogym.TaskSpec`."""
        return make_spec(self.task, **self.task_options())

    @property
    def environment(self) -> EnvironmentConfig:
        """The options of the environment alone."""
        names = (option.name for option in dataclasses.fields(EnvironmentConfig))
        return EnvironmentConfig(**{name: getattr(self, name) for name in names})

    def for_training(self: Config) -> Config:
        """These options, with the environment that is trained in, for algorithms that have options of it."""
        return self.simulated_with(getattr(self, "train_particles", None), getattr(self, "train_dt", None))

    def simulated_with(
        self: Config, particles: Particles | None = None, dt: float | None = None, option: str = "train_dt"
    ) -> Config:
        """These options with other particles, and with the same environment step in substeps of ``dt`` s, if given.

        A `ConfigError` about ``dt`` names the ``option``.
        """
        config = self if particles is None else replace(self, particles=particles)
        if dt is None or dt == self.dt:
            return config
        check_positive(**{option: dt})
        ratio = self.control_step / dt
        substeps = round(ratio) if math.isfinite(ratio) else 0
        if not math.isclose(substeps * dt, self.control_step):
            raise ConfigError(f"{option} must divide an environment step of {self.control_step} s, got {dt}")
        return replace(config, dt=dt, substeps=substeps)

    def ends(self) -> tuple[int, ...]:
        """Return the environment steps since the beginning of the run after which each stage ends.

        Subclasses implement this; the length of the result is the number of stages.
        """
        raise NotImplementedError

    def stage_steps(self, stage: int) -> int:
        """Return the number of environment steps of a ``stage``."""
        bounds = (0, *self.ends())
        return bounds[stage] - bounds[stage - 1]

    def resolution(self, stage: int) -> int:
        """Return the action grid R of a ``stage``; subclasses implement this."""
        raise NotImplementedError

    def action_size(self, stage: int) -> int:
        """Return rows and columns of the actions that the environment of a ``stage`` takes."""
        return self.resolution(stage)

    def conditions(self, stage: int) -> Conditions | None:
        """Return the conditions of episodes in training, and of the evaluations that choose the policy, in a ``stage``.

        None stands for the task's own.
        """
        return None

    def evaluation(self, stage: int) -> tuple[int, int]:
        """Return the seed of the first episode, and the number of episodes, of the evaluations in a ``stage``."""
        return self.seed + EVALUATION_SEED, self.eval_episodes

    def check(self) -> None:
        """Check the values of all options.

        Raises:
            cfp.ConfigError: An option is out of range, or does not go with another.
        """
        check_task(self.task)
        for name, value in vars(self).items():  # JSON files and command lines can contain NaN and infinity
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    raise ConfigError(f"{name} must be finite, got {value}")
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ConfigError(f"seed must be between 0 and {LARGEST_SEED}, got {self.seed}")
        check_at_least(1, num_envs=self.num_envs, eval_episodes=self.eval_episodes, log_every=self.log_every)
        check_at_least(1, checkpoint_every=self.checkpoint_every)
        check_at_least(0, eval_every=self.eval_every)
        if self.substeps is not None:
            check_at_least(1, substeps=self.substeps)
        check_positive(dt=self.dt)
        check_training_seeds("num_envs", self.num_envs)
        if self.resample and not isinstance(self, LearningConfig):
            raise ConfigError(f"resample must be False for {self.algo}, whose resets have seeds of their own, got True")
        self.for_training()  # checks its options


Config = TypeVar("Config", bound=RunConfig)


@dataclass(frozen=True, kw_only=True)
class StagedConfig(RunConfig):
    """Options of a run that trains several stages with action grids of increasing resolution.

    Options with a value for each stage are listed coarsest first; the last value holds for all further stages, and
    values beyond the last stage have no effect.
    """

    steps: int
    """Environment steps of all stages together, including those that start_from replaces."""
    handover: tuple[float, ...]
    """Share of the steps at which the next stage begins, from 0 to 1, for each stage but the last."""
    resolutions: tuple[int, ...]
    """Action grid R of each stage."""
    gate_bias: tuple[float, ...] = (-3.0,)
    """Bias of the gate logit of each stage but the first."""
    interpolation: Interpolation = "half_pixel"
    """Bicubic upsampling: half_pixel (that of the environment, blended on its patch) or aligned (the reference's)."""
    split: bool = False
    """Separate narrow encoders for observation and action, in the paper's networks; small ones always have them."""
    gate_scale: float = 1.0
    """Largest gate value (the reference: 0.25 with split encoders)."""
    encoder: EncoderKind = "paper"
    """Networks: paper (the paper's), or small (half the size and width; actions join the encoder's features)."""
    fill_missing: bool = True
    """Fill missing pixels (0) from those around them before the policy sees an image."""
    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next."""
        return self.num_envs

    def ends(self) -> tuple[int, ...]:
        """Return the environment steps since the beginning of the run after which each stage ends."""
        return (*(round(share * self.steps) for share in self.handover[: len(self.resolutions) - 1]), self.steps)

    def resolution(self, stage: int) -> int:
        """Return the action grid R of a ``stage``."""
        return self.resolutions[stage - 1]

    def action_size(self, stage: int) -> int:
        """Return rows and columns of the actions that the environment of a ``stage`` takes."""
        return self.actor_spec(stage).action_size

    def actor_spec(self, stage: int) -> ActorSpec:
        """Structure of the actor of a stage, including all coarser ones."""
        return ActorSpec(
            resolutions=self.resolutions[:stage],
            gate_bias=tuple(of_stage(self.gate_bias, residual) for residual in range(1, stage)),
            split=self.split,
            gate_scale=self.gate_scale,
            interpolation=self.interpolation,
            patch=None if self.interpolation == "aligned" else make_spec(self.task).patch,
            encoder=self.encoder,
            fill_missing=self.fill_missing,
        )

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        if max(self.resolutions, default=0) > (patch := make_spec(self.task).patch):
            raise ConfigError(f"resolutions must be at most {patch} in {self.task}, got {self.resolutions}")
        for option in dataclasses.fields(self):
            if option.name != "handover" and getattr(self, option.name) == ():
                raise ConfigError(f"{option.name} must have at least one value")
        self.actor_spec(len(self.resolutions))  # checks its fields
        check_at_least(1, steps=self.steps)
        if len(self.handover) < (count := len(self.resolutions) - 1):
            raise ConfigError(
                f"handover must have {count} values for resolutions {self.resolutions}, got {self.handover}"
            )
        for share in self.handover:
            if not 0 < share < 1:
                raise ConfigError(f"handover must be shares of the steps between 0 and 1, got {self.handover}")
        lengths = tuple(end - start for start, end in pairwise((0, *self.ends())))
        if min(lengths) < (least := self.update_every):
            raise ConfigError(
                f"steps and handover must give every stage at least {least} steps, those of one update, got stages of "
                f"{', '.join(map(str, lengths))} steps"
            )


@dataclass(frozen=True, kw_only=True)
class CoarseToFineConfig(StagedConfig):
    """Options of a run of the coarse-to-fine policy, which may begin with a trained one.

    The conditions of training episodes may differ (domain randomisation; Tobin et al., IROS 2017). Evaluations in
    training, which choose the policy, take place under such conditions, too; those of the final table under the task's
    own.
    """

    vary: float = 0.0
    """Probability with which each condition of a training episode is drawn from its range; 0: all are the task's."""
    vary_latency: int = 2
    """Largest number of control steps by which actions come late."""
    vary_noise: float = 0.2
    """Largest standard deviation of normal noise on actions."""
    vary_actions: float = 0.2
    """Largest share of the entries of an action that are missing in every step."""
    vary_pixels: float = 0.2
    """Largest share of the entries of an image that are missing in every step."""
    vary_physics: float = 0.2
    """Largest relative change of mu, yield stress and gravity."""
    vary_start: float = 1.0
    """Largest change of the start; 1 stands for 0.01 m, 5 degrees and 0.05 m/s."""
    start_from: str | None = None
    """Policy whose stages come first: a run folder, a file, one that comes with the package, or hf://OWNER/NAME."""
    refine: bool = False
    """Continue to train the last stage of start_from instead of adding stages to it."""

    def conditions(self, stage: int) -> Conditions | None:
        """Return the conditions of episodes in training, and of the evaluations that choose the policy, in a ``stage``.

        None stands for the task's own.
        """
        if not self.vary:
            return None
        factors = (1.0 - self.vary_physics, 1.0 + self.vary_physics)
        return Conditions(
            latency=(min(1, self.vary_latency), self.vary_latency),
            action_noise=(0.0, self.vary_noise),
            action_dropout=(0.0, self.vary_actions),
            observation_dropout=(0.0, self.vary_pixels),
            mu=factors,
            yield_stress=factors,
            gravity=factors,
            shift=0.01 * self.vary_start,
            turn=5.0 * self.vary_start,
            velocity=0.05 * self.vary_start,
            chance=self.vary,
            grid=self.resolution(stage),
        )

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(0, vary_latency=self.vary_latency, vary_noise=self.vary_noise, vary_start=self.vary_start)
        check_fraction(vary=self.vary, vary_actions=self.vary_actions, vary_pixels=self.vary_pixels)
        check_below_one(vary_physics=self.vary_physics)
        for option in dataclasses.fields(CoarseToFineConfig):
            given = getattr(self, option.name)
            if not self.vary and option.name.startswith("vary_") and given != option.default:
                raise ConfigError(f"{option.name} requires vary, the probability with which it applies, got {given}")
        if self.refine and self.start_from is None:
            raise ConfigError("refine requires start_from, which names the policy")


@dataclass(frozen=True, kw_only=True)
class LearningConfig:
    """Hyperparameters of soft actor-critic that are the same in every stage."""

    learning_rate: float = 3e-4
    """Adam's step size for actor and critics."""
    gamma: float = 0.99
    """Discount factor, from 0 to 1."""
    tau: float = 0.005
    """Rate at which the target critics follow the critics in each update: target = (1 - tau) target + tau critic."""
    batch_size: int = 256
    """Transitions in an update."""
    buffer_size: int = 200_000
    """Transitions in the replay buffer."""
    gradient_steps: int = 1
    """Updates after each batched step of num_envs robots."""
    update_start: int = 256
    """Updates begin when more transitions than this are stored."""
    n_steps: int = 1
    """Steps whose rewards a critic's target sums up (n-step returns)."""
    final_rate: float = 1.0
    """Fraction of the learning rates that is left at the end of a stage; they fall linearly."""
    weight_average: float = 0.0
    """Decay of the average of the actor's weights over updates, which is the policy; 0: the actor itself."""

    def common_hyperparameters(self) -> dict[str, Any]:
        """These options alone, by name."""
        return {option.name: getattr(self, option.name) for option in dataclasses.fields(LearningConfig)}

    def check_learning(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        check_at_least(2, batch_size=self.batch_size)  # rewards are divided by their deviation in the batch
        check_at_least(1, buffer_size=self.buffer_size, gradient_steps=self.gradient_steps, n_steps=self.n_steps)
        check_at_least(1, update_start=self.update_start)
        if self.buffer_size < self.batch_size:
            raise ConfigError(f"buffer_size must be at least batch_size, {self.batch_size}, got {self.buffer_size}")
        if self.n_steps > 1 and self.gamma == 1:
            raise ConfigError("gamma must be below 1 with several n_steps, got 1")
        check_fraction(gamma=self.gamma, tau=self.tau, final_rate=self.final_rate)
        check_below_one(weight_average=self.weight_average)
        check_positive(learning_rate=self.learning_rate)


@dataclass(frozen=True, kw_only=True)
class Hyperparameters(LearningConfig):
    """All hyperparameters of one stage of soft actor-critic, for `cfp.CFP`."""

    alpha: float = 0.01
    """Entropy temperature."""
    gate_penalty: float = 0.0
    """Weight rho of the gate penalty ``mean ||g||_2 / R`` in the actor loss of a residual actor."""
    random_steps: int = 500
    """Environment steps with uniformly random actions at the start."""
    actor_start: int = 0
    """Environment steps before the first actor update; until then only the critics learn."""
    noise_cells: int = 0
    """Rows and columns of cells with equal exploration noise, held for some steps; 0: the policy's own noise alone."""
    noise_scale: tuple[float, float] = (0.05, 0.4)
    """Standard deviation of this noise before tanh, of the first and of the last robot; one robot has the first."""

    def check(self) -> None:
        """Raise a `ConfigError` for values out of range."""
        self.check_learning()
        check_at_least(0, alpha=self.alpha, gate_penalty=self.gate_penalty)
        check_at_least(0, random_steps=self.random_steps, actor_start=self.actor_start)
        if self.noise_cells not in (allowed := (0, 1, 2, *RESOLUTIONS)):
            raise ConfigError(f"noise_cells must be one of {allowed}, got {self.noise_cells}")
        check_positive(noise_scale=min(self.noise_scale))


@dataclass(frozen=True, kw_only=True)
class SACConfig(LearningConfig, CoarseToFineConfig):
    """Options of a run of the coarse-to-fine policy that learns from rewards alone, by soft actor-critic."""

    algo: str = "cfp-sac"
    """Name of the algorithm."""
    random_steps: tuple[int, ...]
    """Environment steps with uniformly random actions at the start of each stage; none if a policy is refined."""
    alpha: tuple[float, ...]
    """Entropy temperature of each stage."""
    gate_penalty: tuple[float, ...]
    """Weight of the gate penalty, for each stage but the first."""
    critics_first: tuple[float, ...] = (0.0,)
    """Share of each stage in which only the critics learn."""
    noise_cells: int = 0
    """Rows and columns of cells with equal exploration noise, held for some steps; 0: the policy's own noise alone."""
    noise_scale: tuple[float, float] = (0.05, 0.4)
    """Standard deviation of this noise before tanh, of the first and of the last robot; one robot has the first."""
    max_episode_steps: int | None = None
    """Control steps after which training episodes end, the first ones at staggered times; None: all at the horizon."""

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of a stage."""
        return Hyperparameters(
            **self.common_hyperparameters(),
            noise_cells=self.noise_cells,
            noise_scale=self.noise_scale,
            alpha=of_stage(self.alpha, stage),
            gate_penalty=of_stage(self.gate_penalty, stage - 1) if stage > 1 else 0.0,
            random_steps=of_stage(self.random_steps, stage),
            actor_start=round(of_stage(self.critics_first, stage) * self.stage_steps(stage)),
        )

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        for share in self.critics_first:
            check_below_one(critics_first=share)
        if self.max_episode_steps is not None:
            check_at_least(1, max_episode_steps=self.max_episode_steps)
        for stage in range(1, len(self.resolutions) + 1):
            self.hyperparameters(stage).check()
        if (cells := self.noise_cells) > (coarsest := self.resolutions[0]):
            raise ConfigError(f"noise_cells must be at most {coarsest}, the coarsest of resolutions, got {cells}")


@dataclass(frozen=True, kw_only=True)
class WindowConfig(RunConfig):
    """Options of learners that differentiate windows of simulation and value their ends by a critic.

    The environment options apply to evaluations, train_particles and train_dt to the simulations in training.
    Evaluations always use the task's own reward.
    """

    train_particles: Particles = "lite"
    """Particles of the simulations in training."""
    train_dt: float | None = None
    """Duration of a substep in training, s; None: as in the environment."""
    window: int = 16
    """Control steps that a gradient reaches back."""
    gamma: float = 0.98
    """Discount factor, from 0 to 1."""
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
    """Control steps after which training episodes end, the first ones at staggered times; at most the horizon."""
    num_layouts: int = 16
    """Particle layouts from which training episodes start in turn; no effect in GROW and OBSTACLE, or with vary."""
    reward: Literal["task", "speed"] = "task"
    """Training reward: task (its own, made smooth) or speed (60 per m/s to the right, less the cost of action)."""
    split_weight: float = 1000.0
    """Weight of the cost of a large spread: the square of the amount by which spread / limit exceeds split_margin."""
    split_margin: float = 0.85
    """Fraction of the limit above which the spread costs."""
    integrity_weight: float = 300.0
    """Weight of the cost of neighbouring particles that drift apart within a window."""
    piece_weight: float = 0.0
    """Weight of the cost of mass that is torn off: the share outside the largest piece, which the critic values."""
    reward_scale: float = 0.05
    """Factor on the training reward that keeps the critic's values near one."""
    success_reward: float = 0.0
    """Reward of each step in the goal; success that ends an episode earns it for 1 / (1 - gamma) steps, at most 100."""

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, window=self.window, critic_updates=self.critic_updates)
        check_at_least(1, max_episode_steps=self.max_episode_steps, num_layouts=self.num_layouts)
        check_at_least(0, split_weight=self.split_weight, split_margin=self.split_margin)
        check_at_least(0, integrity_weight=self.integrity_weight, success_reward=self.success_reward)
        check_at_least(0, piece_weight=self.piece_weight)
        check_fraction(gamma=self.gamma, td_lambda=self.td_lambda, tau=self.tau)
        check_positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        check_positive(reward_scale=self.reward_scale)
        check_training_seeds("num_layouts", self.num_layouts, self.num_envs)


@dataclass(frozen=True, kw_only=True)
class AnalyticConfig(WindowConfig, CoarseToFineConfig):
    """Options of a run of the coarse-to-fine policy that learns by gradients through the simulation."""

    algo: str = "cfp-analytic"
    """Name of the algorithm."""
    action_step: tuple[float, ...]
    """Root mean square of each gradient step on the actions of a window, before tanh, for each stage."""
    final_step: float = 0.4
    """Fraction of action_step that is left at the end of a stage; it falls linearly."""
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

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next: a window of all robots."""
        return self.window * self.num_envs

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(0, warmup=self.warmup)
        check_at_least(1, minibatches=self.minibatches, minibatch_size=self.minibatch_size)
        check_at_least(1, windows_kept=self.windows_kept)
        check_fraction(final_step=self.final_step)
        check_below_one(weight_average=self.weight_average)
        check_positive(action_step=min(self.action_step))


def of_stage(values: tuple[Value, ...], stage: int) -> Value:
    """Value of a stage, counted from 1; the last one holds for all further stages."""
    return values[min(stage, len(values)) - 1]


def check_training_seeds(name: str, count: int, before: int = 0, stages: int = 1) -> None:
    """Check that none of the initial positions of training belongs to evaluations.

    ``name`` is the option whose value is ``count``, the number of initial positions in a stage; ``before`` others
    precede them, and each of the ``stages`` has positions of its own.
    """
    largest = (EVALUATION_SEED - before) // stages
    if count > largest:
        raise ConfigError(f"{name} must be at most {largest}, got {count}: later seeds belong to evaluations")


def check_task(task: object) -> None:
    """Check that a value names a task; a module that it names is imported."""
    try:
        dittogym.tasks.check_task(task)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def to_json(config: RunConfig) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return dataclasses.asdict(config)


def to_words(options: Mapping[str, Any]) -> list[str]:
    """Options by name as the arguments of a command line."""
    words = []
    for name, value in options.items():
        option = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", *map(str, value if isinstance(value, list | tuple) else [value])]
    return words


def update_from_dict(base: Value, values: Any) -> Value:
    """Replace fields of a dataclass by JSON values, whose types are checked; lists become tuples.

    Raises:
        ConfigError: There is no such field, or a value is of another type.
    """
    assert dataclasses.is_dataclass(base) and not isinstance(base, type)
    if not isinstance(values, dict):
        raise ConfigError(f"the options must be an object, got {brief(values)}")
    hints = typing.get_type_hints(type(base))
    names = [option.name for option in dataclasses.fields(base)]
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name not in names:
            near = difflib.get_close_matches(str(name), names)
            allowed = f"did you mean {' or '.join(near)}?" if near else f"options are {', '.join(names)}"
            raise ConfigError(f"{name} is not an option; {allowed}")
        hint, value = hints[name], tuple(value) if isinstance(value, list) else value
        parts = value if isinstance(value, tuple) else (value,)
        if typing.get_args(hint)[1:] == (...,):  # one value for all stages
            value = parts
        try:
            if hint is not bool and any(isinstance(part, bool) for part in parts):  # which Python takes for numbers
                raise TypeCheckError("is a truth value")
            check_type(value, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS)
        except TypeCheckError as error:
            expected = hint.__name__ if type(hint) is type else str(hint).replace("typing.", "")
            raise ConfigError(f"{name} must be of type {expected}, got {brief(value)}") from error
        for part in parts:
            if isinstance(part, int) and not -(2**63) <= part < 2**63:
                raise ConfigError(f"{name} must be below 2**63, got a number of {len(str(part))} digits")
        changes[name] = float(parts[0]) if hint is float else value
    return replace(base, **changes)


def differences(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Options that differ: the value in each; None where there is none."""
    names = {**first, **second}
    return {name: (first.get(name), second.get(name)) for name in names if first.get(name) != second.get(name)}
