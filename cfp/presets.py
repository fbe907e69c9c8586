"""The presets of the eight tasks.

Those of ``paper`` are from the reference's configuration files and the paper (DittoGym, ICLR 2024, Section 5 and
Appendix B).
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import dittogym
from cfp.agent.hyperparameters import LearningConfig
from cfp.analytic.config import AnalyticConfig
from cfp.analytic.reward import RewardConfig
from cfp.config import CoarseToFineConfig, Learner, Preset, SACConfig, check_task
from cfp.errors import ConfigError
from cfp.from_dict import Options, update_from_dict
from cfp.policy import load
from cfp.sections import EnvironmentConfig, NetworkConfig, ReportConfig


@dataclass(frozen=True)
class TaskNumbers:
    """Published hyperparameters of one task; pairs are those of stages 1 and 2."""

    alpha: tuple[float, float]  # temperature
    gate_bias: float
    gate_penalty: float
    steps: int  # environment steps plotted in the paper
    handover: int  # step at which the paper's curves change from stage 1 to stage 2
    seed: int = 0  # of the published weights
    resolutions: tuple[int, int] = (8, 16)
    random_steps: tuple[int, int] = (6000, 100)
    split: bool = False  # separate encoders for observation and action, with a gate of at most 0.25
    variant: Literal["published"] | None = None  # material, where the published run changed it
    deterministic: bool = False  # evaluation without action noise


# For GROW and CATCH no stage-2 configuration was published; stage 1's values are used.
TASKS: dict[str, TaskNumbers] = {
    "shapematch": TaskNumbers(
        (0.01, 0.0), -2.0, 0.8, 400_000, 142_000, resolutions=(32, 64), random_steps=(500, 100), deterministic=True
    ),
    "run": TaskNumbers((0.01, 0.01), -1.0, 0.01, 550_000, 301_000),
    "grow": TaskNumbers((0.01, 0.01), -1.0, 0.01, 600_000, 407_000),
    "kick": TaskNumbers((0.05, 0.05), -1.0, 0.0, 550_000, 132_000),
    "dig": TaskNumbers((0.05, 0.05), 0.0, 3.0, 780_000, 567_000, split=True),
    "obstacle": TaskNumbers((0.05, 0.05), -1.0, 0.04, 700_000, 530_000),
    "catch": TaskNumbers((0.1, 0.1), -1.0, 0.01, 380_000, 243_000, seed=2),
    "slot": TaskNumbers((0.05, 0.05), -2.0, 0.1, 600_000, 293_000, seed=1, variant="published"),
}


# Short episodes show more beginnings, and fewer bodies that have been torn by what came before. The actor learns from
# many windows, so that it keeps its gait. In other tasks such an actor averages over old actions, and learns little of
# the few new ones that lead over a stair, through a passage or into the soil.
_LONG_MEMORY: dict[str, Any] = {
    "windows_kept": 40,
    "minibatches": 48,
    "minibatch_size": 128,
    "weight_average": 0.995,
    "max_episode_steps": 200,
    "num_layouts": 256,
    "environment": EnvironmentConfig(num_envs=8),
}
#: Options of the learner ``analytic`` that differ from task to task; found by the experiments that the documentation
#: reports.
ANALYTIC: dict[str, dict[str, Any]] = {
    "shapematch": {
        "steps": 4_800,
        "handover": (3_200,),
        "action_step": (0.3, 0.3),
        "gate_bias": (-2.0,),
        "windows_kept": 2,
        "td_lambda": 0.0,
        "minibatches": 24,
        "weight_average": 0.98,
        "warmup": 0,
        "num_layouts": 256,
    },
    "run": _LONG_MEMORY | {"steps": 12_800, "handover": (9_600,)},
    "kick": _LONG_MEMORY | {"steps": 41_600, "handover": (38_400,), "action_step": (0.15, 0.02)},
    "grow": {"steps": 16_000, "handover": (12_800,)},
    "obstacle": {"steps": 48_000, "handover": (44_800,), "final_step": 0.3, "displacement": True},
    "slot": {"steps": 19_200, "handover": (16_000,)},
    "catch": {"steps": 28_800, "handover": (25_600,), "max_episode_steps": 300},
    "dig": {"steps": 28_800, "handover": (25_600,), "weight_average": 0.98},
}
#: Tasks in which gradient methods are trained on speed to the right instead of the task's reward.
ON_SPEED = ("run", "obstacle")

#: Options of the presets ``quick`` and ``long`` of the learner ``sac`` that differ from task to task.
SAC: dict[str, dict[str, Any]] = {
    # Without gravity noise on cells drives the robot apart. In episodes of 30 steps one-step returns lead further.
    "shapematch": {"learning": {"noise_cells": 0, "n_steps": 1, "actor_start": 600}},
    "obstacle": {"alpha": (0.005, 0.005)},  # that of RUN; with five times as much the robot does not reach the stairs
    # Without these options returns are lower, and differ more from episode to episode.
    "slot": {"alpha": (0.005, 0.005), "learning": {"gamma": 0.99, "n_steps": 10}, "max_episode_steps": 1_000},
    # The way through the soil takes hundreds of steps. The paper's penalty closes the gate for good.
    "dig": {"learning": {"gamma": 0.99}, "gate_penalty": (0.01,)},
}
#: Tasks in which ``quick`` makes one update of the networks for each step. With fewer, KICK, OBSTACLE, GROW and DIG
#: learned less in the same time; SLOT was not tried with fewer.
MANY_UPDATES = ("kick", "obstacle", "grow", "slot", "dig")
#: Task of a command line that names none.
DEFAULT_TASK = "shapematch"
#: Numbers of a custom task, for which nothing was published; its action grids are its own.
CUSTOM_TASK = TASKS["run"]


def preset(task: str, name: Preset = "quick", learner: Learner | None = None) -> CoarseToFineConfig:
    """The defaults of a task.

    Args:
        task: One of `dittogym.TASKS`, or ``"MODULE:NAME"``. A custom task, for which nothing was published,
            has its own action grids, with the learner ``"sac"`` the numbers of RUN, and no preset ``"paper"``.
        name: ``"paper"``: one robot with full particles, the published numbers, the reference's interpolation and
            faults. ``"quick"``: several robots with fewer particles, minutes instead of days. For the learner ``"sac"``
            also ``"long"``, the same as ``"quick"`` for a night of eight hours on two cores.
        learner: ``"analytic"`` or ``"sac"``; by default ``"analytic"`` for ``"quick"``, and ``"sac"`` for the other
            presets, which have no other.

    Raises:
        ConfigError: There is no such task, preset or learner.
    """
    if learner is None:
        learner = "analytic" if name == "quick" else "sac"
    if learner not in typing.get_args(Learner):
        raise ConfigError(f"learner must be analytic or sac, got {learner!r}")
    return sac_preset(task, name) if learner == "sac" else analytic_preset(task, name)


def sac_preset(task: str, name: str = "quick") -> SACConfig:
    """The defaults of the learner ``sac``, see `preset`."""
    check_task(task)
    allowed = typing.get_args(Preset) if task in TASKS else ("quick", "long")
    if name not in allowed:
        raise ConfigError(f"preset must be one of {', '.join(allowed)} for {task}, got {name!r}")
    numbers = _numbers(task)
    return {"paper": _paper, "quick": _quick, "long": _long}[name](task, numbers)


def analytic_preset(task: str, name: str = "quick") -> AnalyticConfig:
    """The defaults of the learner ``analytic``, see `preset`."""
    check_task(task)
    if name != "quick":
        raise ConfigError(f"preset must be quick for learner analytic, got {name!r}")
    published, on_speed = _paper(task, _numbers(task)), task in ON_SPEED
    options: dict[str, Any] = {
        "steps": 25_600,
        "handover": (19_200,),
        "action_step": (0.1, 0.02),
        "gate_bias": (-3.0,),  # a gate that is nearly closed leaves the coarse policy as it is at first
        "environment": EnvironmentConfig(num_envs=4),
        "displacement": not on_speed,
    } | ANALYTIC.get(task, {})
    return AnalyticConfig(
        task=task,
        resolutions=published.resolutions,
        reward=RewardConfig("speed" if on_speed else "task"),
        network=replace(published.network, interpolation="half_pixel"),
        report=ReportConfig(eval_every=options["steps"] // 12, checkpoint_every=options["steps"] // 12, log_every=320),
        **options,
    )


def _numbers(task: str) -> TaskNumbers:
    if task in TASKS:
        return TASKS[task]
    spec = dittogym.make_spec(task)
    return replace(CUSTOM_TASK, resolutions=(spec.coarse, spec.fine))


def _paper(task: str, numbers: TaskNumbers) -> SACConfig:
    return SACConfig(
        task=task,
        preset="paper",
        seed=numbers.seed,
        steps=numbers.steps,
        handover=(numbers.handover,),
        resolutions=numbers.resolutions,
        random_steps=numbers.random_steps,
        alpha=numbers.alpha,
        gate_bias=(numbers.gate_bias,),
        gate_penalty=(numbers.gate_penalty,),
        environment=EnvironmentConfig(num_envs=1, particles="full", parity="reference", variant=numbers.variant),
        network=NetworkConfig(interpolation="aligned", split=numbers.split, gate_scale=0.25 if numbers.split else 1.0),
        report=ReportConfig(eval_deterministic=numbers.deterministic),
    )


def _quick(task: str, numbers: TaskNumbers) -> SACConfig:
    """Minutes instead of days: many small robots, small networks, coarser actions first."""
    paper, horizon, many = _paper(task, numbers), dittogym.make_spec(task).horizon, task in MANY_UPDATES
    steps = 48_000 if many else 38_400
    coarse = numbers.resolutions[0]
    # A gate that begins nearly closed and critics that learn first disturb the policy of the first stage least.
    config = replace(
        paper,
        preset="quick",
        seed=0,
        steps=steps,
        handover=(steps * 3 // 4,),
        resolutions=(coarse // 2, coarse) if coarse > 4 else numbers.resolutions,
        random_steps=(480, 100),
        alpha=(0.5 * numbers.alpha[0],) * 2,
        gate_bias=(-3.0,),
        critics_first=0.5,
        max_episode_steps=max(30, horizon // 4),
        environment=EnvironmentConfig(),
        network=replace(paper.network, interpolation="half_pixel", encoder="small"),
        learning=LearningConfig(
            batch_size=64 if many else 128,
            learning_rate=5e-4,
            gamma=0.95,
            tau=0.01,
            buffer_size=20_000 if many else 50_000,
            gradient_steps=16 if many else 4,
            actor_start=800 if many else 2_250,
            noise_cells=4,
            noise_scale=(0.2, 1.0),
            final_rate=0.1,
            n_steps=3,
            weight_average=0.998,
        ),
        report=ReportConfig(eval_every=steps // 8, checkpoint_every=steps // 16, log_every=320),
    )
    return update_from_dict(config, SAC.get(task, {}))


def _long(task: str, numbers: TaskNumbers) -> SACConfig:
    """A night of eight hours on two cores: more steps and a longer memory."""
    quick = _quick(task, numbers)
    steps = 819_200 if task in MANY_UPDATES else 1_638_400
    return replace(
        quick,
        preset="long",
        steps=steps,
        handover=(steps // 2,),
        critics_first=0.01,  # about as many steps as in quick
        learning=replace(quick.learning, buffer_size=100_000),
        report=replace(quick.report, eval_every=steps // 40, checkpoint_every=steps // 80, log_every=4_800),
    )


def from_json(values: dict[str, Any]) -> CoarseToFineConfig:
    """A configuration from JSON values; those that are left out come from the preset that the values name."""
    if (algo := values.get("algo", "cfp")) != "cfp":
        programs = "python -m baselines.train, baselines.evaluate and baselines.robustness run other algorithms"
        raise ConfigError(f"algo must be 'cfp', got {algo!r}; {programs}")
    base = preset(values.get("task", DEFAULT_TASK), values.get("preset", "quick"), values.get("learner"))
    return update_from_dict(like_start(base, values), values)


def like_start(base: Options, values: dict[str, Any]) -> Options:
    """A default configuration for the policy that the JSON ``values`` start from, if any.

    A policy of as many stages that is refined keeps its action grids. For policies with the paper's networks the next
    grid is the paper's. An update takes several times as long, so there are fewer, of smaller batches. Strong
    exploration noise would disturb a policy that can do something already. What else differs was not measured for them.
    """
    if not isinstance(base, CoarseToFineConfig) or values.get("start_from") is None:
        return base
    if {option.name for option in fields(base)} <= values.keys():  # those of a run, whose start may be gone by now
        return base
    spec, small = load(values["start_from"]).spec, base.network.encoder == "small"
    base = replace(base, network=replace(base.network, encoder=spec.encoder))
    if isinstance(base, SACConfig) and small and spec.encoder != "small":
        usual = {name: getattr(LearningConfig(), name) for name in ("n_steps", "weight_average")}
        learning = replace(base.learning, gradient_steps=4, batch_size=64, noise_cells=0, **usual)
        base = replace(base, learning=learning, max_episode_steps=None)
        if len(base.resolutions) > 1:
            base = replace(base, resolutions=_numbers(base.task).resolutions)
    if values.get("refine") and len(spec.resolutions) == len(base.resolutions):
        return replace(base, resolutions=spec.resolutions, gate_bias=spec.gate_bias)
    return base
