"""Ablations of the coarse-to-fine policy: a single stage, trained alone for the whole budget."""

from dataclasses import dataclass, replace
from typing import ClassVar

from cfp.config import SACConfig
from cfp.errors import ConfigError
from cfp.experiment.sac_learner import SACLearner
from cfp.presets import sac_preset
from dittogym.tasks import task_name


@dataclass(frozen=True)
class SingleStageConfig(SACConfig):
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


class Coarse(SACLearner):
    """The first stage of CFP, for all its steps."""

    algo: ClassVar[str] = "coarse"
    grid: ClassVar[int] = 0

    @classmethod
    def preset(cls, task: str, name: str) -> SingleStageConfig:
        """The first stage of `cfp.preset`, for all its steps, on the first or last action grid of the same preset."""
        base = sac_preset(task, name)
        single = replace(
            base,
            algo=cls.algo,
            handover=(),
            resolutions=(base.resolutions[cls.grid],),
            random_steps=base.random_steps[:1],
            alpha=base.alpha[:1],
            gate_bias=(),
            gate_penalty=(),
        )
        return SingleStageConfig(**vars(single))


class Fine(Coarse):
    """CFP's finest grid from scratch, without a coarse policy."""

    algo, grid = "fine", -1
