"""Tables of measured returns from the committed CSV and JSON files, next to the paper's."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from task_pages import PAGES, write

import dittogym
from baselines.compare import paper
from baselines.leaderboard.__main__ import rankings
from baselines.leaderboard.submission import read_submissions
from cfp import policy as weights
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


def leaderboard() -> str:
    """The rankings of the committed submissions."""
    submissions = read_submissions(sorted((DOCS / "leaderboard").glob("*.json")))
    tables = (replace(table, title=headline(table.name)[0], description="") for table in rankings(submissions))
    return "\n\n".join(table.to_markdown() for table in tables) + "\n"


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


def write_tables() -> None:
    """Write all tables into the folder of the generated pages."""
    PAGES.mkdir(exist_ok=True)
    write(PAGES / "returns.md", overview())
    write(PAGES / "planning.md", planning())
    write(PAGES / "leaderboard.md", leaderboard())
    write(PAGES / "ablation.md", ablation())
    for task in dittogym.TASKS:
        write(PAGES / f"returns-{task}.md", of_task(task))
