"""The report of a comparison: tables as CSV files, all of them in one Markdown file and one page, and figures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from baselines.compare import paper, plots, tables
from baselines.compare.final_evaluation import Protocol
from baselines.compare.results import Group, RunResult, group_results
from cfp.evaluation.page import STYLE, write_figure
from cfp.files import write_text
from cfp.sections import Particles
from cfp.tables import Table

TABLE_STYLE = """
body { max-width: 76rem; } table { font-size: 14px; } th { vertical-align: bottom; }
td { font-variant-numeric: tabular-nums; white-space: nowrap; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of the report, with the name of its file, a title, and a caption that explains it."""

    file: str
    title: str
    caption: str
    figure: Figure


def write_report(folder: Path, runs: Sequence[RunResult], protocol: Protocol, description: str) -> Path:
    """Write all files of the report, over those of an earlier one; another process may do the same."""
    groups = group_results(runs)
    complete = make_tables(runs, groups, protocol)
    for table in complete:
        write_text(folder / f"{table.name}.csv", table.to_csv(), shared=True)
    shown = {table.name: table for table in complete if table.rows}
    shown["runs"] = replace(complete[0], rows=tables.unfinished(complete[0].rows))
    pictures = _make_pictures(groups)
    for picture in pictures.values():
        write_figure(folder / picture.file, picture.figure, shared=True)
    head = f"{description} {_describe_protocol(protocol)} {_describe_observations(groups)}"
    write_text(folder / "report.md", _markdown(shown, pictures, head), shared=True)
    page = _page(shown, pictures, head, [table.name for table in complete])
    write_text(folder / "index.html", page, shared=True)
    return folder / "index.html"


def make_tables(runs: Sequence[RunResult], groups: Sequence[Group], protocol: Protocol) -> list[Table]:
    """All tables, in the order of the report; those with the paper's returns have rows at its size only."""
    comparable = groups if protocol.particles == paper.PARTICLES else []
    return [
        tables.runs_table(runs),
        tables.returns_table(groups, protocol.episodes),
        tables.aggregate_table(comparable),
        tables.efficiency_table(groups, protocol.particles),
        tables.cost_table(groups),
        tables.success_table(groups),
        tables.robustness_table(groups),
        tables.paper_table(comparable),
    ]


def _describe_protocol(protocol: Protocol) -> str:
    rule = f"action noise as in the paper: none in {', '.join(paper.WITHOUT_NOISE)}, that of the policy elsewhere"
    noise = {"paper": rule, "with": "action noise", "without": "no action noise"}[protocol.noise]
    text = f"Final evaluations with {protocol.particles} particles and {noise}."
    if protocol.particles != paper.PARTICLES:
        text += (
            " They are not compared with the paper's returns, which were measured with full particles "
            "(--particles full evaluates the same policies with as many)."
        )
    return text


def _describe_observations(groups: Sequence[Group]) -> str:
    labels: dict[str, list[str]] = {}
    for group in groups:
        labels.setdefault(group.sees, []).append(group.label)
    parts = (f"{sees}: {', '.join(dict.fromkeys(names))}" for sees, names in labels.items())
    return f"What the policies observe – {'; '.join(parts)}."


def _make_pictures(groups: Sequence[Group]) -> dict[str, Picture]:
    """Figures that have something to show, by the table that each stands above."""
    pictures: dict[str, Picture] = {}
    if any(group.scores for group in groups):
        caption = "Interquartile mean over seeds with its 95 % bootstrap interval; pale marks are single seeds."
        pictures["returns"] = Picture("returns.png", "Returns", caption, plots.final_returns(groups))
    if any(group.curves for group in groups):
        figure = plots.learning_curves(groups)
        pictures["efficiency"] = Picture("curves.png", "Learning curves", _curve_caption(groups), figure)
    if any(group.curves and group.speed for group in groups):
        caption = "The same over the time of training, without that of evaluations, at the mean speed over seeds."
        figure = plots.learning_curves(groups, minutes=True)
        pictures["cost"] = Picture("minutes.png", "Learning curves over time", caption, figure)
    return pictures


def _curve_caption(groups: Sequence[Group]) -> str:
    text = (
        "The runs' own evaluations during training: interquartile mean over seeds and its 95 % bootstrap band, on "
        "steps where all seeds have values. The style of a line tells what is observed."
    )
    particles: dict[str, Particles] = {group.label: group.particles for group in groups}
    if len(set(particles.values())) > 1:
        listed = ", ".join(f"{label} {value}" for label, value in particles.items())
        text += f" The numbers of particles differ: {listed}."
    if own := sorted({group.label for group in groups if group.job.config.evaluation(1)[0] == group.job.config.seed}):
        text += f" On the one layout they are made for: {', '.join(own)}."
    return text


def _markdown(shown: dict[str, Table], pictures: dict[str, Picture], head: str) -> str:
    parts = ["# Comparison", head]
    for name, table in shown.items():
        if picture := pictures.get(name):
            parts.append(f"![{picture.title}]({picture.file})\n\n{picture.caption}")
        parts.append(table.to_markdown())
    return "\n\n".join(parts) + "\n"


def _page(shown: dict[str, Table], pictures: dict[str, Picture], head: str, files: Sequence[str]) -> str:
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><title>Comparison</title>',
        f"<style>{STYLE}{TABLE_STYLE}</style></head><body><h1>Comparison</h1><p>{escape(head)}</p>",
    ]
    for name, table in shown.items():
        if picture := pictures.get(name):
            image = f'<img src="{picture.file}" alt="{picture.title}">'
            parts.append(f"<figure>{image}<figcaption>{escape(picture.caption)}</figcaption></figure>")
        parts.append(table.to_html())
    links = ", ".join(f'<a href="{name}.csv">{name}.csv</a>' for name in files)
    parts.append(f"<h2>Files</h2><p>The tables with all columns: {links}.</p></body></html>")
    return "\n".join(parts) + "\n"
