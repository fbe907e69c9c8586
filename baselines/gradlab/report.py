"""The report of the gradient laboratory: a conclusion, tables and a figure."""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.gradlab.measure import STEP_SIZES, HorizonResult
from cfp.evaluation.plots import write_figure
from cfp.files import write_json, write_text
from cfp.tables import csv_text

MAX_DIFFERENCE_ERROR, MIN_COSINE = 0.05, 0.99
"""Largest error of finite differences, and smallest cosine between precisions, of a gradient taken to be right."""

_COLUMNS = {
    "horizon": "steps",
    "norm": "norm",
    "first_norm": "norm, 1st action",
    "difference_error": "diff. error",
    "difference_step": "at step size",
    "cosine": "cosine f32",
    "relative_error": "f32 error",
    "first_variance": "var. 1st",
    "zeroth_variance": "var. 0th",
    "promised": "promised",
    "first_gain": "gain 1st",
    "zeroth_gain": "gain 0th",
}


def objections(result: HorizonResult) -> list[str]:
    """Reasons why the gradient is not useful at a horizon; empty if it is."""
    checks = {
        f"{result.failed} samples are not finite": result.failed == 0,
        f"finite differences differ by {result.difference_error:.0%}": result.difference_error <= MAX_DIFFERENCE_ERROR,
        f"float32 and float64 differ (cosine {result.cosine:.3f})": result.cosine >= MIN_COSINE,
        "its variance is larger than that of zeroth order": result.first_variance < result.zeroth_variance,
        f"a step along it gains {result.first_gain:.3g}": result.first_gain > 0,
        f"a zeroth-order step gains more ({result.zeroth_gain:.3g} against {result.first_gain:.3g})": (
            result.first_gain > result.zeroth_gain
        ),
    }
    return [reason for reason, passed in checks.items() if not passed]


def conclude(task: str, results: Sequence[HorizonResult]) -> tuple[int, str]:
    """Return the horizon up to which the gradient is useful (0: none), and a sentence with the numbers."""
    useful, limit = [], "That is the longest horizon measured."
    for result in results:
        if reasons := objections(result):
            limit = f"At {result.horizon}, {' and '.join(reasons)}."
            break
        useful.append(result)
    if not useful:
        return 0, f"{task}: the gradient helps at no horizon measured. {limit}"
    last = useful[-1]
    ratio = last.zeroth_variance / last.first_variance
    return last.horizon, (
        f"{task}: the gradient helps up to {last.horizon} control steps. There its relative error is "
        f"{last.difference_error:.1g}, its variance is {ratio:.2g} times smaller than that of a zeroth-order estimate "
        f"from as many simulations, and a step along it gains {last.first_gain:.3g} against {last.zeroth_gain:.3g}. "
        f"{limit}"
    )


def format_table(results: Sequence[HorizonResult]) -> str:
    """Format the results for a terminal."""
    widths = {name: max(9, len(head)) for name, head in _COLUMNS.items()}
    lines = ["  ".join(head.rjust(widths[name]) for name, head in _COLUMNS.items())]
    for result in results:
        lines.append("  ".join(f"{getattr(result, name):.3g}".rjust(width) for name, width in widths.items()))
    return "\n".join(lines)


def write(
    folder: Path, config: dict[str, Any], results: Sequence[HorizonResult], errors: Sequence[Sequence[float]]
) -> str:
    """Write ``report.json``, ``horizons.csv``, ``differences.csv`` and ``gradients.png``.

    Numbers that are not finite are null in ``report.json``, as JSON has none.

    Args:
        folder: Where to write.
        config: Options of the measurement.
        results: One per horizon.
        errors: Of finite differences, by horizon and step size.

    Returns:
        The sentence of conclusion.
    """
    reach, sentence = conclude(config["task"], results)
    horizons = [dataclasses.asdict(result) for result in results]
    differences = [
        {"horizon": result.horizon, "step_size": step, "error": error}
        for result, row in zip(results, errors, strict=True)
        for step, error in zip(STEP_SIZES, row, strict=True)
    ]
    report = {"config": config, "reach": reach, "conclusion": sentence}
    write_json(folder / "report.json", _finite({**report, "horizons": horizons, "differences": differences}))
    for name, rows in (("horizons", horizons), ("differences", differences)):
        write_text(folder / f"{name}.csv", csv_text(rows, list(rows[0])))
    write_figure(folder / "gradients.png", draw(results, errors, sentence))
    return sentence


def _finite(value: Any) -> Any:
    """Replace every number that is not finite by None."""
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def draw(results: Sequence[HorizonResult], errors: Sequence[Sequence[float]], title: str) -> Figure:
    """Draw four panels: finite differences, norm, precision, first against zeroth order."""
    figure = Figure(figsize=(11, 8), dpi=110, layout="constrained")
    (differences, norms), (precision, variances) = figure.subplots(2, 2)
    horizons = [result.horizon for result in results]
    for index, (horizon, row) in enumerate(zip(horizons, errors, strict=True)):
        shade = str(0.8 * (1.0 - (index + 1) / len(horizons)))
        differences.plot(STEP_SIZES, row, "o-", color=shade, markersize=3, label=f"horizon {horizon}")
    differences.set(
        title="finite differences against gradient, float64",
        xlabel="step size (action units)",
        ylabel="relative error",
        xscale="log",
    )

    def plot(axes: Axes, label: str, values: Sequence[float], style: str = "o-") -> None:
        axes.plot(horizons, values, style, label=label, markersize=4)

    plot(norms, "all actions", [r.norm for r in results])
    plot(norms, "first action", [r.first_norm for r in results], "s--")
    norms.set(title="gradient of the return", ylabel="norm")
    plot(precision, "relative error", [r.relative_error for r in results])
    plot(precision, "1 - cosine", [1.0 - r.cosine for r in results], "s--")
    precision.set(title="float32 against float64")
    plot(variances, "first order", [r.first_variance for r in results])
    plot(variances, "zeroth order, as many simulations", [r.zeroth_variance for r in results])
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
