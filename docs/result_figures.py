"""Figures of measured returns from the committed CSV files, next to the paper's."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from result_tables import OBSERVES, read, shipped
from task_pages import PAGES

from baselines.compare import paper
from dittogym.tasks import headline

#: Colours of the paper's returns, of this package's, and of zero and random actions.
PAPER, OURS, ZERO, RANDOM = "#b03a2e", "#26798c", "0.65", "0.35"


def save(drawing: Figure, path: Path) -> None:
    """Write a figure without frames, and without a date, so that it only changes with the data."""
    for axis in drawing.axes:
        axis.spines[["top", "right"]].set_visible(False)
    drawing.savefig(path, metadata={"Date": None})


def comparison_figure(path: Path) -> None:
    """Draw the final returns of all algorithms on SHAPE MATCH: the mean of the seeds, and their range."""
    rows = sorted(read("compare-shapematch.csv"), key=lambda row: OBSERVES.index(row["sees"]))
    drawing = Figure(figsize=(7.2, 0.9 + 0.3 * len(rows)), layout="constrained")
    axis = drawing.subplots()
    for place, row in enumerate(rows):
        colour, both = f"C{OBSERVES.index(row['sees'])}", (row["lowest seed"], row["highest seed"])
        if all(both):
            axis.plot([float(value) for value in both], (place, place), color=colour, lw=2)
        axis.plot(float(row["return, lite (mean of seeds)"]), place, "o", ms=8, color=colour)
    axis.set_yticks(range(len(rows)), [f"{row['algorithm']} ({row['sees']})" for row in rows], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("return in SHAPE MATCH")
    axis.grid(alpha=0.3)
    save(drawing, path)


def normalised(task: str, name: str, key: str) -> float:
    """A number of the evaluation of a policy on a scale where the paper's resting robot has 0 and its CFP 1."""
    return paper.normalised(task, float(shipped(task, name)[key]))


