"""Reference policies: zero actions, random actions and a travelling wave. Nothing is learned."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from baselines.common.open_loop import OpenLoop
from cfp.config import RunConfig
from cfp.evaluation.returns import UntrainedPolicy
from cfp.policy import Policy
from dittogym import make_spec
from dittogym.action import ActionLayout, from_grid_layout


def _scripted(config: RunConfig) -> OpenLoop:
    spec = make_spec(config.task)
    return OpenLoop(wave(spec.horizon, spec.coarse, config.action_layout))


#: From the options of a run, in whose environment they act; they act on the task's coarse grid.
REFERENCE_POLICIES: dict[str, Callable[[RunConfig], Policy]] = {
    "zero": lambda config: UntrainedPolicy("zero", make_spec(config.task).coarse),
    "random": lambda config: UntrainedPolicy("random", make_spec(config.task).coarse),
    "scripted": _scripted,
}


def wave(steps: int, size: int, action_layout: ActionLayout) -> Tensor:
    """Return the actions of a travelling wave, the reference policy ``scripted``.

    In step t = 1, 2, ... the muscle of direction c = 0, 1 in column x and row y of the action grid, counted to the
    right and upwards from 0, is driven with ``sin(0.3 t + 0.7 x + 1.1 y + 2 c)``; in the world this is the same in both
    layouts.

    Args:
        steps: T, the number of control steps.
        size: R, rows and columns of the action grid.
        action_layout: Layout of the actions, ``"image"`` or ``"grid"``, see :class:`dittogym.TorchEnv`.

    Returns:
        (T, 2, R, R) float32 in [-1, 1], such as `baselines.OpenLoop` takes.
    """
    t, c, x, y = np.ogrid[1 : steps + 1, 0:2, 0:size, 0:size]
    drive = np.sin(0.3 * t + 0.7 * x + 1.1 * y + 2.0 * c)
    return from_grid_layout(torch.from_numpy(drive.astype(np.float32)), action_layout)
