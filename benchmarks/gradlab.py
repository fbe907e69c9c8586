"""Up to which horizon does a gradient through the simulation help on a task?

Run `python benchmarks/gradlab.py --task run`. It measures the gradient of the task's smooth return with respect to the
actions at several horizons: against finite differences, in float32 against float64, and as a first- against a
zeroth-order estimate from as many simulations. Writes `horizons.csv`, `differences.csv` and `gradients.png`. With
`--quick` a tiny robot and short horizons take seconds.
"""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import cosine_similarity
from tqdm import tqdm

from baselines.common.rollout import check_differentiable, rollout
from cfp.evaluation.page import write_figure
from cfp.files import write_text
from cfp.tables import csv_text
from dittogym import TorchEnv
from dittogym.core import EnvState, Model
from torchmpm import tree

#: Actions are drawn uniformly from [-ACTION_RANGE, ACTION_RANGE].
ACTION_RANGE = 0.3
#: Random directions of the finite differences.
DIRECTIONS = 4

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


#: Largest error of finite differences, and smallest cosine between precisions, of a gradient taken to be right.
MAX_DIFFERENCE_ERROR, MIN_COSINE = 0.05, 0.99


def objections(result: Result) -> list[str]:
    """Reasons why the gradient is not useful at a horizon; empty if it is."""
    first, zeroth = result["first_gain"], result["zeroth_gain"]
    checks = {
        f"{result['failed']} samples are not finite": result["failed"] == 0,
        f"finite differences differ by {result['difference_error']:.0%}": (
            result["difference_error"] <= MAX_DIFFERENCE_ERROR
        ),
        f"float32 and float64 differ (cosine {result['cosine']:.3f})": result["cosine"] >= MIN_COSINE,
        "its variance is larger than that of zeroth order": result["first_variance"] < result["zeroth_variance"],
        f"a step along it gains {first:.3g}": first > 0,
        f"a zeroth-order step gains more ({zeroth:.3g} against {first:.3g})": first > zeroth,
    }
    return [reason for reason, passed in checks.items() if not passed]


def conclude(task: str, results: Sequence[Result]) -> tuple[int, str]:
    """Return the horizon up to which the gradient is useful (0: none), and a sentence with the numbers."""
    useful, limit = [], "That is the longest horizon measured."
    for result in results:
        if reasons := objections(result):
            limit = f"At {result['horizon']}, {' and '.join(reasons)}."
            break
        useful.append(result)
    if not useful:
        return 0, f"{task}: the gradient helps at no horizon measured. {limit}"
    last = useful[-1]
    ratio = last["zeroth_variance"] / last["first_variance"] if last["first_variance"] else math.inf
    return last["horizon"], (
        f"{task}: the gradient helps up to {last['horizon']} control steps. There its relative error is "
        f"{last['difference_error']:.1g}, its variance is {ratio:,.0f} times smaller than that of a zeroth-order "
        f"estimate from as many simulations, and a step along it gains {last['first_gain']:.3g} against "
        f"{last['zeroth_gain']:.3g}. {limit}"
    )