def returns_figure(path: Path) -> None:
    """Draw the normalised returns of all tasks."""
    tasks = [row["task"] for row in read("training.csv")]
    drawing = Figure(figsize=(7.2, 4.2), layout="constrained")
    axis = drawing.subplots()
    axis.axvline(0, color="0.8", zorder=0)
    axis.axvline(1, color=PAPER, linestyle="--", zorder=0)
    for place, task in enumerate(reversed(tasks)):
        for name, colour in (("zero", ZERO), ("random", RANDOM)):
            axis.plot(normalised(task, name, "mean"), place, "|", ms=11, mew=2, color=colour)
        low, mean, high = (normalised(task, task, key) for key in ("lowest", "mean", "highest"))
        axis.plot((low, high), (place, place), color=OURS, lw=2)
        axis.plot(mean, place, "o", ms=8, color=OURS)
    axis.set_yticks(range(len(tasks)), [headline(task)[0] for task in reversed(tasks)])
    axis.set_xlabel("return; 0: a robot at rest, 1: the paper's CFP")
    axis.spines["left"].set_visible(False)
    axis.tick_params(axis="y", length=0)
    entries = [
        Line2D([], [], marker="o", ms=8, lw=2, color=OURS, label="this package, lowest to highest episode"),
        Line2D([], [], color=PAPER, linestyle="--", label="paper's CFP"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color=ZERO, label="zero actions"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color=RANDOM, label="random actions"),
    ]
    drawing.legend(handles=entries, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    save(drawing, path)


def rewards_figure(path: Path) -> None:
    """Draw how each change of the learner ``sac`` helps in RUN: the actor in training, and its averaged weights."""
    rows = read("rewards-run.csv")
    drawing = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = drawing.subplots(1, 2, sharey=True)
    changes = list(dict.fromkeys(row["change"] for row in rows))
    for axis, column, title in zip(axes, ("actor", "averaged"), ("actor in training", "averaged weights"), strict=True):
        axis.axhline(float(shipped("run", "zero")["mean"]), color=ZERO, zorder=0)
        axis.axhline(paper.CURVES["run"][0][0], color=PAPER, linestyle="--", zorder=0)
        for index, change in enumerate(changes):
            for seed, line in (("0", "-"), ("1", ":")):
                own = [row for row in rows if (row["change"], row["seed"]) == (change, seed) and row[column]]
                points = [int(row["steps"]) for row in own], [float(row[column]) for row in own]
                axis.plot(*points, line, marker="o", ms=4, color=f"C{index}", label=change if seed == "0" else None)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("environment steps")
    axes[0].set_ylabel("return in RUN")
    drawing.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    save(drawing, path)


def rewards_tasks_figure(path: Path) -> None:
    """Draw evaluations of the learner ``sac`` in all tasks, a line for each seed, and a diamond for the best policy."""
    rows = read("rewards-tasks.csv")
    drawing = Figure(figsize=(7.2, 4.4), layout="constrained")
    for axis, task in zip(drawing.subplots(2, 4).flat, dict.fromkeys(row["task"] for row in rows), strict=True):
        axis.axhline(float(shipped(task, "zero")["mean"]), color=ZERO, zorder=0)
        axis.axhline(paper.CURVES[task][0][0], color=PAPER, linestyle="--", zorder=0)
        for seed in dict.fromkeys(row["seed"] for row in rows if row["task"] == task):
            own = [row for row in rows if (row["task"], row["seed"]) == (task, seed)]
            steps = [int(row["steps"]) / 1000 for row in own if row["steps"]]
            means = [float(row["mean"]) for row in own]
            axis.plot(steps, means[:-1], marker="o", ms=3, color=f"C{seed}")
            axis.plot(1.06 * steps[-1], means[-1], "D", ms=4, color=f"C{seed}")
        axis.set_xlim(left=0)
        axis.xaxis.set_major_locator(MultipleLocator(10))
        axis.set_title(headline(task)[0], fontsize=9)
        axis.tick_params(labelsize=8)
    seeds = dict.fromkeys(row["seed"] for row in rows)
    handles = [Line2D([], [], marker="o", ms=3, color=f"C{seed}", label=f"seed {seed}") for seed in sorted(seeds)]
    drawing.legend(handles=handles, loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    drawing.supxlabel("thousands of environment steps", fontsize=9)
    drawing.supylabel("return", fontsize=9)
    save(drawing, path)


def rewards_ablation_figure(path: Path) -> None:
    """Draw what the learner ``sac`` returns with each option left out: mean and range of the best policy."""
    rows = [row for row in read("rewards-ablation.csv") if row["episodes"]]
    drawing = Figure(figsize=(7.2, 3.6), layout="constrained")
    changes = list(dict.fromkeys(row["change"] for row in rows))
    for axis, task in zip(drawing.subplots(1, 2, sharey=True), ("run", "shapematch"), strict=True):
        for row in rows:
            if row["task"] == task:
                place, seed = len(changes) - 1 - changes.index(row["change"]), int(row["seed"])
                low, mean, high = (float(row[column]) for column in ("lowest", "mean", "highest"))
                axis.plot((low, high), (place - 0.25 * seed,) * 2, color=f"C{seed}", lw=1.5)
                axis.plot(mean, place - 0.25 * seed, "o", ms=5, color=f"C{seed}")
        axis.set_title(headline(task)[0], fontsize=10)
        axis.set_xlabel("return, lowest to highest of ten episodes", fontsize=9)
        axis.tick_params(labelsize=8)
        axis.set_yticks(range(len(changes)), reversed(changes))
    save(drawing, path)


def rewards_stages_figure(path: Path) -> None:
    """Draw evaluations of the learner ``sac`` with both stages or one, and of others: mean and range of the seeds."""
    rows = read("rewards-stages.csv")
    drawing = Figure(figsize=(7.2, 3.2), layout="constrained")
    algorithms = list(dict.fromkeys(row["algorithm"] for row in rows))
    for axis, task in zip(drawing.subplots(1, 2), ("shapematch", "run"), strict=True):
        for index, algorithm in enumerate(algorithms):
            own = [row for row in rows if (row["task"], row["algorithm"]) == (task, algorithm)]
            at: dict[float, list[float]] = {}
            for row in own:
                at.setdefault(float(row["steps"]), []).append(float(row["mean"]))
            if own:
                steps, means = list(at), list(at.values())
                mean = [sum(values) / len(values) for values in means]
                axis.plot(steps, mean, marker="o", ms=3, lw=1.5, color=f"C{index}")
                axis.fill_between(
                    steps, list(map(min, means)), list(map(max, means)), color=f"C{index}", alpha=0.15, lw=0
                )
        axis.set(xlabel="environment steps", ylabel=f"return in {headline(task)[0]}", xlim=(0, None))
    handles = [Line2D([], [], marker="o", ms=3, color=f"C{k}", label=name) for k, name in enumerate(algorithms)]
    drawing.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8, frameon=False)
    save(drawing, path)


def ablation_figure(path: Path) -> None:
    """Draw learning curves of the learner ``analytic`` on SHAPE MATCH, one panel for each option that is changed."""
    rows = read("analytic-shapematch.csv")
    parts = list(dict.fromkeys(row["part"] for row in rows if row["part"] != "default"))
    drawing = Figure(figsize=(7.2, 5.8), layout="constrained")
    for axis, part in zip(drawing.subplots(2, 3, sharex=True, sharey=True).flat, parts, strict=True):
        for value in dict.fromkeys(row["value"] for row in rows if row["part"] in (part, "default")):
            colour = "0.3" if value == "default" else None
            for seed, style in (("0", "-"), ("1", ":")):
                own = [row for row in rows if (row["value"], row["seed"]) == (value, seed)]
                own = [row for row in own if row["part"] in (part, "default")]
                points = [int(row["steps"]) for row in own], [float(row["evaluated"]) for row in own]
                label = value if seed == "0" else None
                (line,) = axis.plot(*points, style, marker="o", ms=3, lw=1.2, label=label, color=colour)
                colour = line.get_color()
        axis.set_ylim(0, 420)
        above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 2}
        axis.legend(title=part, title_fontsize=9, fontsize=7, frameon=False, **above)
    drawing.supxlabel("environment steps", fontsize=10)
    drawing.supylabel("return in SHAPE MATCH", fontsize=10)
    save(drawing, path)


def write_figures() -> None:
    """Write all figures into the folder of the generated pages."""
    PAGES.mkdir(exist_ok=True)
    returns_figure(PAGES / "returns.svg")
    comparison_figure(PAGES / "comparison.svg")
    rewards_figure(PAGES / "rewards.svg")
    rewards_tasks_figure(PAGES / "rewards-tasks.svg")
    rewards_ablation_figure(PAGES / "rewards-ablation.svg")
    rewards_stages_figure(PAGES / "rewards-stages.svg")
    ablation_figure(PAGES / "ablation.svg")
