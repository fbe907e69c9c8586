"""Planning by gradient ascent through the simulator."""

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from baselines.planning.base import BestPlans, Planner, PlannerConfig, where_simulation
from cfp.errors import check_positive
from dittogym.core import EnvState


@dataclass(frozen=True, kw_only=True)
class GradientPlannerConfig(PlannerConfig):
    """Options of planning by gradients."""

    iterations: int = 6
    """Gradient steps on a plan."""
    learning_rate: float = 0.6
    """Adam's step size on actions, which lie in [-1, 1]."""
    clip: float = 3.0
    """Largest norm of the gradient of a control step, as a multiple of the median over the steps of the plan."""

    def check_planner(self, resolution: int) -> None:
        """Check what the types do not express."""
        super().check_planner(resolution)
        check_positive(iterations=self.iterations, learning_rate=self.learning_rate, clip=self.clip)


class GradientPlanner(Planner[GradientPlannerConfig]):
    """Plans by gradients: improves the next actions by Adam on the smooth return.

    Arguments, attributes and methods are those of `baselines.planning.base.Planner`.

    Examples:
        >>> import dittogym
        >>> from baselines import GradientPlanner, GradientPlannerConfig
        >>> env = dittogym.TorchEnv("run", particles=300, substeps=10)
        >>> observation, info = env.reset(seed=0)
        >>> planner = GradientPlanner(env, GradientPlannerConfig(horizon=4, commit=2, iterations=2), seed=0)
        >>> planner.act().shape
        torch.Size([1, 2, 8, 8])
    """

    config_type = GradientPlannerConfig

    def _search(self, state: EnvState, plan: Tensor) -> Tensor:
        config, plan = self.config, plan.requires_grad_()
        adam = torch.optim.Adam([plan], config.learning_rate, (0.9, 0.95))
        best, num_useful = BestPlans(plan), 0
        for _ in range(config.iterations):
            with torch.enable_grad():  # also where the caller has switched gradients off
                smooth, value = self._evaluate(state, plan)
                (gradient,) = torch.autograd.grad(-smooth.sum(), plan)
            best.update(plan, value)
            finite_gradient = gradient.isfinite().flatten(2).all(2).all(0)
            self.num_failed += int((value.isfinite() & ~finite_gradient).sum())
            failed = ~(value.isfinite() & finite_gradient)
            num_useful += int((~failed).sum())
            plan.grad = where_simulation(failed, 0.0, clip_steps(gradient, config.clip))
            adam.step()
            with torch.no_grad():
                plan.copy_(where_simulation(failed, best.plan, plan.clamp(-1.0, 1.0)))
        with torch.no_grad():
            _, value = self._evaluate(state, plan)
        best.update(plan, value)
        if not num_useful:
            warnings.warn("no gradient of a plan was finite: plans are not improved", stacklevel=2)
        return best.plan


def clip_steps(gradient: Tensor, limit: float) -> Tensor:
    """Limit the norm of every control step of a gradient (T, B, 2, R, R) to ``limit`` medians over the steps."""
    norm = gradient.flatten(2).norm(dim=2)
    middle = (norm > 0).sum(0) // 2  # steps after the end of an episode have no gradient and do not count
    largest = limit * norm.sort(0, descending=True).values.gather(0, middle[None])
    scale = torch.where(norm > largest, largest / norm, 1.0)
    return gradient * scale[:, :, None, None, None]
