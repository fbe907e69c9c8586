"""The pictures of a comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from baselines.compare.results import Group
from baselines.compare.stats import bootstrap, common_curve, interquartile_mean, interval

COLOURS = (
    "#0173b2 #de8f05 #029e73 #d55e00 #cc78bc #ca9161 #56b4e9 #949494 #8c564b #bcbd22 #17becf #7f3c8d #e377c2 #1b5e20"
).split()
LINES = {"image": "-", "state": "--", "simulator": ":", "nothing": (0, (1, 4))}
MARKS = {"image": "o", "state": "s", "simulator": "^", "nothing": "v"}
BAND_REPEATS = 2_000
OTHER = "-.", "D"
"""Line and mark of policies that see something else."""


def _colours(groups: Sequence[Group]) -> dict[str, str]:
    labels = dict.fromkeys(group.label for group in groups)
    return {label: COLOURS[i % len(COLOURS)] for i, label in enumerate(labels)}


def _panels(tasks: Sequence[str], height: float, handles: list[Line2D]) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a panel of some height, inches, for each task, and a legend below."""
    columns = min(len(tasks), 3)
    rows, across = math.ceil(len(tasks) / columns), max(3, 2 * columns)
    size = (max(6.5, 4.6 * columns), height * rows + 0.3 * math.ceil(len(handles) / across) + 0.2)
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    panels = {task: figure.add_subplot(rows, columns, index + 1) for index, task in enumerate(tasks)}
    for task, axes in panels.items():
        axes.set_title(task)
        axes.grid(alpha=0.3)
    figure.legend(handles=handles, loc="outside lower center", ncols=across, fontsize=8, frameon=False)
    return figure, panels


def _legend(groups: Sequence[Group]) -> list[Line2D]:
    """Who sees what."""
    colours, who = _colours(groups), {(group.label, group.sees): group for group in groups}.values()
    return [
        Line2D([], [], color=colours[g.label], linestyle=_line(g), marker=_mark(g), label=f"{g.label} (sees {g.sees})")
        for g in who
    ]


def _line(group: Group) -> Any:
    return LINES.get(group.sees, OTHER[0])


def _mark(group: Group) -> str:
    return MARKS.get(group.sees, OTHER[1])


def curves(groups: Sequence[Group], *, minutes: bool = False) -> Figure:
    """Evaluations while training: interquartile mean over seeds and its 95 % bootstrap band.

    Args:
        groups: All.
        minutes: Over the time of training at each group's mean speed, in place of environment steps; a teacher's comes
            first.
    """
    colours = _colours(groups)
    shown = [group for group in groups if group.curves and (group.speed or not minutes)]
    figure, panels = _panels(list(dict.fromkeys(group.task for group in shown)), 3.4, _legend(groups))
    for group in shown:
        axes, (steps, values) = panels[group.task], common_curve(group.curves)
        colour = colours[group.label]
        mean = interquartile_mean(values)
        if minutes and group.speed:
            steps = (group.teaching + steps / group.speed) / 60
        axes.plot(steps, mean, _mark(group), linestyle=_line(group), color=colour, markersize=3, linewidth=1.5)
        band = bootstrap([values], repeats=BAND_REPEATS)
        if band is not None:
            axes.fill_between(steps, *band, color=colour, alpha=0.15, linewidth=0)
    for axes in panels.values():
        axes.set(xlabel="minutes of training" if minutes else "environment steps", ylabel="return of an evaluation")
    return figure


def returns(groups: Sequence[Group]) -> Figure:
    """Final evaluation: each seed a pale mark, interquartile mean and interval; grouped by what is seen."""
    colours = _colours(groups)
    members: dict[str, list[Group]] = {}
    for group in groups:
        if group.scores:
            members.setdefault(group.task, []).append(group)
    figure, panels = _panels(list(members), 1.2 + 0.3 * max(map(len, members.values())), _legend(groups))
    for task, axes in panels.items():
        shown = members[task]
        for place, group in enumerate(shown):
            _score(axes, group, place, colours[group.label])
            if place and group.sees != shown[place - 1].sees:
                axes.axhline(place - 0.5, color="black", linewidth=1)
        axes.set_yticks(range(len(shown)), [f"{group.label} ({group.sees})" for group in shown], fontsize=8)
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlabel("return")
    return figure


def _score(axes: Axes, group: Group, place: int, colour: str) -> None:
    scores, ends = group.scores, interval([group.scores])
    axes.plot(scores, [place] * len(scores), _mark(group), color=colour, alpha=0.35)
    if ends is not None:
        axes.plot(ends, [place, place], color=colour, linewidth=2.5)
    mean = float(interquartile_mean(np.array(scores)))
    axes.plot(mean, place, _mark(group), color=colour, markersize=8, markeredgecolor="black")


def robustness(groups: Sequence[Group], rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Ratio under each disturbance, a bar for each algorithm with the range of its seeds; the paper's as a line.

    Args:
        groups: All, for their colours.
        rows: Of the robustness table.
    """
    colours, rows = _colours(groups), [row for row in rows if row["ratio"] is not None]
    who = list(dict.fromkeys(row["algo"] for row in rows))
    cases = {task: list(dict.fromkeys(row["case"] for row in rows if row["task"] == task)) for task in _tasks(rows)}
    sights = {row["algo"]: row["sees"] for row in rows}
    handles = [Line2D([], [], color=colours[algo], linewidth=6, label=f"{algo} (sees {sights[algo]})") for algo in who]
    handles.append(Line2D([], [], color="black", linewidth=2.5, label="the paper's CFP"))
    most = max(map(len, cases.values()))
    figure, panels = _panels(list(cases), 1.0 + most * max(0.4, 0.16 * len(who)), handles)
    thick = 0.8 / len(who)
    for row in rows:
        axes = panels[row["task"]]
        place = cases[row["task"]].index(row["case"]) + (who.index(row["algo"]) - (len(who) - 1) / 2) * thick
        reach = [[row["ratio"] - row["low"]], [row["high"] - row["ratio"]]]
        axes.barh(place, row["ratio"], thick, xerr=reach, color=colours[row["algo"]], error_kw={"linewidth": 1})
        if row["paper"] is not None:
            axes.plot([row["paper"]] * 2, [place - thick / 2, place + thick / 2], color="black", linewidth=2.5)
    for task, axes in panels.items():
        axes.axvline(1, color="black", linewidth=1, linestyle="--")
        axes.set_yticks(
            range(len(cases[task])), [case.replace(" dropout", "\ndropout") for case in cases[task]], fontsize=8
        )
        axes.set_ylim(len(cases[task]) - 0.5, -0.5)
        axes.set_xlabel("ratio to the unperturbed return")
    return figure


def _tasks(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(row["task"] for row in rows))
