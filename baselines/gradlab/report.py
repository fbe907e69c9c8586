"""What the laboratory writes: a conclusion, a table, a picture."""

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

from baselines.gradlab.measure import Row
from cfp.evaluation.plots import write_figure
from cfp.files import write_json, write_text
from cfp.tables import csv_text

#: Largest error of finite differences, and smallest cosine between precisions, of a gradient that is right.
DIFFERENCE_LIMIT, COSINE_LIMIT = 0.05, 0.99

_HEADS = {
    "horizon": "steps",
    "norm": "norm",
    "first_norm": "norm, 1st action",
    "difference_error": "diff. error",
    "difference_width": "at width",
    "cosine": "1 - cos f32",
    "relative_error": "f32 error",
    "first_variance": "var. 1st",
    "zeroth_variance": "var. 0th",
    "promised": "promised",
    "first_gain": "gain 1st",
    "zeroth_gain": "gain 0th",
}


def objections(row: Row) -> list[str]:
    """Why the gradient does not help at a horizon; empty if it does."""
    checks = {
        f"{row.failed} samples are not finite": row.failed == 0,
        f"finite differences differ by {row.difference_error:.0%}": row.difference_error <= DIFFERENCE_LIMIT,
        f"float32 and float64 differ (cosine {row.cosine:.3f})": row.cosine >= COSINE_LIMIT,
        "it scatters more than one of zeroth order": row.first_variance < row.zeroth_variance,
        f"a step along it gains {row.first_gain:.3g}": row.first_gain > 0,
        f"a step of zeroth order gains more ({row.zeroth_gain:.3g} against {row.first_gain:.3g})": (
            row.first_gain > row.zeroth_gain
        ),
    }
    return [reason for reason, passed in checks.items() if not passed]


def conclude(task: str, rows: Sequence[Row]) -> tuple[int, str]:
    """Up to which horizon a gradient helps (0: none), and the sentence that says so with the numbers."""
    good = []
    for row in rows:
        if reasons := objections(row):
            limit = f"At {row.horizon}, {' and '.join(reasons)}."
            break
        good.append(row)
    else:
        limit = "That is the longest horizon measured."
    if not good:
        return 0, f"{task}: the gradient helps at no horizon measured. {limit}"
    last = good[-1]
    ratio = last.zeroth_variance / last.first_variance
    return last.horizon, (
        f"{task}: the gradient helps up to {last.horizon} control steps. There it is right to "
        f"{last.difference_error:.1g}, its variance is {ratio:.2g} times smaller than that of zeroth order from "
        f"as many simulations, and a step along it gains {last.first_gain:.3g} against {last.zeroth_gain:.3g}. {limit}"
    )


def format_table(rows: Sequence[Row]) -> str:
    """The rows for a terminal."""
    lines = ["  ".join(f"{head:>{max(9, len(head))}}" for head in _HEADS.values())]
    for row in rows:
        values = {name: getattr(row, name) for name in _HEADS} | {"cosine": 1.0 - row.cosine}
        cells = (f"{value:.3g}".rjust(max(9, len(_HEADS[name]))) for name, value in values.items())
        lines.append("  ".join(cells))
    return "\n".join(lines)


def write(
    folder: Path,
    config: dict[str, Any],
    rows: Sequence[Row],
    widths: Sequence[float],
    errors: Sequence[Sequence[float]],
) -> str:
    """Write ``report.json``, ``horizons.csv``, ``differences.csv`` and ``gradients.png``.

    What is not finite is null in JSON, which knows no such numbers.

    Args:
        folder: Where.
        config: Options of the measurement.
        rows: By horizon.
        widths: Of finite differences.
        errors: Of finite differences, by horizon and width.

    Returns:
        The sentence of conclusion.
    """
    reach, sentence = conclude(config["task"], rows)
    table = [dataclasses.asdict(row) for row in rows]
    differences = [
        {"horizon": row.horizon, "width": width, "error": error}
        for row, line in zip(rows, errors, strict=True)
        for width, error in zip(widths, line, strict=True)
    ]
    report = {"config": config, "reach": reach, "conclusion": sentence, "horizons": table, "differences": differences}
    write_json(folder / "report.json", _finite(report))
    for name, listed in (("horizons", table), ("differences", differences)):
        write_text(folder / f"{name}.csv", csv_text(listed, list(listed[0])))
    write_figure(folder / "gradients.png", draw(rows, widths, errors, sentence))
    return sentence


def _finite(value: Any) -> Any:
    """A value for JSON, with None in place of every number that is not finite."""
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def draw(rows: Sequence[Row], widths: Sequence[float], errors: Sequence[Sequence[float]], sentence: str) -> Figure:
    """Four panels: finite differences, norm, precision, first against zeroth order."""
    figure = Figure(figsize=(11, 8), dpi=110, layout="constrained")
    panels = figure.subplots(2, 2)
    horizons = [row.horizon for row in rows]

    def line(axes: Axes, name: str, label: str, style: str = "o-") -> None:
        axes.plot(horizons, [getattr(row, name) for row in rows], style, label=label, markersize=4)

    for index, (row, error) in enumerate(zip(rows, errors, strict=True)):
        shade = str(0.8 * (1.0 - (index + 1) / len(rows)))
        panels[0, 0].plot(widths, error, "o-", color=shade, markersize=3, label=f"horizon {row.horizon}")
    panels[0, 0].set(xlabel="step width (action units)", title="finite differences against gradient, float64")
    panels[0, 0].set_ylabel("relative error")
    line(panels[0, 1], "norm", "in all actions")
    line(panels[0, 1], "first_norm", "in the first action", "s--")
    panels[0, 1].set(title="gradient of the return", ylabel="norm")
    line(panels[1, 0], "relative_error", "relative error")
    panels[1, 0].plot(horizons, [1.0 - row.cosine for row in rows], "s--", markersize=4, label="1 - cosine")
    panels[1, 0].set(title="float32 against float64")
    line(panels[1, 1], "first_variance", "first order")
    line(panels[1, 1], "zeroth_variance", "zeroth order, as many simulations")
    panels[1, 1].set(title="variance of the mean gradient of a noisy plan", ylabel="total variance")
    for axes in panels.flat:
        shown = np.concatenate([np.asarray(drawn.get_ydata(), float) for drawn in axes.lines])
        if (np.isfinite(shown) & (shown > 0)).any():  # else there is nothing that such an axis could show
            axes.set_yscale("log")
        axes.set_xscale("log", base=10 if axes is panels[0, 0] else 2)
        if axes is not panels[0, 0]:
            axes.set_xticks(horizons, [str(horizon) for horizon in horizons])
            axes.set_xlabel("horizon (control steps)")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.suptitle(textwrap.fill(sentence, 130), fontsize=10)
    return figure
