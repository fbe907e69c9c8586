"""Measurements on the gradient of a return in the actions, by horizon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from baselines.common.rollout import StepFunction, repeat, rollout, to_dtype
from cfp.errors import CFPError
from dittogym.model import EnvState, Model


class NoGradientError(CFPError):
    """The reward does not depend on the actions in a differentiable way."""


@dataclass(frozen=True)
class Probe:
    """Returns and gradients of many plans from one state.

    A plan is a sequence of actions (T, 2, R, R); its return at horizon h is the sum of its first h smooth rewards.

    Attributes:
        model: The task.
        start: A state of one simulation; its dtype is that of the computation.
        judge: What a step is worth.
        chunk: Simulations at once; this and the horizon bound the memory.
        advance: Called with the number of control steps simulated; a gradient counts as three.
    """

    model: Model
    start: EnvState
    judge: StepFunction
    chunk: int
    advance: Callable[[int], object]

    def to(self, dtype: torch.dtype) -> Probe:
        """The same in another precision."""
        return replace(self, start=to_dtype(self.start, dtype))

    @torch.no_grad()
    def returns(self, plans: Tensor) -> Tensor:
        """Returns of plans (S, T, 2, R, R) at every horizon, (S, T)."""
        parts = []
        for part in self._parts(plans):
            rewards = rollout(self.model, repeat(self.start, part.shape[1]), part, self.judge).rewards
            parts.append(rewards.T.cumsum(1))
            self.advance(part.shape[0] * part.shape[1])
        return torch.cat(parts)

    def gradients(self, plans: Tensor) -> Tensor:
        """Gradients of the return at horizon T in the plans (S, T, 2, R, R), same shape.

        Raises:
            NoGradientError: The reward has none.
        """
        parts = []
        for part in self._parts(plans):
            part = part.requires_grad_()
            rewards = rollout(self.model, repeat(self.start, part.shape[1]), part, self.judge).rewards
            if not rewards.requires_grad:
                raise NoGradientError(
                    f"the reward of task {self.model.spec.name!r} has no gradient in the actions: it only counts"
                )
            parts.append(torch.autograd.grad(rewards.sum(), part)[0].transpose(0, 1))
            self.advance(3 * part.shape[0] * part.shape[1])
        return torch.cat(parts)

    def _parts(self, plans: Tensor) -> list[Tensor]:
        like = self.start.particles.x
        return [part.to(like).detach().transpose(0, 1).contiguous() for part in plans.split(self.chunk)]


@dataclass(frozen=True)
class Row:
    """What was found at one horizon.

    Attributes:
        horizon: Control steps.
        value: Return of the plan.
        norm: Norm of its gradient in all actions.
        first_norm: Norm of its gradient in the first action.
        difference_error: Smallest error of finite differences over all widths, see `finite_differences`.
        difference_width: The width where it was reached.
        cosine: Of the angle between the float32 and the float64 gradient.
        relative_error: Norm of their difference over the norm of the float64 gradient.
        first_variance: Of the mean of first-order samples; total over all actions.
        zeroth_variance: Of the mean of zeroth-order samples from as many simulations.
        promised: What a step along the first-order mean gains if the return were linear.
        first_gain: What it gains.
        zeroth_gain: What a step of the same length along the zeroth-order mean gains.
        failed: Samples whose return or gradient was not finite; they are left out.
    """

    horizon: int
    value: float
    norm: float
    first_norm: float
    difference_error: float
    difference_width: float
    cosine: float
    relative_error: float
    first_variance: float
    zeroth_variance: float
    promised: float
    first_gain: float
    zeroth_gain: float
    failed: int


def finite_differences(
    probe: Probe, plan: Tensor, gradients: Sequence[Tensor], widths: Sequence[float], directions: Tensor
) -> Tensor:
    """Error of central differences against gradients.

    Args:
        probe: In float64.
        plan: (T, 2, R, R).
        gradients: Of the return at some horizons, (h, 2, R, R) each.
        widths: Step widths, root mean square per action value.
        directions: (D, T, 2, R, R), standard normal.

    Returns:
        (horizons, widths): root mean square over the directions of the difference between the two slopes, over the
        gradient's norm, which is the expected size of a slope.
    """
    count = len(directions)
    result = torch.empty(len(gradients), len(widths), dtype=plan.dtype)
    for column, width in enumerate(widths):
        sides = probe.returns(torch.cat((plan + width * directions, plan - width * directions)))
        slopes = (sides[:count] - sides[count:]) / (2 * width)
        for row, gradient in enumerate(gradients):
            horizon = len(gradient)
            expected = (directions[:, :horizon] * gradient).flatten(1).sum(1)
            result[row, column] = (slopes[:, horizon - 1] - expected).square().mean().sqrt() / gradient.norm()
    return result


def _mean_and_variance(samples: Tensor) -> tuple[Tensor, float, int]:
    """Mean of the finite samples (S, ...), the total variance of that mean, and how many were not finite."""
    finite = samples.isfinite().flatten(1).all(1)
    kept = samples[finite]
    if len(kept) < 2:
        return torch.full_like(samples[0], torch.nan), torch.nan, int((~finite).sum())
    return kept.mean(0), float(kept.var(0).sum() / len(kept)), int((~finite).sum())


def _zeroth_order(returns: Tensor, noise: Tensor, sigma: float) -> Tensor:
    """Samples of the smoothed gradient from antithetic pairs of returns, (2 P,) and noise (P, ...): (P, ...)."""
    ahead, behind = returns.chunk(2)
    return ((ahead - behind) / (2 * sigma)).view(-1, *[1] * (noise.ndim - 1)) * noise


def _gains(probe: Probe, plan: Tensor, means: Sequence[Tensor], length: float) -> list[float]:
    """What a step of ``length`` along each mean adds to the return of ``plan``."""
    steps = [length * mean / mean.norm() for mean in means]
    returns = probe.returns(torch.stack([plan, *(plan + step for step in steps)]))[:, -1]
    return [float(gained) for gained in returns[1:] - returns[0]]


@dataclass(frozen=True)
class Smoothing:
    """Noise on a plan, from which both estimators of a smoothed gradient draw.

    Attributes:
        noise: (S, T, 2, R, R) standard normal, S even. The first half serves the zeroth order in antithetic pairs, so
            both estimators spend S simulations.
        sigma: Its width.
    """

    noise: Tensor
    sigma: float

    @property
    def paired(self) -> Tensor:
        """The half that the zeroth order uses."""
        return self.noise[: len(self.noise) // 2]


def measure(
    probe: Probe,
    plan: Tensor,
    horizons: Sequence[int],
    widths: Sequence[float],
    directions: Tensor,
    smoothing: Smoothing,
) -> tuple[list[Row], Tensor]:
    """Measure everything at several horizons.

    Args:
        probe: In float64; first and zeroth order are compared in float32.
        plan: (T, 2, R, R) float64, around which everything is measured.
        horizons: Growing, the last is T.
        widths: Of finite differences.
        directions: (D, T, 2, R, R) of finite differences.
        smoothing: For the comparison of the orders.

    Returns:
        One row per horizon, and the errors of finite differences (horizons, widths).
    """
    values = probe.returns(plan[None])[0]
    gradients = [probe.gradients(plan[None, :horizon])[0] for horizon in horizons]
    errors = finite_differences(probe, plan, gradients, widths, directions)
    single = probe.to(torch.float32)
    paired, sigma = smoothing.paired, smoothing.sigma
    pairs = single.returns(torch.cat((plan + sigma * paired, plan - sigma * paired)))
    rows = []
    for gradient, error in zip(gradients, errors, strict=True):
        horizon = len(gradient)
        best = int(torch.where(error.isfinite(), error, torch.inf).argmin())
        rounded = single.gradients(plan[None, :horizon])[0].to(gradient)
        rows.append(
            Row(
                horizon=horizon,
                value=float(values[horizon - 1]),
                norm=float(gradient.norm()),
                first_norm=float(gradient[0].norm()),
                difference_error=float(error[best]),
                difference_width=widths[best],
                cosine=float((gradient * rounded).sum() / (gradient.norm() * rounded.norm())),
                relative_error=float((rounded - gradient).norm() / gradient.norm()),
                **_compare_orders(single, plan[:horizon], pairs[:, horizon - 1], smoothing),
            )
        )
    return rows, errors


def _compare_orders(probe: Probe, plan: Tensor, pairs: Tensor, smoothing: Smoothing) -> dict[str, Any]:
    """The entries of a `Row` on both orders at horizon T, from a plan (T, 2, R, R) and returns (S,) of the pairs."""
    horizon, sigma = len(plan), smoothing.sigma
    samples = probe.gradients(plan + sigma * smoothing.noise[:, :horizon])
    first, first_variance, failed = _mean_and_variance(samples)
    samples = _zeroth_order(pairs, smoothing.paired[:, :horizon].to(pairs), sigma)
    zeroth, zeroth_variance, also_failed = _mean_and_variance(samples)
    length = sigma * plan.numel() ** 0.5
    first_gain, zeroth_gain = _gains(probe, plan, (first, zeroth), length)
    return {
        "first_variance": first_variance,
        "zeroth_variance": zeroth_variance,
        "promised": float(length * first.norm()),
        "first_gain": first_gain,
        "zeroth_gain": zeroth_gain,
        "failed": failed + also_failed,
    }
