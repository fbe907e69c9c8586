"""Ablations of the coarse-to-fine policy: a single stage, trained alone for the whole budget."""

from dataclasses import dataclass

from cfp.config import SACConfig
from cfp.errors import ConfigError
from cfp.presets import sac_preset
from cfp.sac.learner import CFPSAC


@dataclass(frozen=True, kw_only=True)
class SingleStageConfig(SACConfig):
    """A run of ``coarse`` or ``fine``."""

    def check(self) -> None:
        """Check what the types do not express."""
        if len(self.resolutions) != 1:
            raise ConfigError(f"resolutions must have one value for {self.algo}, got {self.resolutions}")
        super().check()


class Coarse(CFPSAC):
    """The first stage of the coarse-to-fine policy, for all its steps."""

    @staticmethod
    def preset(task: str, name: str) -> SingleStageConfig:
        """The first stage of `cfp.preset`, for all its steps, on the first action grid of the same preset."""
        return _single_stage(sac_preset(task, name), "coarse", 0)


class Fine(CFPSAC):
    """The finest action grid from scratch, without a coarse policy."""

    @staticmethod
    def preset(task: str, name: str) -> SingleStageConfig:
        """As `Coarse`, on the last action grid of the preset."""
        return _single_stage(sac_preset(task, name), "fine", -1)


def _single_stage(base: SACConfig, algo: str, grid: int) -> SingleStageConfig:
    """The first stage of ``base`` for all its steps, on one of its grids, with as many steps of the critics first."""
    first = base.hyperparameters(1)
    own = {
        "algo": algo,
        "resolutions": (base.resolutions[grid],),
        "handover": (),
        "random_steps": (first.random_steps,),
        "alpha": (first.alpha,),
        "critics_first": (first.actor_start / base.steps,),
    }
    return SingleStageConfig(**(vars(base) | own))
