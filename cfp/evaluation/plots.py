"""The learning curve of a run as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cfp.config import RunConfig
from cfp.files import write_atomically
from cfp.tables import read_table


def plot_curve(run: Path, config: RunConfig, baselines: dict[str, float]) -> Path:
    """Draw training and evaluation returns over environment steps into ``curve.png``; returns its path."""
    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    training = read_table(run / "progress.csv", ("step", "stage"))
    evaluations = read_table(run / "evaluations.csv", ("step", "mean", "std"))
    steps, values = _column(training, "rollout/return")
    if steps:
        axes.plot(steps, values, color="tab:gray", alpha=0.8, label="training episodes (with noise)")
    steps, means = _column(evaluations, "mean")
    _, stds = _column(evaluations, "std")
    how = "without noise" if config.eval_deterministic else "with noise"
    if steps:
        axes.plot(steps, means, "o-", color="tab:blue", markersize=3, label=f"evaluation ({how}), mean ± std")
    low, high = np.subtract(means, stds), np.add(means, stds)
    axes.fill_between(steps, low, high, color="tab:blue", alpha=0.2, linewidth=0)
    for (name, value), style in zip(baselines.items(), ("--", ":", "-."), strict=False):
        axes.axhline(value, color="black", linestyle=style, linewidth=1, label=name)
    for stage, step in _handovers(training):
        before, after = config.resolution(stage), config.resolution(stage + 1)
        axes.axvline(step, color="tab:green", linewidth=1)
        label = f" {before}x{before} → {after}x{after}"
        axes.text(step, 0.01, label, color="tab:green", fontsize=8, transform=axes.get_xaxis_transform())
    axes.set(xlabel="environment steps", ylabel="return of an episode")
    axes.set_title(f"{config.algo} on {config.task}, seed {config.seed}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    write_figure(run / "curve.png", figure)
    return run / "curve.png"


def write_figure(path: Path, figure: Figure, shared: bool = False) -> None:
    """Write a figure as PNG, see `cfp.files.write_atomically`."""
    write_atomically(path, lambda file: figure.savefig(file, format="png"), shared)


def _column(rows: Sequence[dict[str, str]], name: str) -> tuple[list[float], list[float]]:
    """Steps and values of a column, where it has a value."""
    pairs = [(float(row["step"]), float(row[name])) for row in rows if row.get(name)]
    return [step for step, _ in pairs], [value for _, value in pairs]


def _handovers(rows: Sequence[dict[str, str]]) -> list[tuple[int, float]]:
    """Number and last step of every stage but the newest; a run that starts from a policy lacks the first ones."""
    last: dict[int, float] = {}
    for row in rows:
        last[int(row["stage"])] = float(row["step"])
    return list(last.items())[:-1]