def draw(results: Sequence[Result], errors: Sequence[Sequence[float]], title: str) -> Figure:
    """Draw four panels: finite differences, norm, precision, first against zeroth order."""
    figure = Figure(figsize=(11, 8), dpi=110, layout="constrained")
    differences, norms, precision, variances = figure.subplots(2, 2).flat
    values = {name: np.array([result[name] for result in results]) for name in COLUMNS}
    horizons = values["horizon"]
    for index, (horizon, row) in enumerate(zip(horizons, errors, strict=True)):
        shade = str(0.8 * (1.0 - (index + 1) / len(horizons)))
        differences.plot(STEP_SIZES, row, "o-", color=shade, markersize=3, label=f"horizon {horizon}")
    differences.set(title="finite differences against gradient, float64", ylabel="relative error")
    differences.set(xlabel="step size (action units)", xscale="log")
    norms.plot(horizons, values["norm"], "o-", label="all actions")
    norms.plot(horizons, values["first_norm"], "s--", label="first action")
    norms.set(title="gradient of the return", ylabel="norm")
    precision.plot(horizons, values["relative_error"], "o-", label="relative error")
    precision.plot(horizons, 1.0 - values["cosine"], "s--", label="1 - cosine")
    precision.set(title="float32 against float64")
    variances.plot(horizons, values["first_variance"], "o-", label="first order")
    variances.plot(horizons, values["zeroth_variance"], "o-", label="zeroth order, as many simulations")
    variances.set(title="variance of the mean gradient under action noise", ylabel="total variance")
    for axes in (norms, precision, variances):
        axes.set_xscale("log", base=2)
        axes.set_xticks(horizons, [str(horizon) for horizon in horizons])
        axes.set_xlabel("horizon (control steps)")
    for axes in (differences, norms, precision, variances):
        if any(np.greater(line.get_ydata(), 0).any() for line in axes.lines):  # a log axis needs a positive value
            axes.set_yscale("log")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle(textwrap.fill(title, 130), fontsize=10)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="run")
    parser.add_argument("--out", type=Path, help="folder of the results; runs/gradlab-TASK if not given")
    parser.add_argument("--quick", action="store_true", help="a tiny robot and short horizons")
    parser.add_argument("--seed", type=int, default=0, help="of particles, actions and noise")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--resolution", default="coarse", help="action grid")
    parser.add_argument("--particles", type=int, help="about 2,000 if not given")
    parser.add_argument(
        "--horizons", type=int, nargs="+", help="control steps over which rewards are summed, increasing"
    )
    parser.add_argument("--warmup", type=int, help="control steps with random actions before the measured ones")
    parser.add_argument("--samples", type=int, help="simulations for each estimate, an even number")
    given = parser.parse_args(arguments)
    quick = given.quick
    horizons = given.horizons or ((1, 2, 4) if quick else (1, 2, 4, 8, 16, 32, 64))
    warmup = given.warmup if given.warmup is not None else 1 if quick else 8
    samples = given.samples or (4 if quick else 16)
    resolution = int(given.resolution) if given.resolution.isdigit() else given.resolution
    options = {"particles": given.particles or (200 if quick else "lite"), "substeps": 5 if quick else 100}
    env = TorchEnv(
        given.task, dtype="float64", device=given.device, backend=given.backend, resolution=resolution, **options
    )
    env.reset(seed=given.seed)
    check_differentiable(env)
    horizons = [horizon for horizon in horizons if horizon <= env.spec.horizon - warmup]
    generator = torch.Generator().manual_seed(given.seed)
    shape = (horizons[-1], *env.action_shape)

    def normal(count: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=env.dtype).to(env.device)

    actions = torch.rand(warmup + shape[0], *env.action_shape, generator=generator, dtype=env.dtype)
    actions = (ACTION_RANGE * (2.0 * actions - 1.0)).to(env.device)
    with torch.no_grad():
        for action in actions[:warmup]:
            env.step(action[None])
    function = ReturnFunction(env.model, env.env_state)
    results, errors = measure(function, actions[warmup:], horizons, normal(DIRECTIONS), normal(samples))
    _, conclusion = conclude(given.task, results)
    folder = given.out or Path("runs") / f"gradlab-{given.task}"
    differences = [
        {"horizon": result["horizon"], "step_size": step, "error": float(error)}
        for result, row in zip(results, errors, strict=True)
        for step, error in zip(STEP_SIZES, row, strict=True)
    ]
    write_text(folder / "horizons.csv", csv_text(results, list(COLUMNS)))
    write_text(folder / "differences.csv", csv_text(differences, list(differences[0])))
    write_figure(folder / "gradients.png", draw(results, errors.tolist(), conclusion))
    for name, text in COLUMNS.items():
        print(f"{text:<90}", *(f"{result[name]:>9.3g}" for result in results))
    print(f"\n{conclusion}\nwritten to {folder}")


if __name__ == "__main__":
    main()
