"""The presets of the eight tasks.

The numbers of the ``paper`` presets are those of the reference implementation's configuration files and of the
paper's figures (Section 5 and Appendix B of DittoGym, ICLR 2024).
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, replace
from typing import Any, Literal

import dittogym
from cfp.config import Config, EnvironmentConfig, LearningConfig, NetworkConfig, Preset, ReportConfig, check_task, merge
from cfp.errors import ConfigError


@dataclass(frozen=True)
class TaskNumbers:
    """Published hyper-parameters of one task.

    Attributes:
        alpha: Temperature of stage 1 and 2.
        gate_bias: Bias of the gate's logit.
        gate_penalty: Weight rho of the gate penalty.
        steps: Environment steps plotted in the paper.
        handover: Step at which the paper's curves change from stage 1 to stage 2.
        seed: Seed of the published weights.
        resolutions: Action grid of stage 1 and 2.
        random_steps: Uniformly random steps of stage 1 and 2.
        split: Split encoders with a gate of at most 0.25.
        variant: Of the task's matter, where the published run changed it.
    """

    alpha: tuple[float, float]
    gate_bias: float
    gate_penalty: float
    steps: int
    handover: int
    seed: int = 0
    resolutions: tuple[int, int] = (8, 16)
    random_steps: tuple[int, int] = (6000, 100)
    split: bool = False
    variant: Literal["published"] | None = None


# For GROW and CATCH no stage-2 configuration was published: stage 1's values are taken.
TASKS: dict[str, TaskNumbers] = {
    "shapematch": TaskNumbers((0.01, 0.0), -2.0, 0.8, 400_000, 142_000, resolutions=(32, 64), random_steps=(500, 100)),
    "run": TaskNumbers((0.01, 0.01), -1.0, 0.01, 550_000, 301_000),
    "grow": TaskNumbers((0.01, 0.01), -1.0, 0.01, 600_000, 407_000),
    "kick": TaskNumbers((0.05, 0.05), -1.0, 0.0, 550_000, 132_000),
    "dig": TaskNumbers((0.05, 0.05), 0.0, 3.0, 780_000, 567_000, split=True),
    "obstacle": TaskNumbers((0.05, 0.05), -1.0, 0.04, 700_000, 530_000),
    "catch": TaskNumbers((0.1, 0.1), -1.0, 0.01, 380_000, 243_000, seed=2),
    "slot": TaskNumbers((0.05, 0.05), -2.0, 0.1, 600_000, 293_000, seed=1, variant="published"),
}


def preset(task: str, name: str = "quick") -> Config:
    """The defaults of a task.

    Args:
        task: One of `dittogym.TASKS`, or ``"MODULE:NAME"``. A task of one's own, for which nothing was
            published, gets the numbers of RUN on its own grids, and has no preset ``"paper"``.
        name: ``"paper"``: one robot at full size, the published numbers, the reference's interpolation and faults.
            ``"quick"``: sixteen robots at the lite tier, larger steps, minutes instead of days.

    Raises:
        ConfigError: No such task or preset.
    """
    check_task(task)
    allowed = typing.get_args(Preset) if task in TASKS else ("quick",)
    if name not in allowed:
        raise ConfigError(f"preset: got {name!r}, allowed {', '.join(allowed)} for {task}")
    numbers = TASKS[task] if task in TASKS else _own_numbers(task)
    paper = Config(
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
        network=NetworkConfig("aligned", numbers.split, 0.25 if numbers.split else 1.0),
        report=ReportConfig(eval_deterministic=task == "shapematch"),
    )
    return paper if name == "paper" else _quick(paper)


def _own_numbers(task: str) -> TaskNumbers:
    """RUN's numbers on the grids of another task."""
    spec = dittogym.make_spec(task)
    return replace(TASKS["run"], resolutions=(spec.coarse, spec.fine))


def _quick(paper: Config) -> Config:
    """Shrink a published configuration to minutes: many small robots, small batches, a shorter horizon of credit."""
    quick = replace(
        paper,
        preset="quick",
        seed=0,
        steps=4_800,
        handover=(3_200,),
        random_steps=(480, 100),
        alpha=(0.5 * paper.alpha[0], paper.alpha[1]),
        environment=EnvironmentConfig(),
        network=replace(paper.network, interpolation="half_pixel"),
        learning=LearningConfig(
            batch_size=64, learning_rate=1e-3, gamma=0.9, tau=0.01, buffer_size=20_000, gradient_steps=4
        ),
        report=replace(paper.report, eval_every=480, eval_deterministic=False, checkpoint_every=480, log_every=160),
    )
    return quick


def from_json(values: dict[str, Any], program: str = "train") -> Config:
    """A configuration from JSON values; what they leave out comes from the preset they name.

    Args:
        values: Options by name.
        program: Which one of `baselines` takes other algorithms, for the message.

    Raises:
        ConfigError: An unknown name or a value of the wrong type.
    """
    if (algo := values.get("algo", "cfp")) != "cfp":
        raise ConfigError(f"algo: got {algo!r}, allowed 'cfp'; python -m baselines.{program} takes others")
    base = preset(values.get("task", "shapematch"), values.get("preset", "quick"))
    merged: Config = merge(base, values)
    return merged
