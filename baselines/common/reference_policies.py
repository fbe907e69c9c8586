"""Reference policies: zero actions, random actions and a travelling wave. Nothing is learned."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from baselines.common.grid import GridConfig
from baselines.common.open_loop import OpenLoop
from cfp.evaluation.returns import UntrainedPolicy
from cfp.policy import Policy
from cfp.presets import sac_preset
from dittogym import make_spec
from dittogym.action import ActionLayout, from_grid_layout


@dataclass(frozen=True, kw_only=True)
class ReferenceConfig(GridConfig):
    """Options of the evaluation of a reference policy."""

    def ends(self) -> tuple[int, ...]:
        """One stage, without learning."""
        return (1,)


def reference_preset(algo: str, task: str, name: str) -> ReferenceConfig:
    """Default options: ``quick`` evaluates with few particles, ``paper`` in the paper's environment."""
    base = sac_preset(task, name)
    own = {"algo": algo, "task": task, "preset": base.preset, "eval_every": 1, "checkpoint_every": 1, "log_every": 1}
    return ReferenceConfig(**(vars(base.environment) | own | {"num_envs": 1}))


def _scripted(config: ReferenceConfig) -> OpenLoop:
    return OpenLoop(wave(make_spec(config.task).horizon, config.resolution(1), config.action_layout))


REFERENCE_POLICIES: dict[str, Callable[[ReferenceConfig], Policy]] = {
    "zero": lambda config: UntrainedPolicy("zero", config.resolution(1)),
    "random": lambda config: UntrainedPolicy("random", config.resolution(1)),
    "scripted": _scripted,
}


def wave(steps: int, size: int, indexing: ActionLayout) -> Tensor:
    """The actions with which the reference figures of the tasks were recorded, (T, 2, R, R).

    In step t = 1, 2, ... the muscle of direction c in column x and row y of the action grid, counted to the right and
    upwards, is driven with ``sin(0.3 t + 0.7 x + 1.1 y + 2 c)``, the same in the world for every indexing.
    """
    t, c, x, y = np.ogrid[1 : steps + 1, 0:2, 0:size, 0:size]
    drive = np.sin(0.3 * t + 0.7 * x + 1.1 * y + 2.0 * c)
    return from_grid_layout(torch.from_numpy(drive.astype(np.float32)), indexing)
