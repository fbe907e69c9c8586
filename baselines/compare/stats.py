"""Statistics of few runs.

Interquartile mean and stratified bootstrap are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of
the Statistical Precipice", NeurIPS 2021 (their library: ``rliable``): one score a run, runs resampled within tasks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist

import numpy as np

Interval = tuple[float, float]
REPEATS = 10_000
"""Resamples of a bootstrap."""


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Mean of what is left when the lowest and the highest quarter are cut off, rounded down; for few scores, the mean.

    Args:
        scores: (N, ...), N of 1 or more.

    Returns:
        (...), as ``scipy.stats.trim_mean(scores, 0.25)``.
    """
    count = len(scores)
    cut = count // 4
    mean: np.ndarray = np.sort(scores, axis=0)[cut : count - cut].mean(0)
    return mean


def bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], np.ndarray] = interquartile_mean,
    level: float = 0.95,
    repeats: int = REPEATS,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Percentile interval of a statistic, by stratified resampling of runs with replacement.

    With two or three runs it is hardly wider than their range, and too narrow.

    Args:
        strata: Scores (N_i, ...) of the runs of each task.
        statistic: From (N, repeats, ...), all strata together, to (repeats, ...).
        level: Of confidence.
        repeats: Resamples.
        seed: Of the generator.

    Returns:
        Lower and upper end, (...) each; None where no stratum has two runs, which says nothing about their spread.
    """
    if max(map(len, strata)) < 2:
        return None
    generator = np.random.default_rng(seed)
    drawn = [scores[generator.integers(len(scores), size=(len(scores), repeats))] for scores in strata]
    low, high = np.quantile(statistic(np.concatenate(drawn)), [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def interval(strata: Sequence[Sequence[float]]) -> Interval | None:
    """`bootstrap` of the interquartile mean of plain numbers."""
    ends = bootstrap([np.asarray(scores, float) for scores in strata])
    return None if ends is None else (float(ends[0]), float(ends[1]))


def wilson(successes: int, trials: int, level: float = 0.95) -> Interval:
    """Score interval of a probability (Wilson, 1927); sensible at 0 and at few trials.

    Raises:
        ValueError: No trials, or more successes than trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"successes, trials: got {successes} of {trials}, allowed 0 to trials of 1 or more")
    z, rate = NormalDist().inv_cdf((1 + level) / 2), successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return max(0.0, centre - half), min(1.0, centre + half)


def first_reach(steps: np.ndarray, values: np.ndarray, level: float) -> float | None:
    """The first step (N,) whose value (N,) is at least a level; None if there is none."""
    reached = np.flatnonzero(values >= level)
    return float(steps[reached[0]]) if len(reached) else None


def common_curve(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Curves of several runs on common steps, where all of them have values; linear in between.

    Args:
        curves: Steps (N,), growing, and values (N,) of each run.

    Returns:
        Steps (T,) and values (runs, T); T is 0 where the runs have no step in common.
    """
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps for steps, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in curves])
