"""Writes the tables and the figure of measured returns from the committed CSV and JSON files, next to the paper's."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from task_pages import PAGES, write

import dittogym
from baselines.compare import paper
from baselines.compare.final_evaluation import FinalEvaluation
from baselines.compare.plots import final_returns
from baselines.compare.results import Group
from baselines.leaderboard.__main__ import rankings
from baselines.leaderboard.submission import read_submissions
from cfp import weights
from dittogym.tasks import headline

DOCS = Path(__file__).resolve().parent
OBSERVES = ("image", "state", "simulator", "nothing")
PRETRAINED = weights.shipped()
Row = dict[str, str]


def read(name: str) -> list[Row]:
    """Rows of a CSV file of this folder."""
    with (DOCS / name).open(newline="") as file:
        return list(csv.DictReader(file))


def policies() -> list[Row]:
    """Rows of `policies.csv` in the form of `returns.csv`: zero and random actions, and trained policies."""
    rows = []
    for row in read("policies.csv"):
        name = row["policy"]
        observes = "nothing" if name in ("zero", "random") else "image"
        label = f"{name} actions" if observes == "nothing" else f'`cfp.load("{name}")`' if name in PRETRAINED else name
        rows.append(row | {"algorithm": label, "observes": observes, "name": name})
    return rows


def shape_match_rows() -> list[Row]:
    """Rows of the comparison of all algorithms on SHAPE MATCH."""
    return [
        {
            "task": "shapematch",
            "particles": "lite",
            "algorithm": f"`{row['algorithm']}`",
            "observes": row["sees"],
            "episodes": row["success"].rpartition(" ")[2],
            "mean": row["return, lite (mean of seeds)"],
            "success": row["success"],
        }
        for row in read("compare-shapematch.csv")
    ]


def number(text: str) -> str:
    """A return or a count with thousands separated."""
    return f"{float(text.replace(',', '')):,.0f}" if text else ""


def spread(row: Row) -> str:
    """What is known about the spread of the episodes: lowest and highest, or standard deviation."""
    if row.get("lowest") and row["lowest"] != row["highest"]:
        return f" ({number(row['lowest'])} to {number(row['highest'])})"
    return f" ± {number(row['std'])}" if float(row.get("std") or 0) else ""


def success(row: Row) -> str:
    """Share of successful episodes."""
    count, _, total = (row.get("success") or "").partition(" of ")
    return f"{float(count) / float(total or 1):.0%}" if count else ""


def exceeds(row: Row, value: float) -> bool:
    """Whether the lower end of the 95 % interval of a mean, or else the lowest episode, is above a value."""
    if not row["std"]:
        return float(row["lowest"]) > value
    return float(row["mean"]) - 1.96 * float(row["std"]) / int(row["episodes"]) ** 0.5 > value


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def shipped(task: str, name: str) -> Row:
    """The full evaluation of a task's own policy, or of `zero` or `random`, with the most episodes."""
    found = [row for row in policies() if (row["task"], row["name"], row["particles"]) == (task, name, "full")]
    return max(found, key=lambda row: int(row["episodes"]))


def overview() -> str:
    """All tasks: untrained and shipped policies, and the paper's."""
    rows = []
    for training in read("training.csv"):
        task = training["task"]
        ours, (theirs, _) = shipped(task, task), paper.CURVES[task][0]
        value = number(ours["mean"])
        rows.append(
            [
                f"[{headline(task)[0]}](generated/{task}.md)",
                *(number(shipped(task, name)["mean"]) for name in ("zero", "random")),
                f"**{value}**" if exceeds(ours, theirs) else value,
                success(ours),
                number(str(theirs)),
                number(training["steps"]),
                f"{paper.STEPS[task]:,}",
                training["minutes"],
            ]
        )
    ours = ("This package", "Success")
    return markdown(("Task", "Zero", "Random", *ours, "Paper's CFP", "Steps", "Paper's steps", "Minutes"), rows)


def planning() -> str:
    """Returns of planners and optimised action sequences with full particles."""
    rows = [row for row in read("returns.csv") if row["particles"] == "full" and row["minutes"]]
    rows = [row for row in rows if row["observes"] in ("simulator", "nothing")]
    return markdown(
        ("Task", "Algorithm", "Episodes", "Return", "Paper's CFP", "Steps", "Minutes"),
        (
            [
                f"[{headline(row['task'])[0]}](generated/{row['task']}.md)",
                row["algorithm"],
                row["episodes"],
                number(row["mean"]) + spread(row),
                number(str(paper.CURVES[row["task"]][0][0])),
                number(row["steps"]),
                row["minutes"],
            ]
            for row in rows
        ),
    )


