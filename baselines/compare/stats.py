"""Statistics of few runs (Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice")."""

from collections.abc import Sequence

import numpy as np
import scipy.stats

#: Steps (N,), increasing, and values (N,).
Curve = tuple[np.ndarray, np.ndarray]


def interquartile_mean(scores: np.ndarray | Sequence[float], axis: int = 0) -> np.ndarray:
    """Mean without the lowest and the highest quarter, each rounded down: the plain mean of up to three scores."""
    mean: np.ndarray = scipy.stats.trim_mean(scores, 0.25, axis=axis)
    return mean


def bootstrap_interval(
    strata: Sequence[np.ndarray | Sequence[float]], resamples: int = 10_000
) -> tuple[np.ndarray, np.ndarray] | None:
    """Percentile 95 % interval of the interquartile mean, by stratified bootstrap; None without a task of two runs.

    With two or three runs it is hardly wider than their range, and too narrow. The strata hold the scores (N_i,) of the
    runs of each task; a single stratum may hold curves (N, T), resampled as wholes.
    """
    resampled = [np.asarray(scores, float) for scores in strata if len(scores) > 1]
    if not resampled:
        return None
    single = [scores[0] for scores in strata if len(scores) == 1]  # the same in every resample

    def statistic(*samples: np.ndarray, axis: int) -> np.ndarray:
        constant = np.broadcast_to(np.array(single), (*samples[0].shape[:-1], len(single)))
        return interquartile_mean(np.concatenate([*samples, constant], axis=-1), axis=axis)

    result = scipy.stats.bootstrap(
        resampled, statistic, n_resamples=resamples, method="percentile", vectorized=True, rng=np.random.default_rng(0)
    )
    low, high = result.confidence_interval
    return low, high


def score_interval(strata: Sequence[Sequence[float]]) -> tuple[float, float] | tuple[None, None]:
    """`bootstrap_interval` as plain numbers; None twice if there is none."""
    ends = bootstrap_interval(strata)
    return (None, None) if ends is None else (float(ends[0]), float(ends[1]))


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a probability."""
    low, high = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(low), float(high)


def first_step_at(curve: Curve, value: float) -> float | None:
    """The first step of a curve whose value is at least ``value``; None if there is none."""
    steps, values = curve
    reached = np.flatnonzero(values >= value)
    return float(steps[reached[0]]) if len(reached) else None


def align_curves(curves: Sequence[Curve]) -> Curve:
    """Interpolate curves linearly onto the steps (T,) that all of them cover, if any: values (runs, T)."""
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps for steps, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in curves])
