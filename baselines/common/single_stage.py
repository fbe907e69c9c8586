"""Ablations of the coarse-to-fine policy: a single stage, trained alone for the whole budget."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

from cfp.config import Config
from cfp.errors import ConfigError
from cfp.experiment.coarse_to_fine import CoarseToFine
from cfp.presets import sac_preset
from dittogym.tasks import task_name


@dataclass(frozen=True)
class SingleStageConfig(Config):
    """Options of a single stage. ``--resolutions 4``, 8 or 16 is the study of resolutions."""

    @property
    def name(self) -> str:
        """Of the run, for a folder; names the action grid."""
        grid = "-".join(map(str, self.resolutions))
        return f"{self.algo}{grid}-{task_name(self.task)}-{self.preset}-{self.seed}"

    def check(self) -> None:
        """Check what the types do not express."""
        if len(self.resolutions) != 1:
            raise ConfigError(f"resolutions must have one value, got {self.resolutions}; cfp trains several stages")
        super().check()


def single_stage_preset(algo: Literal["coarse", "fine"], task: str, name: str) -> SingleStageConfig:
    """The first stage of `cfp.preset`, for all its steps, on the task's coarse or fine action grid."""
    base = sac_preset(task, name)
    single = replace(
        base,
        algo=algo,
        handover=(),
        resolutions=base.resolutions[:1] if algo == "coarse" else base.resolutions[-1:],
        random_steps=base.random_steps[:1],
        alpha=base.alpha[:1],
        gate_bias=(),
        gate_penalty=(),
    )
    return SingleStageConfig(**{option.name: getattr(single, option.name) for option in fields(single)})


class Coarse(CoarseToFine):
    """The first stage of CFP, for all its steps."""

    @staticmethod
    def preset(task: str, name: str) -> SingleStageConfig:
        """Default options for a task, see `single_stage_preset`."""
        return single_stage_preset("coarse", task, name)


class Fine(CoarseToFine):
    """CFP's finest grid from scratch, without a coarse policy."""

    @staticmethod
    def preset(task: str, name: str) -> SingleStageConfig:
        """Default options for a task, see `single_stage_preset`."""
        return single_stage_preset("fine", task, name)
