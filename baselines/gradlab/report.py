"""The report of the gradient laboratory: a conclusion, tables and a figure."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from baselines.gradlab.measure import COLUMNS, STEP_SIZES, Result
from cfp.evaluation.page import write_figure
from cfp.files import write_json, write_text
from cfp.tables import csv_text

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


def write(folder: Path, config: dict[str, Any], results: Sequence[Result], errors: Sequence[Sequence[float]]) -> str:
    """Write ``report.json``, ``horizons.csv``, ``differences.csv`` and ``gradients.png``; return the text to print."""
    reach, conclusion = conclude(config["task"], results)
    differences = [
        {"horizon": result["horizon"], "step_size": step, "error": error}
        for result, row in zip(results, errors, strict=True)
        for step, error in zip(STEP_SIZES, row, strict=True)
    ]
    report = {"config": config, "reach": reach, "conclusion": conclusion}
    write_json(folder / "report.json", report | {"horizons": _finite(results), "differences": _finite(differences)})
    write_text(folder / "horizons.csv", csv_text(results, list(COLUMNS)))
    write_text(folder / "differences.csv", csv_text(differences, list(differences[0])))
    write_figure(folder / "gradients.png", draw(results, errors, conclusion))
    rows = [list(COLUMNS), *([f"{result[name]:.3g}" for name in COLUMNS] for result in results)]
    table = "\n".join("  ".join(cell.rjust(16) for cell in row) for row in rows)
    return f"{table}\n\n{conclusion}\nwritten to {folder}"


def _finite(rows: Sequence[Result]) -> list[Result]:
    """Rows with None, which JSON calls null, in place of every number that is not finite."""
    return [{name: value if math.isfinite(value) else None for name, value in row.items()} for row in rows]


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
