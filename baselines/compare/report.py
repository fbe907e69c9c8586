"""The report of a comparison: tables as CSV, all of them in one Markdown file and one page, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from baselines.compare import plots as pictures
from baselines.compare import tables
from baselines.compare.results import Found, Group, group
from baselines.compare.table import Table
from cfp.evaluation.page import STYLE
from cfp.evaluation.plots import write_figure
from cfp.files import write_text
from cfp.sections import Particles

MORE_STYLE = """
body { max-width: 76rem; } .wide { overflow-x: auto; } table { font-size: 14px; } th { vertical-align: bottom; }
th.text, td.text { text-align: left; } td { font-variant-numeric: tabular-nums; white-space: nowrap; }
"""
PAPER: Particles = "full"
"""Particles of the paper's figures."""
Picture = tuple[str, str, str]
"""File, title, words."""


def write_report(folder: Path, runs: Sequence[Found], episodes: int, tier: Particles, about: str) -> Path:
    """Write all files of the report; those of an earlier one are replaced.

    Args:
        folder: Where they go: ``index.html``, ``report.md``, ``*.csv``, ``*.png``.
        runs: Of the comparison.
        episodes: Of a final evaluation, for the words.
        tier: Particles of the final evaluations.
        about: What was compared, for the head of the page.

    Returns:
        The path of the page.
    """
    groups = group(runs)
    whole = make_tables(runs, groups, episodes, tier)
    for table in whole:
        write_text(folder / f"{table.name}.csv", table.to_csv())
    shown = {table.name: table for table in whole}
    shown["runs"] = tables.unfinished(shown["runs"])
    sketches = _draw(folder, groups, shown["robustness"])
    about = f"{about} {_size(tier)} {_sights(groups)}"
    write_text(folder / "report.md", _markdown(shown, sketches, about))
    write_text(folder / "index.html", _page(shown, sketches, about))
    return folder / "index.html"


def make_tables(runs: Sequence[Found], groups: Sequence[Group], episodes: int, tier: Particles) -> list[Table]:
    """All tables, in the order of the report; those with the paper's returns have rows at its size only."""
    alike = groups if tier == PAPER else []
    return [
        tables.runs_table(runs),
        tables.returns_table(groups, episodes),
        tables.aggregate_table(alike),
        tables.efficiency_table(groups, tier),
        tables.cost_table(groups),
        tables.success_table(groups),
        tables.robustness_table(groups),
        tables.paper_table(alike),
    ]


def _size(tier: Particles) -> str:
    """What was judged with how many particles, in words."""
    words = f"Final evaluations with {tier} particles."
    if tier != PAPER:
        words += (
            " None of them is set beside the paper's returns or scaled by them: those are of full size, and returns of "
            "other sizes differ (--tier full judges the same policies there)."
        )
    return words


def _sights(groups: Sequence[Group]) -> str:
    """Who sees what, in words."""
    sights = list(dict.fromkeys(each.sees for each in groups))
    seen = [f"{sees}: {', '.join(dict.fromkeys(g.label for g in groups if g.sees == sees))}" for sees in sights]
    return f"What policies see – {'; '.join(seen)}."


def _draw(folder: Path, groups: Sequence[Group], robustness: Table) -> dict[str, Picture]:
    """Write the pictures that there is something to show in; by the table that each stands above."""
    made: dict[str, tuple[Figure, Picture]] = {}
    if any(each.scores for each in groups):
        words = "Interquartile mean over seeds with its 95 % bootstrap interval; pale marks are single seeds."
        made["returns"] = pictures.returns(groups), ("returns.png", "Returns", words)
    if any(each.curves for each in groups):
        made["efficiency"] = pictures.curves(groups), ("curves.png", "Learning curves", _curve_words(groups))
    if any(each.curves and each.speed for each in groups):
        words = "The same over the time of training, without that of evaluations, at the mean speed over seeds."
        made["cost"] = pictures.curves(groups, minutes=True), ("minutes.png", "Learning curves over time", words)
    if any(row["ratio"] is not None for row in robustness.rows):
        words = "Mean over seeds and their range; black: the paper's CFP."
        made["robustness"] = pictures.robustness(groups, robustness.rows), ("robustness.png", "Robustness", words)
    for figure, (name, _, _) in made.values():
        write_figure(folder / name, figure)
    return {key: picture for key, (_, picture) in made.items()}


def _curve_words(groups: Sequence[Group]) -> str:
    """What the curves show; that evaluations were made with different particles, if so."""
    words = (
        "The runs' own evaluations while they trained: interquartile mean over seeds and its 95 % bootstrap band, on "
        "steps where all seeds have values. The line says what is seen."
    )
    particles = {each.label: each.particles for each in groups}
    if len(set(particles.values())) > 1:
        listed = ", ".join(f"{label} {value}" for label, value in particles.items())
        words += f" Not the same particles for all: {listed}."
    own = sorted({each.label for each in groups if each.runs[0].job.config.evaluation(0)[1] == 1})
    if own:
        words += f" On the one layout they are made for: {', '.join(own)}."
    return words


def _markdown(shown: dict[str, Table], sketches: dict[str, Picture], about: str) -> str:
    parts = ["# Comparison", about]
    for name, table in shown.items():
        if name in sketches:
            file, title, words = sketches[name]
            parts.append(f"![{title}]({file})\n\n{words}")
        if table.rows or name == "runs":
            parts.append(table.to_markdown().rstrip())
    return "\n\n".join(parts) + "\n"


def _page(shown: dict[str, Table], sketches: dict[str, Picture], about: str) -> str:
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><title>Comparison</title>',
        f"<style>{STYLE}{MORE_STYLE}</style></head><body><h1>Comparison</h1><p>{escape(about)}</p>",
    ]
    for name, table in shown.items():
        if name in sketches:
            file, title, words = sketches[name]
            parts.append(f'<figure><img src="{file}" alt="{title}"><figcaption>{escape(words)}</figcaption></figure>')
        if table.rows or name == "runs":
            parts.append(table.to_html())
    files = ", ".join(f'<a href="{name}.csv">{name}.csv</a>' for name in shown)
    parts.append(f"<h2>Files</h2><p>The tables with all columns: {files}.</p></body></html>")
    return "\n".join(parts) + "\n"