def of_task(task: str) -> str:
    """Every measured return of a task, then those of the paper; by particles and by what the policy observes."""
    rows = [row for row in (*policies(), *read("returns.csv"), *shape_match_rows()) if row["task"] == task]
    rows.sort(key=lambda row: (row["particles"], OBSERVES.index(row["observes"]), -float(row["mean"])))
    ours = (
        [
            row["algorithm"],
            row["observes"],
            row["particles"],
            row["episodes"],
            number(row["mean"]) + spread(row),
            success(row),
        ]
        for row in rows
    )
    columns = ("Algorithm", "Observes", "Particles", "Episodes", "Return", "Success")
    published = zip(paper.COLUMNS, paper.CURVES[task], strict=True)
    names = [f"`{name}`" for name, _ in published]
    values = [f"{mean:,.0f} ± {band:,.0f}" for mean, band in paper.CURVES[task]]
    return (
        markdown(columns, ours)
        + f"\nThe paper's training returns after {paper.STEPS[task]:,} steps with full particles, three seeds each:\n\n"
        + markdown(names, [values])
    )


def comparison_figure(path: Path) -> None:
    """Draw the final returns of all algorithms on SHAPE MATCH, as the report of a comparison does."""
    rows = sorted(read("compare-shapematch.csv"), key=lambda row: OBSERVES.index(row["sees"]))
    groups = []
    for row in rows:
        both = row["lowest seed"], row["highest seed"]
        scores = both if all(both) else (row["return, lite (mean of seeds)"],)
        found = [FinalEvaluation((float(score),), None, None, {}, True) for score in scores]
        groups.append(Group(headline("shapematch")[0], row["sees"], row["algorithm"], None, found, [], []))
    drawing = final_returns(groups)
    FigureCanvasSVG(drawing)
    drawing.savefig(path, metadata={"Date": None})


def leaderboard() -> str:
    """The rankings of the committed submissions."""
    submissions = read_submissions(sorted((DOCS / "leaderboard").glob("*.json")))
    tables = (replace(table, title=headline(table.name)[0], description="") for table in rankings(submissions))
    return "\n\n".join(table.to_markdown() for table in tables) + "\n"


def normalised(task: str, name: str, key: str) -> float:
    """A number of the evaluation of a policy on a scale where the paper's resting robot has 0 and its CFP 1."""
    return paper.normalised(task, float(shipped(task, name)[key]))


