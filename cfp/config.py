"""All options of a run as frozen dataclasses, and their JSON form."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

from cfp.agent.actor import ActorSpec
from cfp.agent.networks import RESOLUTIONS
from cfp.errors import ConfigError
from cfp.experiment.from_dict import flatten
from cfp.experiment.from_dict import merge as merge
from cfp.groups import EnvironmentConfig as EnvironmentConfig
from cfp.groups import LearningConfig as LearningConfig
from cfp.groups import NetworkConfig as NetworkConfig
from cfp.groups import ReportConfig as ReportConfig
from cfp.groups import Tier as Tier
from cfp.groups import at_least_one as at_least_one
from cfp.groups import not_negative as not_negative
from cfp.groups import positive as positive
from cfp.groups import share as share
from dittogym import make_spec
from dittogym.tasks import allowed_instead, task_name

Preset = Literal["quick", "paper"]

LARGEST_SEED = 2**31 - 1
SEVERAL = "resolutions of several levels"
EVALUATION_SEED = 10_000
"""Added to a run's seed for evaluations, so that they start from particle layouts not trained on."""


@dataclass(frozen=True)
class RunConfig:
    """Options of a training run that every algorithm has.

    Training goes through one or more stages; what an algorithm says about them here is what its runs are made of.
    """

    algo: str = "cfp"
    """Which algorithm."""
    task: str = "shapematch"
    """Which task; MODULE:NAME for one of your own, which the module registers."""
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
        return f"{self.algo}-{task_name(self.task)}-{self.preset}-{self.seed}"

    def ends(self) -> tuple[int, ...]:
        """Environment steps since the beginning of the run after which each stage ends."""
        raise NotImplementedError

    def resolution(self, level: int) -> int:
        """Action grid R of a stage; ``level`` is its index, 0 the first."""
        raise NotImplementedError

    def action_size(self, level: int) -> int:
        """Rows and columns of the actions that the environment of a stage takes."""
        return self.resolution(level)

    def evaluation(self, level: int) -> tuple[int, int]:
        """Seed of the first layout, and episodes, by which stage ``level`` is evaluated while it trains."""
        return self.seed + EVALUATION_SEED, self.report.eval_episodes

    def adapted(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """These options with what follows from others, unless it was given too.

        Args:
            base: The preset.
            given: Names of the options that do not come from there, even if their values are the same.
        """
        return self

    def idle(self) -> dict[str, str]:
        """Options that change nothing as the others are, with what they need (a dot at the end: the whole group)."""
        return {"report.wandb_project": "wandb"} if self.report.wandb == "off" else {}

    def check_effect(self, base: RunConfig, given: Collection[str] | None = None) -> None:
        """Refuse options that differ from those of ``base``, the preset, and change nothing, see `idle`.

        Args:
            base: The preset.
            given: Names, with dots, of the options that are looked at; all if None.

        Raises:
            ConfigError: Naming the option, what was given and what it needs.
        """
        mine, theirs = flatten(to_json(self)), flatten(to_json(base))
        for option, needs in self.idle().items():
            for name, value in mine.items():
                if name.startswith(option) and value != theirs[name] and (given is None or name in given):
                    leaf = name.split(".")[-1]
                    raise ConfigError(f"{leaf}: got {value!r}, which changes nothing; allowed with {needs}")

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        _check_finite(self)
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ConfigError(f"seed: got {self.seed}, allowed 0 to {LARGEST_SEED}")
        at_least_one(
            num_envs=self.environment.num_envs,
            substeps=self.environment.substeps,
            eval_episodes=self.report.eval_episodes,
            checkpoint_every=self.report.checkpoint_every,
            log_every=self.report.log_every,
        )
        training_layouts("num_envs", self.environment.num_envs)
        for name in ("eval_every", "video_every"):
            if (every := getattr(self.report, name)) < 0:
                raise ConfigError(f"{name}: got {every}, allowed 0 (never) or more")
        if self.report.patience < 0 or (self.report.patience and not self.report.eval_every):
            raise ConfigError(f"patience: got {self.report.patience}, allowed 0, or more with evaluations (eval_every)")


@dataclass(frozen=True)
class StageConfig:
    """One level of the ladder, as `Config.stage` cuts it out."""

    resolution: int
    steps: int
    random_steps: int
    alpha: float
    gate_penalty: float


@dataclass(frozen=True)
class SACConfig(RunConfig):
    """A run of `cfp.agent.sac.CFP`, whatever its networks."""

    learning: LearningConfig = field(default_factory=LearningConfig)

    def stage(self, level: int) -> StageConfig:
        """What the training of stage ``level`` needs."""
        raise NotImplementedError

    def check(self) -> None:
        """Check what the types cannot, see `RunConfig.check`."""
        super().check()
        self.learning.check()


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

    def adapted(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """Other steps move the handovers in proportion; another number of levels stretches what each has one of.

        Then levels are equally long, and further ones have the values of the last one that has any.
        """
        assert isinstance(base, LadderConfig)
        levels, share, changes = len(self.resolutions), self.steps / base.steps, dict[str, Any]()
        for name, count in self.counts().items():
            values: tuple[float, ...] = getattr(base, name)
            changes[name] = (*values, *values[-1:] * count)[:count]
        if levels == len(base.resolutions):
            changes["handover"] = tuple(round(step * share) for step in base.handover)
        else:
            changes["handover"] = tuple(round(self.steps * level / levels) for level in range(1, levels))
        return replace(self, **{name: value for name, value in changes.items() if name not in given})

    def idle(self) -> dict[str, str]:
        """One level has no gate."""
        return super().idle() | ({"network.gate_scale": SEVERAL} if len(self.resolutions) == 1 else {})

    def counts(self) -> dict[str, int]:
        """How many values each option has that has one for a level."""
        levels = len(self.resolutions)
        return dict.fromkeys(self.per_level, levels) | dict.fromkeys(self.per_residual, levels - 1)

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
        at_least_one(steps=self.steps)
        positive(gate_scale=self.network.gate_scale)
        for name, count in self.counts().items():
            given = len(getattr(self, name))
            if given != count:
                raise ConfigError(f"{name}: got {given} values, allowed {count} for resolutions {self.resolutions}")
        check_task(self.task)
        if self.resolutions[-1] > (patch := make_spec(self.task).patch):
            raise ConfigError(f"resolutions: got {self.resolutions}, allowed in {self.task} is at most {patch}")
        if any(late <= early for early, late in pairwise((0, *self.ends()))):
            raise ConfigError(
                f"handover: got {self.handover}, allowed are growing numbers between 0 and the steps, {self.steps}"
            )
        super().check()


@dataclass(frozen=True)
class Config(LadderConfig, SACConfig):
    """A run of CFP. Levels are listed coarsest first; one value per level unless said otherwise."""

    random_steps: tuple[int, ...] = (500, 100)
    """Uniformly random environment steps at the start of each level (none where a policy is refined)."""
    alpha: tuple[float, ...] = (0.01, 0.01)
    """Entropy temperature of each level."""
    gate_penalty: tuple[float, ...] = (0.01,)
    """Weight of the gate penalty (one less than levels)."""
    start_from: str | None = None
    """Policy of the first levels (a run folder, policy.safetensors, or the name of one that comes with the package):
    training begins with the level after it."""
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

    def idle(self) -> dict[str, str]:
        """What concerns a policy that is refined, or the level before."""
        idle = super().idle() | ({} if self.refine else {"learning.anchor": "refine"})
        return idle | ({"learning.warm_critic": SEVERAL} if len(self.resolutions) == 1 else {})

    def check(self) -> None:
        """Check what the types cannot, see `LadderConfig.check`."""
        super().check()
        for name in ("random_steps", "alpha", "gate_penalty"):
            for value in getattr(self, name):
                not_negative(**{name: value})
        if self.learning.warm_critic and self.start_from is not None:
            raise ConfigError("warm_critic: got True, allowed without start_from (a policy brings no critics)")
        if self.refine and self.start_from is None:
            raise ConfigError("refine: got True, allowed with start_from, which names the policy")


def training_layouts(name: str, count: int, before: int = 0) -> None:
    """Check how many layouts are trained on, which are counted on from the seed.

    Args:
        name: The option that says so.
        count: How many.
        before: Those that come first for another reason, such as one for each robot.

    Raises:
        ConfigError: The last of them would be one of those that judge.
    """
    if before + count > EVALUATION_SEED:
        raise ConfigError(
            f"{name}: got {count} layouts, allowed {EVALUATION_SEED - before}: further ones judge policies"
        )


def check_task(task: object) -> None:
    """Check that something names a task; a module that it names is imported.

    Raises:
        ConfigError: It does not.
    """
    if (allowed := allowed_instead(task)) is not None:
        raise ConfigError(f"task: got {task!r}, allowed {allowed}")


def to_json(config: RunConfig) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return dataclasses.asdict(config)


def _check_finite(options: Any) -> None:
    """Refuse NaN and infinity wherever they are, which JSON and command lines let through."""
    for option in dataclasses.fields(options):
        value = getattr(options, option.name)
        if dataclasses.is_dataclass(value):
            _check_finite(value)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ConfigError(f"{option.name}: got {value}, allowed are finite numbers")
