"""The figures of a comparison. Colours tell algorithms apart, lines and markers what they observe."""

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from baselines.compare.results import Group
from baselines.compare.stats import align_curves, bootstrap_interval, interquartile_mean

COLOURS = (
    "#0173b2 #de8f05 #029e73 #d55e00 #cc78bc #ca9161 #56b4e9 #949494 #8c564b #bcbd22 #17becf #7f3c8d #e377c2 #1b5e20"
).split()
#: Line and marker by what is observed.
LINES: dict[str, tuple[Any, str]] = {
    "image": ("-", "o"),
    "state": ("--", "s"),
    "simulator": (":", "^"),
    "nothing": ((0, (1, 4)), "v"),
}
BAND_RESAMPLES = 2_000
#: Keywords of matplotlib's lines, by algorithm and observation.
Styles = dict[tuple[str, str], dict[str, Any]]


def _styles(groups: Sequence[Group]) -> Styles:
    labels, styles = list(dict.fromkeys(group.label for group in groups)), Styles()
    for group in groups:
        (line, marker), colour = LINES[group.sees], COLOURS[labels.index(group.label) % len(COLOURS)]
        styles[group.label, group.sees] = {"color": colour, "linestyle": line, "marker": marker}
    return styles


def _panels(tasks: Sequence[str], height: float) -> tuple[Figure, dict[str, Axes]]:
    """A figure with a panel of some height in inches for each task."""
    columns = min(len(tasks), 3)
    rows = math.ceil(len(tasks) / columns)
    size = (max(6.5, 4.6 * columns), height * rows + 0.2)
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    panels = {task: figure.add_subplot(rows, columns, index + 1) for index, task in enumerate(tasks)}
    for task, axes in panels.items():
        axes.set_title(task)
        axes.grid(alpha=0.3)
    return figure, panels


def _add_legend(figure: Figure, styles: Styles) -> None:
    """Let the figure grow by a legend below its panels, whose lines are long enough to tell dashes apart."""
    handles = [Line2D([], [], **style, label=f"{label} (observes {seen})") for (label, seen), style in styles.items()]
    columns = max(2, int(figure.get_figwidth() / 2.6))
    figure.set_figheight(figure.get_figheight() + 0.3 * math.ceil(len(handles) / columns))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=columns, fontsize=9, frameon=False, handlelength=3.5
    )


def learning_curves(groups: Sequence[Group], *, minutes: bool = False) -> Figure:
    """Evaluations during training: interquartile mean over seeds and its 95 % band, over steps or time."""
    styles = _styles(groups)
    shown = [group for group in groups if group.curves and (group.speed or not minutes)]
    figure, panels = _panels(list(dict.fromkeys(group.task for group in shown)), 3.4)
    for group in shown:
        axes, style = panels[group.task], styles[group.label, group.sees]
        steps, values = align_curves(group.curves)
        if minutes and group.speed:
            steps = (group.mean_cost("teacher_seconds") + steps / group.speed) / 60
        axes.plot(steps, interquartile_mean(values), **style, markersize=3, linewidth=1.5)
        if len(steps) and (band := bootstrap_interval([values], BAND_RESAMPLES)) is not None:
            axes.fill_between(steps, *band, color=style["color"], alpha=0.15, linewidth=0)
    for axes in panels.values():
        axes.set(xlabel="minutes of training" if minutes else "environment steps", ylabel="return of an evaluation")
    _add_legend(figure, {(group.label, group.sees): styles[group.label, group.sees] for group in shown})
    return figure


def final_returns(groups: Sequence[Group]) -> Figure:
    """Final evaluation: a pale mark for each seed, interquartile mean and interval; a line between observations."""
    styles = _styles(groups)
    members: dict[str, list[Group]] = {}
    for group in groups:
        if group.scores:
            members.setdefault(group.task, []).append(group)
    figure, panels = _panels(list(members), 1.2 + 0.3 * max(map(len, members.values())))
    for task, axes in panels.items():
        shown = members[task]
        for place, group in enumerate(shown):
            style, (low, high) = styles[group.label, group.sees] | {"linestyle": "none"}, group.interval
            axes.plot(group.scores, [place] * len(group.scores), **style, alpha=0.35)
            if low is not None and high is not None:
                axes.plot([low, high], [place, place], color=style["color"], linewidth=2.5)
            axes.plot(interquartile_mean(group.scores), place, **style, markersize=8, markeredgecolor="black")
            if place and group.sees != shown[place - 1].sees:
                axes.axhline(place - 0.5, color="black", linewidth=1)
        axes.set_yticks(range(len(shown)), [f"{group.label} ({group.sees})" for group in shown], fontsize=8)
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlabel("return")
    return figure
