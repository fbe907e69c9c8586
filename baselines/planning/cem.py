"""Planning without gradients, by the cross-entropy method."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from baselines.planning.base import BestPlans, Planner, PlannerConfig
from cfp.errors import ConfigError, check_below_one, check_positive
from dittogym import core
from dittogym.action import bicubic
from dittogym.core import EnvState
from torchmpm import tree


@dataclass(frozen=True, kw_only=True)
class CEMPlannerConfig(PlannerConfig):
    """Options of planning by the cross-entropy method."""

    iterations: int = 3
    """Generations of candidates."""
    candidates: int = 32
    """Plans in a generation, simulated side by side."""
    elites: int = 6
    """Number of best candidates, to which the distribution of the next generation is fitted."""
    initial_std: float = 0.5
    """Standard deviation of the actions in the first generation."""
    noise_correlation: float = 0.8
    """Correlation of a candidate's noise between one control step and the next."""
    noise_grid: int = 4
    """Rows and columns on which noise is drawn before it is enlarged to the action grid: fewer numbers to search."""
    momentum: float = 0.1
    """Fraction of mean and standard deviation that each generation keeps of the last one."""

    def check_planner(self, resolution: int) -> None:
        """Check what the types do not express."""
        super().check_planner(resolution)
        check_positive(iterations=self.iterations, initial_std=self.initial_std, noise_grid=self.noise_grid)
        if not 2 <= self.elites <= self.candidates:
            raise ConfigError(f"elites must be between 2 and candidates, {self.candidates}, got {self.elites}")
        check_below_one(noise_correlation=self.noise_correlation, momentum=self.momentum)
        if self.noise_grid > resolution:
            raise ConfigError(f"noise_grid must be at most {resolution}, the action grid, got {self.noise_grid}")


class CEMPlanner(Planner[CEMPlannerConfig]):
    """Plans by the cross-entropy method (Rubinstein, 1999) with correlated noise (Pinneri et al., CoRL 2020).

    A generation of plans is drawn around a mean, all are simulated in one batch, and mean and standard deviation move
    to those of the best. Only true rewards are used. The first candidate of a generation is its mean, so what is kept
    of the last plan is tried too; the second is zero action, as effort costs.

    Arguments, attributes and methods are those of `baselines.planning.base.Planner`.

    Examples:
        >>> import dittogym
        >>> from baselines import CEMPlanner, CEMPlannerConfig
        >>> env = dittogym.TorchEnv("run", particles=300, substeps=10)
        >>> observation, info = env.reset(seed=0)
        >>> planner = CEMPlanner(env, CEMPlannerConfig(horizon=4, commit=2, candidates=4, elites=2), seed=0)
        >>> planner.act().shape
        torch.Size([1, 2, 8, 8])
    """

    config_type = CEMPlannerConfig
    default_step = staticmethod(core.step)

    @torch.no_grad()
    def _search(self, state: EnvState, plan: Tensor) -> Tensor:
        config, batch = self.config, plan.shape[1]
        states = tree.map(lambda tensor: tensor.repeat_interleave(config.candidates, 0), state)
        mean, std = plan, torch.full_like(plan, config.initial_std)
        best = BestPlans(plan)
        for _ in range(config.iterations):
            noise = self._noise(plan)
            candidates = (mean[:, :, None] + std[:, :, None] * noise).clamp(-1.0, 1.0)  # (T, B, P, 2, R, R)
            candidates[:, :, 1] = 0.0
            value = self._evaluate(states, candidates.flatten(1, 2))[1].view(batch, config.candidates)
            value, index = torch.where(value.isfinite(), value, -torch.inf).topk(config.elites)
            index = index[None, :, :, None, None, None].expand(len(plan), -1, -1, *plan.shape[2:])
            elites = candidates.gather(2, index)
            best.update(elites[:, :, 0], value[:, 0])
            mean, std = self._refit(mean, std, elites, value.isfinite())
        return best.plan

    def _noise(self, plan: Tensor) -> Tensor:
        """Standard normal noise (T, B, P, 2, R, R), correlated in time; none for the first candidate."""
        (steps, batch, _, _, size), config = plan.shape, self.config
        shape = (steps, batch, config.candidates, 2, config.noise_grid, config.noise_grid)
        noise = torch.randn(shape, generator=self.generator, dtype=plan.dtype)
        noise[:, :, 0] = 0.0
        for previous, current in pairwise(noise):
            current.mul_(math.sqrt(1.0 - config.noise_correlation**2)).add_(previous, alpha=config.noise_correlation)
        return bicubic(noise.to(plan.device), size)

    def _refit(self, mean: Tensor, std: Tensor, elites: Tensor, finite: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std (T, B, 2, R, R), moved towards those of the elites (T, B, E, 2, R, R) that are finite (B, E)."""
        weight = (finite / finite.sum(1, keepdim=True).clamp_min(1))[..., None, None, None].to(mean)
        elite_mean = (weight * elites).sum(2)
        elite_std = (weight * (elites - elite_mean[:, :, None]).square()).sum(2).sqrt()
        rate = torch.where(finite.any(1), 1.0 - self.config.momentum, 0.0)[:, None, None, None].to(mean)
        return mean.lerp(elite_mean, rate), std.lerp(elite_std, rate)
