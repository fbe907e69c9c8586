"""The report of a comparison: raw rows, one table, one picture, and a page that shows both."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, get_args

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from baselines.compare.evaluation import Protocol, read_evaluation
from baselines.compare.plan import PlannedRun
from cfp.evaluation.page import STYLE, write_figure
from cfp.evaluation.returns import PLAN, REPLAYED, t_interval
from cfp.files import write_text
from cfp.learner import Sees
from cfp.tables import Table, columns, csv_text, read_table

#: Steps (N,), increasing, and mean returns (N,) of the evaluations during a training.
Curve = tuple[np.ndarray, np.ndarray]
SEES = get_args(Sees)
LINES = dict(zip(SEES, ("-", "--", ":", "-."), strict=True))
RAW = ("task", "observes", "algorithm", "seed", "layout", "return", "success")


def align(curves: Sequence[Curve]) -> Curve:
    """Interpolate curves linearly onto the steps (T,) that all of them cover, if any: values (runs, T)."""
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.unique(np.concatenate([steps for steps, _ in curves]))
    grid = grid[(grid >= first) & (grid <= last)]
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in curves])


@dataclass(frozen=True)
class RunResult:
    """What the folder of a run holds."""

    run: PlannedRun
    evaluation: dict[str, Any] | None  # None if it is not complete
    curve: Curve

    @property
    def state(self) -> str:
        """One of finished, failed, not evaluated, not finished, not begun."""
        if self.run.error:
            return "failed"
        if self.run.trained and self.run.record:
            return "finished" if self.evaluation else "not evaluated"
        return "not finished" if self.run.record else "not begun"

    @property
    def score(self) -> float:
        """Mean return of the evaluated policy."""
        assert self.evaluation is not None
        return float(np.mean(self.evaluation["returns"]))


def read_result(run: PlannedRun, protocol: Protocol) -> RunResult:
    """Read the folder of a run; of two evaluations at the same step, as at a handover, the later one counts."""
    rows = read_table(run.folder / "evaluations.csv", ("step", "mean"))
    values = sorted({float(row["step"]): float(row["mean"]) for row in rows}.items())
    steps, means = np.array(values).reshape(-1, 2).T
    return RunResult(run, read_evaluation(run, protocol), (steps, means))


def raw_rows(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """A row for each episode of the evaluations."""
    rows = []
    for result in results:
        found, run = result.evaluation, result.run
        if found is not None:
            about = {"task": run.task, "observes": found["observes"], "algorithm": run.label, "seed": run.seed}
            episodes = zip(found["layouts"], found["returns"], found["successes"], strict=True)
            rows += [about | dict(zip(RAW[4:], episode, strict=True)) for episode in episodes]
    return rows


def grouped(results: Sequence[RunResult]) -> dict[tuple[str, str], list[RunResult]]:
    """Evaluated runs by task and algorithm: tasks in their order, in each those that observe the same together."""
    groups: dict[tuple[str, str], list[RunResult]] = {}
    for result in results:
        if result.evaluation is not None:
            groups.setdefault((result.run.task, result.run.label), []).append(result)
    tasks = list(dict.fromkeys(task for task, _ in groups))

    def place(group: tuple[tuple[str, str], list[RunResult]]) -> tuple[int, int, float]:
        (task, _), members = group
        mean = float(np.mean([member.score for member in members]))
        return tasks.index(task), SEES.index(observes(members)), -mean

    return dict(sorted(groups.items(), key=place))


def observes(group: Sequence[RunResult]) -> str:
    """What the policies of an algorithm observe."""
    assert group[0].evaluation is not None
    return str(group[0].evaluation["observes"])


def scores_by_name(group: Sequence[RunResult]) -> dict[str, dict[int, float]]:
    """Scores by seed under each name that an algorithm is shown by: a plan has two, see `REPLAYED`."""
    label, scores = group[0].run.label, {result.run.seed: result.score for result in group}
    evaluations = {result.run.seed: result.evaluation or {} for result in group}
    plans = {seed: found["own_layout"] for seed, found in evaluations.items() if found.get("own_layout") is not None}
    return {f"{label}: {PLAN}": plans, f"{label}: {REPLAYED}": scores} if plans else {label: scores}


def make_table(results: Sequence[RunResult], first: str, protocol: Protocol) -> Table:
    """The table: an algorithm on a task in each row, with its difference to the ``first`` algorithm."""
    rows, groups = [], grouped(results)
    for (task, label), group in groups.items():
        found = [result.evaluation for result in group if result.evaluation is not None]
        successes = [success for each in found for success in each["successes"] if success is not None]
        ends = [result.curve[0][-1] for result in group if len(result.curve[0])]
        minutes = [result.run.record["seconds"] / 60 for result in group if "seconds" in result.run.record]
        for name, scores in scores_by_name(group).items():
            row: dict[str, Any] = {"task": task, "observes": observes(group), "algorithm": name, "seeds": len(scores)}
            row |= {"mean": float(np.mean([*scores.values()])), "interval": t_interval([*scores.values()])}
            row |= {"steps": int(max(ends)) if ends else None, "minutes": float(np.mean(minutes)) if minutes else None}
            rows.append(row)
            if name == f"{label}: {PLAN}":  # one episode for each seed, which no other algorithm plays
                row["episodes"] = len(scores)
                continue
            row["episodes"] = sum(len(each["returns"]) for each in found)
            row["success"] = float(np.mean(successes)) if successes else None
            if label != first and (task, first) in groups:
                theirs = {result.run.seed: result.score for result in groups[task, first]}
                mine = dict.fromkeys(theirs, *scores.values()) if group[0].run.reference else scores
                if groups[task, first][0].run.reference:
                    theirs = dict.fromkeys(mine, *theirs.values())
                if differences := [mine[seed] - theirs[seed] for seed in sorted(mine.keys() & theirs.keys())]:
                    row |= {"difference": float(np.mean(differences)), "difference_interval": t_interval(differences)}
    noise = {
        "paper": "with action noise as in the paper (none in SHAPE MATCH, that of the policy elsewhere)",
        "with": "with action noise",
        "without": "without action noise",
    }[protocol.noise]
    description = (
        f"Each policy plays the same {protocol.episodes} episodes with {protocol.particles} particles, {noise}, on "
        "layouts that neither trained nor selected it. Return: mean over seeds of the mean over episodes, ± half its "
        f"95 % confidence interval (Student's t over seeds). Difference: to {first}, in pairs of equal seeds; one run "
        "of a reference policy stands for all seeds. Compare only policies that observe the same. A plan is made for "
        "one start, and its row is of that one. Minutes: of a training with all its evaluations. The curves show other "
        "episodes, those of the evaluations during training; they chose the policies, so the best of them are partly "
        "luck."
    )
    shown = (
        *columns(task="task", observes="observes", algorithm="algorithm"),
        *columns("d", seeds="seeds", episodes="episodes"),
        *columns(",.1f", mean="return", interval="± 95 %"),
        *columns("+,.1f", difference="difference"),
        *columns(",.1f", difference_interval="its ± 95 %"),
        *columns(".0%", success="success"),
        *columns(",d", steps="steps"),
        *columns(",.1f", minutes="minutes"),
    )
    return Table("Returns", description, shown, rows)


def draw(results: Sequence[RunResult], columns: int = 2) -> Figure:
    """For each task: curves of the evaluations during training, and the returns of the evaluated policies.

    Args:
        results: All runs.
        columns: 2 puts both pictures of a task beside each other, 1 below each other, for narrow screens.
    """
    groups = grouped(results)
    tasks, labels = list(dict.fromkeys(task for task, _ in groups)), list(dict.fromkeys(label for _, label in groups))
    rows = 2 * max(len(tasks), 1) // columns
    figure = Figure(figsize=(5.5 * columns, 3.6 * rows), dpi=130, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1, 2)
    for (curves, returns), task in zip(panels, tasks, strict=False):
        names: list[str] = []
        for label, group in ((label, group) for (other, label), group in groups.items() if other == task):
            colour, style = f"C{labels.index(label) % 10}", LINES[observes(group)]
            if lines := [result.curve for result in group if len(result.curve[0])]:
                steps, values = align(lines)
                curves.plot(steps, values.mean(0), style, color=colour, marker="o", markersize=3, label=label)
                if len(lines) > 1:
                    half = np.array([t_interval(column) for column in values.T])
                    curves.fill_between(
                        steps, values.mean(0) - half, values.mean(0) + half, color=colour, alpha=0.15, linewidth=0
                    )
            for name, by_seed in scores_by_name(group).items():
                place, scores = len(names), [*by_seed.values()]
                returns.plot(scores, [place] * len(scores), "o", color=colour, alpha=0.4)
                returns.errorbar(np.mean(scores), place, xerr=t_interval(scores), fmt="D", color=colour, capsize=4)
                names.append("\n".join(textwrap.wrap(f"{name} ({observes(group)})", 30)))
        returns.set_yticks(range(len(names)), names, fontsize=8)
        returns.invert_yaxis()
        curves.set(title=f"{task}: evaluations during training", xlabel="environment steps", ylabel="return")
        returns.set(title=f"{task}: final evaluation", xlabel="return: seeds, their mean, ± 95 %")
        for axes in (curves, returns):
            axes.grid(alpha=0.3)
        if curves.lines:
            curves.legend(fontsize=8)
    return figure


def write_report(folder: Path, results: Sequence[RunResult], first: str, protocol: Protocol) -> Path:
    """Write ``episodes.csv``, ``report.md``, ``index.html`` and its pictures; another process may do the same."""
    table, others = make_table(results, first, protocol), [each for each in results if each.state != "finished"]
    end = "; the others:" if others else "."
    state = f"{len(results) - len(others)} of {len(results)} runs are finished and evaluated{end}"
    lines = [f"{each.run.name}: {each.state}{f' ({each.run.error})' if each.run.error else ''}" for each in others]
    write_text(folder / "episodes.csv", csv_text(raw_rows(results), RAW), shared=True)
    with matplotlib.style.context("default"):  # not the user's own, which may need LaTeX
        write_figure(folder / "returns.png", draw(results), shared=True)
        write_figure(folder / "returns-narrow.png", draw(results, columns=1), shared=True)
    parts = ["# Comparison", state, "\n".join(f"- {line}" for line in lines), table.to_markdown()]
    text = "\n\n".join(part for part in [*parts, "![Learning curves and returns](returns.png)"] if part) + "\n"
    write_text(folder / "report.md", text, shared=True)
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>Comparison</title>
<style>{STYLE} body {{ max-width: 78rem; }}</style></head><body>
<h1>Comparison</h1><p>{state}</p><ul>{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>
{table.to_html()}
<picture><source media="(max-width: 48rem)" srcset="returns-narrow.png">
<img src="returns.png" alt="Learning curves and returns"></picture>
<p>Every episode: <a href="episodes.csv">episodes.csv</a></p></body></html>
"""
    write_text(folder / "index.html", page, shared=True)
    return folder / "index.html"