def figure(path: Path) -> None:
    """Draw the normalised returns of all tasks."""
    tasks = [row["task"] for row in read("training.csv")]
    drawing = Figure(figsize=(7.2, 4.2), layout="constrained")
    FigureCanvasSVG(drawing)
    axis = drawing.subplots()
    axis.axvline(0, color="0.8", zorder=0)
    axis.axvline(1, color="#b03a2e", linestyle="--", zorder=0)
    for place, task in enumerate(reversed(tasks)):
        for name, colour in (("zero", "0.65"), ("random", "0.35")):
            axis.plot(normalised(task, name, "mean"), place, "|", ms=11, mew=2, color=colour)
        low, mean, high = (normalised(task, task, key) for key in ("lowest", "mean", "highest"))
        axis.plot((low, high), (place, place), color="#26798c", lw=2)
        axis.plot(mean, place, "o", ms=8, color="#26798c")
    axis.set_yticks(range(len(tasks)), [headline(task)[0] for task in reversed(tasks)])
    axis.set_xlabel("return; 0: a robot at rest, 1: the paper's CFP")
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.tick_params(axis="y", length=0)
    entries = [
        Line2D([], [], marker="o", ms=8, lw=2, color="#26798c", label="this package, lowest to highest episode"),
        Line2D([], [], color="#b03a2e", linestyle="--", label="paper's CFP"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color="0.65", label="zero actions"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color="0.35", label="random actions"),
    ]
    drawing.legend(handles=entries, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    drawing.savefig(path, metadata={"Date": None})


def rewards_figure(path: Path) -> None:
    """Draw how each change of the learner ``sac`` helps in RUN: the actor in training, and its averaged weights."""
    rows = read("rewards-run.csv")
    drawing = Figure(figsize=(7.2, 3.6), layout="constrained")
    FigureCanvasSVG(drawing)
    axes = drawing.subplots(1, 2, sharey=True)
    changes = list(dict.fromkeys(row["change"] for row in rows))
    for axis, column, title in zip(axes, ("actor", "averaged"), ("actor in training", "averaged weights"), strict=True):
        axis.axhline(2381, color="0.65", zorder=0)
        axis.axhline(8650, color="#b03a2e", linestyle="--", zorder=0)
        for index, change in enumerate(changes):
            for seed, line in (("0", "-"), ("1", ":")):
                own = [row for row in rows if (row["change"], row["seed"]) == (change, seed) and row[column]]
                points = [int(row["steps"]) for row in own], [float(row[column]) for row in own]
                axis.plot(*points, line, marker="o", ms=4, color=f"C{index}", label=change if seed == "0" else None)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("environment steps")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("return in RUN")
    drawing.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    drawing.savefig(path, metadata={"Date": None})


def rewards_tasks_figure(path: Path) -> None:
    """Draw evaluations of the learner ``sac`` in all tasks, a line for each seed, and a diamond for the best policy."""
    rows = read("rewards-tasks.csv")
    drawing = Figure(figsize=(7.2, 4.4), layout="constrained")
    FigureCanvasSVG(drawing)
    for axis, task in zip(drawing.subplots(2, 4).flat, dict.fromkeys(row["task"] for row in rows), strict=True):
        axis.axhline(float(shipped(task, "zero")["mean"]), color="0.65", zorder=0)
        axis.axhline(paper.CURVES[task][0][0], color="#b03a2e", linestyle="--", zorder=0)
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
        axis.spines[["top", "right"]].set_visible(False)
    seeds = [Line2D([], [], marker="o", ms=3, color=f"C{seed}", label=f"seed {seed}") for seed in range(5)]
    drawing.legend(handles=seeds, loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    drawing.supxlabel("thousands of environment steps", fontsize=9)
    drawing.supylabel("return", fontsize=9)
    drawing.savefig(path, metadata={"Date": None})


def rewards_ablation_figure(path: Path) -> None:
    """Draw what the learner ``sac`` returns with each option left out: mean and range of the best policy."""
    rows = [row for row in read("rewards-ablation.csv") if row["episodes"]]
    drawing = Figure(figsize=(7.2, 3.6), layout="constrained")
    FigureCanvasSVG(drawing)
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
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        axis.set_yticks(range(len(changes)), reversed(changes))
    drawing.savefig(path, metadata={"Date": None})


def rewards_stages_figure(path: Path) -> None:
    """Draw evaluations of the learner ``sac`` with both stages or one, and of others: mean and range of the seeds."""
    rows = read("rewards-stages.csv")
    drawing = Figure(figsize=(7.2, 3.2), layout="constrained")
    FigureCanvasSVG(drawing)
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
                axis.plot(steps, mean, marker="o", ms=3, lw=1.5, color=f"C{index}", label=algorithm)
                axis.fill_between(
                    steps, list(map(min, means)), list(map(max, means)), color=f"C{index}", alpha=0.15, lw=0
                )
        axis.set(xlabel="environment steps", ylabel=f"return in {headline(task)[0]}", xlim=(0, None))
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(fontsize=8, frameon=False)
    drawing.savefig(path, metadata={"Date": None})


def ablation_figure(path: Path) -> None:
    """Draw learning curves of the learner ``analytic`` on SHAPE MATCH, one panel for each option that is changed."""
    rows = read("analytic-shapematch.csv")
    parts = list(dict.fromkeys(row["part"] for row in rows if row["part"] != "default"))
    drawing = Figure(figsize=(7.2, 5.8), layout="constrained")
    FigureCanvasSVG(drawing)
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
        axis.spines[["top", "right"]].set_visible(False)
        above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 2}
        axis.legend(title=part, title_fontsize=9, fontsize=7, frameon=False, **above)
    drawing.supxlabel("environment steps", fontsize=10)
    drawing.supylabel("return in SHAPE MATCH", fontsize=10)
    drawing.savefig(path, metadata={"Date": None})


def ablation() -> str:
    """Final returns of the same runs."""
    rows = [row for row in read("analytic-shapematch.csv") if row["final"]]
    found = {
        (row["part"], row["value"], row["seed"]): f"{row['final']} ({row['lowest']} to {row['highest']})"
        for row in rows
    }
    names = [
        (row["part"], row["value"]) for row in sorted(rows, key=lambda row: -int(row["final"])) if row["seed"] == "0"
    ]
    return markdown(
        ("Changed", "To", "Return, seed 0", "Return, seed 1"),
        ([part, value, *(found.get((part, value, seed), "") for seed in "01")] for part, value in names),
    )


def write_results() -> None:
    """Write everything into the folder of the generated pages."""
    PAGES.mkdir(exist_ok=True)
    write(PAGES / "returns.md", overview())
    write(PAGES / "planning.md", planning())
    write(PAGES / "leaderboard.md", leaderboard())
    for task in dittogym.TASKS:
        write(PAGES / f"returns-{task}.md", of_task(task))
    figure(PAGES / "returns.svg")
    comparison_figure(PAGES / "comparison.svg")
    rewards_figure(PAGES / "rewards.svg")
    rewards_tasks_figure(PAGES / "rewards-tasks.svg")
    rewards_ablation_figure(PAGES / "rewards-ablation.svg")
    rewards_stages_figure(PAGES / "rewards-stages.svg")
    ablation_figure(PAGES / "ablation.svg")
    write(PAGES / "ablation.md", ablation())
