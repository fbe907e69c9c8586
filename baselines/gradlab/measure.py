"""Measurements of the gradient of a return with respect to the actions, at several horizons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity
from tqdm import tqdm

from baselines.common.rollout import rollout
from dittogym.core import EnvState, Model
from torchmpm import tree

#: Step sizes of the finite differences, root mean square per action value.
STEP_SIZES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
#: Standard deviation of the action noise under which first- and zeroth-order estimates are compared.
NOISE_STD = 0.1
#: Largest number of simulations at a time; it bounds the memory.
BATCH_SIZE = 16

#: Measurements at one horizon, by the names of ``COLUMNS``.
Result = dict[str, Any]
COLUMNS = {
    "horizon": "control steps",
    "norm": "norm of the gradient in all actions",
    "first_norm": "norm of the gradient in the first action",
    "difference_error": "smallest relative error of finite differences over all step sizes",
    "difference_step": "the step size at which it was reached",
    "cosine": "cosine similarity of the float32 and the float64 gradient",
    "relative_error": "norm of their difference over the norm of the float64 gradient",
    "first_variance": "total variance of the mean of the first-order samples",
    "zeroth_variance": "total variance of the mean of the zeroth-order samples, from as many simulations",
    "promised": "gain of a step along the first-order mean if the return were linear",
    "first_gain": "actual gain of that step",
    "zeroth_gain": "actual gain of a step of the same length along the zeroth-order mean",
    "failed": "samples that were not finite, which are left out of the means",
}


@dataclass(frozen=True)
class ReturnFunction:
    """Return of action sequences (T, 2, R, R) from one initial state: at horizon h, the sum of h smooth rewards."""

    model: Model
    state: EnvState

    def to(self, dtype: torch.dtype) -> ReturnFunction:
        """Return the same function computed in another precision."""
        state = tree.map(lambda t: t.to(dtype) if t.is_floating_point() else t, self.state)
        return replace(self, state=state)

    @torch.no_grad()
    def returns(self, actions: Tensor) -> Tensor:
        """Returns (S, T) of action sequences (S, T, 2, R, R) at every horizon."""
        return torch.cat([self._rewards(batch).T.cumsum(1) for batch in self._batches(actions)])

    def gradients(self, actions: Tensor) -> Tensor:
        """Gradients (S, T, 2, R, R) of the returns at horizon T."""
        gradients = []
        for batch in self._batches(actions):
            rewards = self._rewards(batch.requires_grad_())
            gradients.append(torch.autograd.grad(rewards.sum(), batch)[0].transpose(0, 1))
        return torch.cat(gradients)

    def _rewards(self, batch: Tensor) -> Tensor:
        copies = tree.map(lambda t: t[:1].expand(batch.shape[1], *t.shape[1:]), self.state)
        return rollout(self.model, copies, batch).rewards

    def _batches(self, actions: Tensor) -> list[Tensor]:
        like = self.state.particles.x
        return [part.to(like).detach().transpose(0, 1).contiguous() for part in actions.split(BATCH_SIZE)]


def finite_difference_errors(
    function: ReturnFunction, actions: Tensor, gradients: Sequence[Tensor], directions: Tensor
) -> Tensor:
    """Relative errors (horizons, step sizes), in the mean square, of central differences along directions."""
    count = len(directions)
    errors = torch.empty(len(gradients), len(STEP_SIZES), dtype=actions.dtype)
    for column, step in enumerate(STEP_SIZES):
        returns = function.returns(torch.cat((actions + step * directions, actions - step * directions)))
        slopes = (returns[:count] - returns[count:]) / (2 * step)
        for row, gradient in enumerate(gradients):
            horizon = len(gradient)
            expected = (directions[:, :horizon] * gradient).flatten(1).sum(1)
            errors[row, column] = (slopes[:, horizon - 1] - expected).square().mean().sqrt() / gradient.norm()
    return errors


def measure(
    function: ReturnFunction, actions: Tensor, horizons: Sequence[int], directions: Tensor, noise: Tensor
) -> tuple[list[Result], Tensor]:
    """Take all measurements around actions (T, 2, R, R), float64, at increasing horizons, the last of which is T.

    The first half of the noise (S, T, 2, R, R) serves the zeroth-order estimate in antithetic pairs, so both estimates
    cost S simulations. Returns a result for each horizon, and the errors of finite differences (horizons, step sizes).
    """
    progress = tqdm(horizons, "gradients", disable=None)
    gradients = [function.gradients(actions[None, :horizon])[0] for horizon in progress]
    errors = finite_difference_errors(function, actions, gradients, directions)
    single = function.to(torch.float32)
    offsets = NOISE_STD * noise[: len(noise) // 2]
    paired_returns = single.returns(torch.cat((actions + offsets, actions - offsets)))
    results = []
    for gradient, error in zip(tqdm(gradients, "estimates", disable=None), errors, strict=True):
        horizon = len(gradient)
        best = int(torch.where(error.isfinite(), error, torch.inf).argmin())
        rounded = single.gradients(actions[None, :horizon])[0].to(gradient)
        result: Result = {
            "horizon": horizon,
            "norm": float(gradient.norm()),
            "first_norm": float(gradient[0].norm()),
            "difference_error": float(error[best]),
            "difference_step": STEP_SIZES[best],
            "cosine": float(cosine_similarity(gradient.flatten(), rounded.flatten(), dim=0)),
            "relative_error": float((rounded - gradient).norm() / gradient.norm()),
        }
        orders = _compare_orders(single, actions[:horizon], paired_returns[:, horizon - 1], noise[:, :horizon])
        results.append(result | orders)
    return results, errors


def _compare_orders(function: ReturnFunction, actions: Tensor, paired_returns: Tensor, noise: Tensor) -> Result:
    """First- and zeroth-order estimates of the gradient of the return under action noise."""
    first, first_variance, first_failed = _mean_and_variance(function.gradients(actions + NOISE_STD * noise))
    ahead, behind = paired_returns.chunk(2)
    slopes = (ahead - behind) / (2 * NOISE_STD)
    samples = slopes[:, None, None, None, None] * noise[: len(slopes)].to(slopes)
    zeroth, zeroth_variance, zeroth_failed = _mean_and_variance(samples)
    length = NOISE_STD * actions.numel() ** 0.5
    steps = [length * mean / mean.norm() for mean in (first, zeroth)]
    start, after_first, after_zeroth = function.returns(torch.stack([actions, *(actions + s for s in steps)]))[:, -1]
    return {
        "first_variance": first_variance,
        "zeroth_variance": zeroth_variance,
        "promised": float(length * first.norm()),
        "first_gain": float(after_first - start),
        "zeroth_gain": float(after_zeroth - start),
        "failed": first_failed + zeroth_failed,
    }


def _mean_and_variance(samples: Tensor) -> tuple[Tensor, float, int]:
    """Mean of the finite samples (S, ...), the total variance of that mean, and how many were not finite."""
    finite = samples.isfinite().flatten(1).all(1)
    failed = int((~finite).sum())
    kept = samples[finite]
    if len(kept) < 2:
        return torch.full_like(samples[0], torch.nan), torch.nan, failed
    return kept.mean(0), float(kept.var(0).sum() / len(kept)), failed
