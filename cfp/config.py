"""The options of a training run as frozen dataclasses, and their JSON form."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import dittogym.tasks
from cfp.agent.actor import ActorSpec
from cfp.agent.hyperparameters import Hyperparameters, LearningConfig
from cfp.errors import ConfigError
from cfp.from_dict import differences, flatten
from cfp.sections import EnvironmentConfig, NetworkConfig, ReportConfig
from cfp.validation import check_at_least, check_decay
from dittogym import make_spec
from dittogym.spec import TaskSpec
from dittogym.tasks import task_name

Preset = Literal["quick", "long", "paper"]
Learner = Literal["analytic", "sac"]

LARGEST_SEED = 2**31 - 1
#: Added to a run's seed for evaluations, so that they start from initial positions that are not trained on.
EVALUATION_SEED = 10_000
#: Entry of ``RunConfig.ineffective`` where every episode begins on a layout that is counted from the seed.
RESAMPLE_NEEDS_SAC = {
    "environment.resample": "soft actor-critic (learner sac, or algo coarse, fine, gnn-*, transformer-*)"
}


@dataclass(frozen=True)
class RunConfig:
    """Options of a training run that every algorithm has; its stages are counted from 1."""

    task: str
    """Task; MODULE:NAME for a custom task that the module registers."""
    algo: str = "cfp"
    """Name of the algorithm."""
    preset: Preset = "quick"
    """Set of default options: quick (minutes), paper (the published values), or long (a night; only for algorithms that
    learn by soft actor-critic). With paper and long CFP has learner sac."""
    seed: int = 0
    """Seed of everything that is random."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    report: ReportConfig = field(default_factory=ReportConfig)

    changeable: ClassVar[tuple[str, ...]] = (
        "device",
        *(f"report.{name}" for name in ("eval_every", "patience", "checkpoint_every", "log_every")),
        *(f"report.{name}" for name in ("video", "video_every", "wandb", "wandb_project")),
        "environment.backend",
    )
    """Options that a resumed run may change."""

    @property
    def name(self) -> str:
        """Name of the run, used for its folder."""
        return f"{self.algo}-{task_name(self.task)}-{self.preset}-{self.seed}"

    def make_spec(self) -> TaskSpec:
        """The task, with its options."""
        return make_spec(self.task, **self.environment.task_options())

    @property
    def training_environment(self) -> EnvironmentConfig:
        """Options of the simulations in training."""
        return self.environment

    def for_training(self) -> RunConfig:
        """These options, with the simulations of training as the environment."""
        return replace(self, environment=self.training_environment)

    def ends(self) -> tuple[int, ...]:
        """Environment steps since the beginning of the run after which each stage ends."""
        raise NotImplementedError

    def stage_steps(self, stage: int) -> int:
        """Environment steps of a stage."""
        bounds = (0, *self.ends())
        return bounds[stage] - bounds[stage - 1]

    def resolution(self, stage: int) -> int:
        """Action grid R of a stage."""
        raise NotImplementedError

    def action_size(self, stage: int) -> int:
        """Rows and columns of the actions that the environment of a stage takes."""
        return self.resolution(stage)

    def evaluation(self, stage: int) -> tuple[int, int]:
        """Seed of the first episode, and number of episodes, of the evaluations during a stage."""
        return self.seed + EVALUATION_SEED, self.report.eval_episodes

    def with_derived(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """These options, with those that follow from others in the preset ``base`` computed anew unless given."""
        return self

    def ineffective(self) -> dict[str, str]:
        """Options without effect under the others, and what they require (a trailing dot: the whole section)."""
        return {"report.wandb_project": "wandb"} if self.report.wandb == "off" else {}

    def check_effect(self, base: RunConfig, given: Collection[str] | None = None) -> None:
        """Refuse options, all or those ``given``, that differ from the preset ``base`` but are `ineffective`."""
        ineffective = self.ineffective()
        for name, (value, _) in differences(to_json(self), to_json(base)).items():
            for option, required in ineffective.items():
                if name.startswith(option) and (given is None or name in given):
                    raise ConfigError(f"{name.split('.')[-1]} requires {required}, got {value!r} without it")

    def check(self) -> None:
        """Check what the types do not express.

        Raises:
            ConfigError: An option is wrong.
        """
        check_task(self.task)
        for name, value in flatten(to_json(self)).items():  # JSON files and command lines can contain NaN and infinity
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    raise ConfigError(f"{name.split('.')[-1]} must be finite, got {value}")
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ConfigError(f"seed must be between 0 and {LARGEST_SEED}, got {self.seed}")
        for option in dataclasses.fields(self):
            section = getattr(self, option.name)
            if hasattr(section, "check"):
                section.check()
        check_training_layouts("num_envs", self.environment.num_envs)
        _ = self.training_environment  # checks its options


@dataclass(frozen=True, kw_only=True)
class StagedConfig(RunConfig):
    """A run that trains several stages with action grids of increasing resolution, listed coarsest first."""

    steps: int
    """Environment steps of all stages together, including those that start_from replaces."""
    handover: tuple[int, ...]
    """Environment steps at which the next stage begins, one number for each stage but the last."""
    resolutions: tuple[int, ...]
    """Action grid R of each stage."""
    gate_bias: tuple[float, ...]
    """Bias of the gate logit of each stage but the first."""
    network: NetworkConfig = field(default_factory=NetworkConfig)

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)
    per_stage: ClassVar[tuple[str, ...]] = ()
    """Options with one value for each stage."""
    per_residual_stage: ClassVar[tuple[str, ...]] = ("handover", "gate_bias")
    """Options with one value for each stage but the first."""

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next."""
        return self.environment.num_envs

    def ends(self) -> tuple[int, ...]:
        """Environment steps since the beginning of the run after which each stage ends."""
        return (*self.handover, self.steps)

    def resolution(self, stage: int) -> int:
        """Action grid R of a stage."""
        return self.resolutions[stage - 1]

    def action_size(self, stage: int) -> int:
        """Rows and columns of the actions that the environment of a stage takes."""
        return self.actor_spec(stage).action_size

    def actor_spec(self, stage: int) -> ActorSpec:
        """Structure of the actor of a stage, including all coarser ones."""
        return ActorSpec(
            resolutions=self.resolutions[:stage],
            gate_bias=self.gate_bias[: stage - 1],
            split=self.network.split,
            gate_scale=self.network.gate_scale,
            interpolation=self.network.interpolation,
            patch=None if self.network.interpolation == "aligned" else make_spec(self.task).patch,
            encoder=self.network.encoder,
        )

    def with_derived(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """Scale the handovers with the steps; other numbers of stages are equally long, and repeat the last values."""
        assert isinstance(base, StagedConfig)
        check_at_least(1, steps=self.steps)
        stages, scale, changes = len(self.resolutions), self.steps / base.steps, dict[str, Any]()
        for name, count in self._counts().items():
            values: tuple[float, ...] = getattr(base, name)
            changes[name] = (*values, *values[-1:] * count)[:count]
        if stages == len(base.resolutions):
            changes["handover"] = tuple(round(step * scale) for step in base.handover)
        else:
            changes["handover"] = tuple(round(self.steps * stage / stages) for stage in range(1, stages))
        return replace(self, **{name: value for name, value in changes.items() if name not in given})

    def ineffective(self) -> dict[str, str]:
        """Options without effect under the others: a single stage has no gate."""
        single = {"network.gate_scale": "several resolutions"} if len(self.resolutions) == 1 else {}
        small = {"network.split": "encoder paper"} if self.network.encoder == "small" else {}
        return super().ineffective() | single | small

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        if max(self.resolutions, default=0) > (patch := make_spec(self.task).patch):
            raise ConfigError(f"resolutions must be at most {patch} in {self.task}, got {self.resolutions}")
        self.actor_spec(len(self.resolutions))  # checks the resolutions
        check_at_least(1, steps=self.steps)
        for name, count in self._counts().items():
            if (found := len(getattr(self, name))) != count:
                raise ConfigError(f"{name} must have {count} values for resolutions {self.resolutions}, got {found}")
        lengths = tuple(end - start for start, end in pairwise((0, *self.ends())))
        if min(lengths) < (least := self.update_every):
            raise ConfigError(
                f"steps and handover must give every stage at least {least} steps, those of one update, got stages of "
                f"{', '.join(map(str, lengths))} steps"
            )

    def _counts(self) -> dict[str, int]:
        """Number of values of each option that has one for each stage or residual stage."""
        stages = len(self.resolutions)
        return dict.fromkeys(self.per_stage, stages) | dict.fromkeys(self.per_residual_stage, stages - 1)


@dataclass(frozen=True, kw_only=True)
class CoarseToFineConfig(StagedConfig):
    """A run of the coarse-to-fine policy with either learner; `cfp.preset` supplies the values for a task."""

    learner: Learner
    """analytic: learns by exact gradients of the simulation; sac: from rewards alone, as in the paper."""
    start_from: str | None = None
    """Policy of the first stages (a run folder, policy.safetensors, the name of one that comes with the package, or
    hf://OWNER/NAME): training begins with the stage after it."""
    refine: bool = False
    """Continue to train the last stage of start_from instead."""

    own_learner: ClassVar[Learner]
    """The learner that these are the options of."""

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        if self.learner != self.own_learner:
            raise ConfigError(f"learner must be {self.own_learner} for algo {self.algo}, got {self.learner}")
        if self.refine and self.start_from is None:
            raise ConfigError("refine requires start_from, which names the policy")


@dataclass(frozen=True, kw_only=True)
class SACConfig(CoarseToFineConfig):
    """A run of the coarse-to-fine policy that learns from rewards alone, by soft actor-critic."""

    learner: Learner = "sac"
    random_steps: tuple[int, ...]
    """Uniformly random environment steps at the start of each stage (none where a policy is refined)."""
    alpha: tuple[float, ...]
    """Entropy temperature of each stage."""
    gate_penalty: tuple[float, ...]
    """Weight of the gate penalty, for each stage but the first."""
    critics_first: float = 0.0
    """Fraction of every stage but the first in which only the critics learn, if that is more than actor_start."""
    max_episode_steps: int | None = None
    """Steps after which training episodes are truncated, if the task's horizon is not shorter; robots begin at
    different ages. None: the horizon, and all begin together."""
    learning: LearningConfig = field(default_factory=LearningConfig)

    own_learner: ClassVar[Learner] = "sac"
    per_stage: ClassVar[tuple[str, ...]] = ("random_steps", "alpha")
    per_residual_stage: ClassVar[tuple[str, ...]] = (*StagedConfig.per_residual_stage, "gate_penalty")

    def with_derived(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """Scale the start of the actor's updates, too, if there are fewer steps."""
        config = super().with_derived(base, given)
        assert isinstance(config, SACConfig) and isinstance(base, SACConfig)
        return replace(config, learning=scale_start(self.learning, base.learning, self.steps / base.steps, given))

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of a stage."""
        own = dict(vars(self.learning))
        if stage > 1:
            own["actor_start"] = max(own["actor_start"], round(self.critics_first * self.stage_steps(stage)))
        return Hyperparameters(
            **own,
            alpha=self.alpha[stage - 1],
            gate_penalty=self.gate_penalty[stage - 2] if stage > 1 else 0.0,
            random_steps=self.random_steps[stage - 1],
        )

    def ineffective(self) -> dict[str, str]:
        """Options that require a policy to refine, or noise on cells."""
        anchor = {} if self.refine else {"learning.anchor": "refine"}
        noise = {} if self.learning.noise_cells else {"learning.noise_scale": "noise_cells"}
        single = {"critics_first": "several resolutions"} if len(self.resolutions) == 1 else {}
        return super().ineffective() | anchor | noise | single

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        for name in ("random_steps", "alpha", "gate_penalty"):
            check_at_least(0, **{name: min(getattr(self, name), default=0)})
        check_decay(critics_first=self.critics_first)
        if self.max_episode_steps is not None:
            check_at_least(1, max_episode_steps=self.max_episode_steps)
        if (cells := self.learning.noise_cells) > (coarsest := self.resolutions[0]):
            raise ConfigError(f"noise_cells must be at most {coarsest}, the coarsest of resolutions, got {cells}")


def scale_start(
    learning: LearningConfig, base: LearningConfig, fraction: float, given: Collection[str]
) -> LearningConfig:
    """Start the actor's updates earlier in a run with a ``fraction`` of the steps of the preset ``base``."""
    if "actor_start" in given or fraction >= 1:
        return learning
    return replace(learning, actor_start=round(base.actor_start * fraction))


def check_training_layouts(name: str, count: int, before: int = 0, stages: int = 1) -> None:
    """Check that none of the initial positions of training belongs to evaluations.

    Args:
        name: Name of an option.
        count: Its value, the number of initial positions in a stage.
        before: How many others precede them.
        stages: Stages with initial positions of their own.
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
