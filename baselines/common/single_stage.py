"""Ablations of the coarse-to-fine policy: a single stage, trained alone for the whole budget."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from cfp.config import SACConfig
from cfp.errors import ConfigError
from cfp.presets import sac_preset
from cfp.sac.learner import CFPSAC


class Coarse(CFPSAC):
    """The first stage of the coarse-to-fine policy, for all its steps."""

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """The first stage of `cfp.preset`, for all its steps, on the first action grid of the same preset."""
        return _single_stage(sac_preset(task, name), "coarse", 0)

    @classmethod
    def begin(cls, config: Any, folder: Path) -> tuple[int, int]:
        """Refuse several stages."""
        if len(config.resolutions) != 1:
            raise ConfigError(f"resolutions must have one value for {config.algo}, got {config.resolutions}")
        return super().begin(config, folder)


class Fine(Coarse):
    """The finest action grid from scratch, without a coarse policy."""

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """As `Coarse`, on the last action grid of the preset."""
        return _single_stage(sac_preset(task, name), "fine", -1)


def _single_stage(base: SACConfig, algo: str, grid: int) -> SACConfig:
    """The first stage of ``base`` for all its steps, on one of its grids, with as many steps of the critics first."""
    first = base.hyperparameters(1)
    return replace(
        base,
        algo=algo,
        resolutions=(base.resolutions[grid],),
        handover=(),
        random_steps=(first.random_steps,),
        alpha=(first.alpha,),
        critics_first=(first.actor_start / base.steps,),
    )
