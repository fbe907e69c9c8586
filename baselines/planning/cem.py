"""Receding-horizon planning without gradients: the cross-entropy method."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from baselines.common.rollout import StepFunction
from baselines.planning.gradient import PlanConfig, PlannerBase
from baselines.planning.mpc import MPC, PlannedConfig, planned
from cfp.config import positive
from cfp.errors import ConfigError
from dittogym import TorchEnv, core
from dittogym.action import bicubic
from dittogym.model import EnvState
from torchmpm import tree


@dataclass(frozen=True)
class CEMPlannerConfig(PlanConfig):
    """How a plan is made by the cross-entropy method."""

    iterations: int = 3
    """Generations of candidates."""
    candidates: int = 32
    """Plans in a generation, simulated side by side."""
    elites: int = 6
    """Best candidates, to whose mean and spread the next generation is drawn."""
    deviation: float = 0.5
    """Standard deviation of the actions in the first generation."""
    persistence: float = 0.8
    """Correlation of a candidate's deviation from the mean between one control step and the next."""
    cells: int = 4
    """Rows and columns on which candidates are drawn, enlarged to the action grid: fewer numbers to search."""
    inertia: float = 0.1
    """Share of mean and deviation that each generation keeps."""

    def check(self) -> None:
        """Check what the types cannot, see `PlanConfig.check`."""
        super().check()
        positive(iterations=self.iterations, deviation=self.deviation, cells=self.cells)
        if not 2 <= self.elites <= self.candidates:
            raise ConfigError(f"elites: got {self.elites}, allowed 2 to the candidates, {self.candidates}")
        for name in ("persistence", "inertia"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name}: got {getattr(self, name)}, allowed 0 or more, less than 1")


class CEMPlanner(PlannerBase[CEMPlannerConfig]):
    """Plans by the cross-entropy method (Rubinstein, 1999), with noise that lasts (Pinneri et al., CoRL 2020).

    A generation of plans is drawn around a mean, all are simulated in one batch, and mean and deviation move to those
    of the best. Only true rewards are asked for, no gradient. The first candidate of a generation is its mean, so what
    is kept of the last plan is among those that are tried; the second is rest, as effort costs.

    Args are those of `PlannerBase`.
    """

    options = CEMPlannerConfig

    def __init__(
        self,
        env: TorchEnv,
        config: CEMPlannerConfig | None = None,
        *,
        judge: StepFunction = core.step,
        seed: int = 0,
    ) -> None:
        super().__init__(env, config, judge=judge, seed=seed)

    @torch.no_grad()
    def _search(self, start: EnvState, plan: Tensor) -> Tensor:
        config, batch = self.config, plan.shape[1]
        many = tree.map(lambda tensor: tensor.repeat_interleave(config.candidates, 0), start)
        mean, deviation = plan, torch.full_like(plan, config.deviation)
        best, chosen = plan.new_full((batch,), -torch.inf), torch.zeros_like(plan)
        for _ in range(config.iterations):
            noise = self._noise(plan)
            tried = (mean[:, :, None] + deviation[:, :, None] * noise).clamp(-1.0, 1.0)  # (T, B, P, 2, R, R)
            tried[:, :, 1] = 0.0
            value = self._judge(many, tried.flatten(1, 2))[1].view(batch, config.candidates)
            self.plans += value.numel()
            self.failed += int((~value.isfinite()).sum())
            top, index = torch.where(value.isfinite(), value, -torch.inf).topk(config.elites)
            elites = tried.gather(2, index[None, :, :, None, None, None].expand(len(plan), -1, -1, *plan.shape[2:]))
            better = top[:, 0] > best
            best = torch.where(better, top[:, 0], best)
            chosen = torch.where(better[:, None, None, None], elites[:, :, 0], chosen)
            mean, deviation = self._moved(mean, deviation, elites, top.isfinite())
        return chosen

    def _noise(self, plan: Tensor) -> Tensor:
        """Deviations (T, B, P, 2, R, R) from the mean, in its standard deviations; none for the first candidate."""
        (steps, batch, _, _, size), config = plan.shape, self.config
        cells = min(config.cells, size)
        shape = (steps, batch, config.candidates, 2, cells, cells)
        fresh = torch.randn(shape, generator=self.generator, dtype=plan.dtype)
        fresh[:, :, 0] = 0.0
        for before, now in pairwise(fresh):
            now.mul_(math.sqrt(1.0 - config.persistence**2)).add_(before, alpha=config.persistence)
        return bicubic(fresh.to(plan.device), size)

    def _moved(self, mean: Tensor, deviation: Tensor, elites: Tensor, finite: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation (T, B, 2, R, R) of elites (T, B, E, 2, R, R), counting those (B, E) that are finite."""
        weight = (finite / finite.sum(1, keepdim=True).clamp_min(1))[..., None, None, None].to(mean)
        middle = (weight * elites).sum(2)
        width = (weight * (elites - middle[:, :, None]).square()).sum(2).sqrt()
        share = torch.where(finite.any(1), 1.0 - self.config.inertia, 0.0)[:, None, None, None].to(mean)
        return mean.lerp(middle, share), deviation.lerp(width, share)


@dataclass(frozen=True)
class CEMConfig(PlannedConfig):
    """An episode planned by the cross-entropy method: one robot on the layout of the seed, start to end of the task."""

    algo: str = "cem"
    """Which algorithm."""
    planner: CEMPlannerConfig = field(default_factory=CEMPlannerConfig)


class CEM(MPC):
    """Model predictive control by the cross-entropy method, see `CEMPlanner`; in all else as `MPC`."""

    name: ClassVar[str] = "cem"
    planner_type: ClassVar[type[PlannerBase[Any]]] = CEMPlanner

    @staticmethod
    def preset(task: str, name: str) -> CEMConfig:
        """Defaults of a task, as those of `MPC.preset`.

        Raises:
            ConfigError: No such task or preset.
        """
        return CEMConfig(**planned(task, name))
