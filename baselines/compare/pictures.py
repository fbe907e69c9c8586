"""The pictures of a comparison."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from baselines.compare.collect import Group
from baselines.compare.stats import bootstrap, common_curve, interquartile_mean, interval

COLOURS = (
    "#0173b2 #de8f05 #029e73 #d55e00 #cc78bc #ca9161 #56b4e9 #949494 #8c564b #bcbd22 #17becf #7f3c8d #e377c2 #1b5e20"
).split()
LINES = {"image": "-", "state": "--", "simulator": ":"}
MARKS = {"image": "o", "state": "s", "simulator": "^"}
BAND_REPEATS = 2_000
OTHER = "-.", "D"
"""Line and mark of policies that see something else."""


def _colours(groups: Sequence[Group]) -> dict[str, str]:
    labels = dict.fromkeys(group.label for group in groups)
    return {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(labels)}


def _panels(groups: Sequence[Group], draw: Callable[[Axes, list[Group]], None], height: float) -> Figure:
    """A panel for each task and a legend that says who sees what."""
    tasks = list(dict.fromkeys(group.task for group in groups))
    columns = min(len(tasks), 3)
    rows = math.ceil(len(tasks) / columns)
    who = list({(group.label, group.sees): group for group in groups}.values())
    size = (max(6.5, 4.6 * columns), height * rows + 0.3 * math.ceil(len(who) / max(3, 2 * columns)) + 0.2)
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    for index, task in enumerate(tasks):
        axes = figure.add_subplot(rows, columns, index + 1)
        draw(axes, [group for group in groups if group.task == task])
        axes.set_title(task)
        axes.grid(alpha=0.3)
    colours = _colours(groups)
    handles = [
        Line2D([], [], color=colours[g.label], linestyle=_line(g), marker=_mark(g), label=f"{g.label} (sees {g.sees})")
        for g in who
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=max(3, 2 * columns), fontsize=8, frameon=False)
    return figure


def _line(group: Group) -> Any:
    return LINES.get(group.sees, OTHER[0])


def _mark(group: Group) -> str:
    return MARKS.get(group.sees, OTHER[1])


def curves(groups: Sequence[Group]) -> Figure:
    """Evaluations while training: interquartile mean over seeds and its 95 % bootstrap band."""
    colours = _colours(groups)

    def draw(axes: Axes, members: list[Group]) -> None:
        for group in members:
            if not group.curves:
                continue
            steps, values = common_curve(group.curves)
            style = {"color": colours[group.label], "linestyle": _line(group), "marker": _mark(group)}
            axes.plot(steps, interquartile_mean(values), markersize=3, linewidth=1.5, **style)
            band = bootstrap([values], repeats=BAND_REPEATS)
            if band is not None:
                axes.fill_between(steps, *band, color=colours[group.label], alpha=0.15, linewidth=0)
        axes.set(xlabel="environment steps", ylabel="return of an evaluation")

    return _panels(groups, draw, 3.4)


def returns(groups: Sequence[Group]) -> Figure:
    """Final evaluation: each seed a pale mark, interquartile mean and interval; grouped by what is seen."""
    colours = _colours(groups)

    def draw(axes: Axes, members: list[Group]) -> None:
        shown = [group for group in members if group.scores]
        for place, group in enumerate(shown):
            mean = float(interquartile_mean(np.array(group.scores)))
            ends = interval([group.scores])
            axes.plot(group.scores, [place] * len(group.scores), _mark(group), color=colours[group.label], alpha=0.35)
            if ends is not None:
                axes.plot(ends, [place, place], color=colours[group.label], linewidth=2.5)
            axes.plot(mean, place, _mark(group), color=colours[group.label], markersize=8, markeredgecolor="black")
        for place in range(1, len(shown)):
            if shown[place].sees != shown[place - 1].sees:
                axes.axhline(place - 0.5, color="black", linewidth=1)
        axes.set_yticks(range(len(shown)), [f"{group.label} ({group.sees})" for group in shown], fontsize=8)
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlabel("return")

    most = max((sum(group.task == task for group in groups) for task in {group.task for group in groups}), default=1)
    return _panels(groups, draw, 1.2 + 0.3 * most)


def robustness(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Ratio under each disturbance, a bar for each algorithm with the range of its seeds; the paper's as a line.

    Args:
        rows: Of the robustness table.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    labels = list(dict.fromkeys((row["algo"], row["sees"]) for row in rows))
    cases = {task: list(dict.fromkeys(row["case"] for row in rows if row["task"] == task)) for task in tasks}
    height, most = 0.8 / len(labels), max(map(len, cases.values()))
    size = (max(6.5, 4.6 * len(tasks)), 1.4 + most * max(0.4, 0.22 * len(labels)))
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    for index, task in enumerate(tasks):
        axes = figure.add_subplot(1, len(tasks), index + 1)
        for row in (row for row in rows if row["task"] == task and row["ratio"] is not None):
            slot = labels.index((row["algo"], row["sees"]))
            place = cases[task].index(row["case"]) + (slot - (len(labels) - 1) / 2) * height
            reach = [[row["ratio"] - row["low"]], [row["high"] - row["ratio"]]]
            axes.barh(place, row["ratio"], height, xerr=reach, color=COLOURS[slot % len(COLOURS)], ecolor="black")
            if row["paper"] is not None:
                axes.plot([row["paper"]] * 2, [place - height / 2, place + height / 2], color="black", linewidth=2.5)
        axes.axvline(1, color="black", linewidth=1, linestyle="--")
        axes.set_yticks(range(len(cases[task])), cases[task], fontsize=8)
        axes.set_ylim(len(cases[task]) - 0.5, -0.5)
        axes.set(xlabel="ratio to the unperturbed return", title=task)
        axes.grid(alpha=0.3, axis="x")
    handles = [
        Line2D([], [], color=COLOURS[i % len(COLOURS)], linewidth=6, label=f"{label} (sees {sees})")
        for i, (label, sees) in enumerate(labels)
    ]
    handles.append(Line2D([], [], color="black", linewidth=2.5, label="the paper's CFP"))
    figure.legend(handles=handles, loc="outside lower center", ncols=max(3, 2 * len(tasks)), fontsize=8, frameon=False)
    return figure
