"""Ablations of the coarse-to-fine policy: a single stage, trained alone for the whole budget."""

from dataclasses import replace

from cfp.config import SACConfig
from cfp.presets import sac_preset
from cfp.sac.learner import CFPSAC


class Coarse(CFPSAC):
    """The first stage of the coarse-to-fine policy, for all its steps."""

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """The first stage of `cfp.preset`, for all its steps, on the first action grid of the same preset."""
        base = sac_preset(task, name)
        return replace(base, algo="coarse", resolutions=base.resolutions[:1])


class Fine(CFPSAC):
    """The finest action grid from scratch, without a coarse policy."""

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """As `Coarse`, on the last action grid of the preset."""
        base = sac_preset(task, name)
        return replace(base, algo="fine", resolutions=base.resolutions[-1:])
