"""What is shown of a run: pictures of its policy, its learning curve, and a page that opens from disk."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

import torchmpm
from cfp.agent.actor import Actor
from cfp.config import RunConfig, to_json
from cfp.evaluation.returns import REPLAYED, Result, to_rows
from cfp.files import write_atomically, write_text
from cfp.tables import Table, columns, read_table
from dittogym.render.frame import written_return

#: Pictures of every evaluation (TensorBoard only), and what they show.
PICTURES: dict[str, str] = {
    "picture/observation": "what the first training robot shows: red occupancy, green and blue velocity in x and y",
    "picture/action": "the mean action for it, x-muscles left, y-muscles right: red contracts, blue expands",
    "picture/gate": "the gate of a residual actor in the same way: white keeps the coarse action, red replaces it",
}

SIZE = 192  # rows of a picture, pixels
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #282c34; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; } h2 { font-size: 1.3rem; margin-top: 2rem; }
img { display: block; width: 100%; height: auto; margin-top: 1rem; } video { max-width: 100%; }
.film { width: 32rem; border-radius: 6px; } .note { color: #555; max-width: 60rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.9rem; }
th, td { padding: 0.2rem 0.6rem; text-align: right; border-bottom: 1px solid #ccc; }
th, td { white-space: nowrap; } .text { text-align: left; } td.text { white-space: normal; }
@media (max-width: 48rem) { /* each row becomes a block of names and values */
  table, tbody, tr { display: block; } thead, .none { display: none; }
  tr { columns: 2; padding: 0.5rem 0; border-bottom: 1px solid #ccc; }
  td { display: flex; justify-content: space-between; gap: 1rem; padding: 0.1rem 0; border: 0; }
  td.text { column-span: all; text-align: right; font-weight: 600; }
  td::before { content: attr(data-title); color: #555; font-weight: normal; }
}
pre { background: #f4f4f4; padding: 1rem; overflow-x: auto; white-space: pre-wrap; }
"""
RESULTS = (
    *columns(policy="policy", action="action"),
    *columns("d", episodes="episodes"),
    *columns(".1f", mean="mean return", interval="± 95 %", std="std"),
    *columns(".0%", success="success", piece="in one piece"),
)


# Pictures of the policy.


@torch.no_grad()
def policy_pictures(actor: Actor, observation: Tensor) -> dict[str, np.ndarray]:
    """Pictures, uint8 (H, W, 3), of one observation and what an actor makes of it without noise."""
    sample = actor.sample(observation, deterministic=True)
    pictures = {
        "picture/observation": _enlarged(observation[0].permute(1, 2, 0).cpu().numpy()),
        "picture/action": muscles(sample.action[0]),
    }
    if sample.gate is not None:
        pictures["picture/gate"] = muscles(sample.gate[0])
    return pictures


def muscles(image: Tensor) -> np.ndarray:
    """Both channels of an image (2, R, R) in [-1, 1] side by side, from blue through white to red, uint8 (H, W, 3)."""
    values = image.float().clamp(-1, 1).cpu().numpy()
    fading = 1 - np.abs(values)
    colours = np.stack([np.where(values < 0, fading, 1), fading, np.where(values > 0, fading, 1)], axis=-1)
    left, right = (_enlarged((255 * colour).round().astype(np.uint8)) for colour in colours)
    return np.concatenate([left, np.zeros((SIZE, 2, 3), np.uint8), right], axis=1)


def _enlarged(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(np.ascontiguousarray(pixels), (SIZE, SIZE), interpolation=cv2.INTER_NEAREST))


# The learning curve.


def draw_curve(run: Path, config: RunConfig, baselines: Mapping[str, float]) -> Figure:
    """Training and evaluation returns over environment steps of the run in a folder, also while it is in training.

    Args:
        run: The folder.
        config: Options of the run.
        baselines: Returns to compare with, by name.
    """
    figure = Figure(figsize=(7.2, 4.2), dpi=180, layout="constrained")
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
    if axes.lines:
        axes.legend(fontsize=8)
    return figure


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


# The page.


def headline(config: RunConfig, results: Sequence[Result]) -> str:
    """What a run came to: the return of its last policy, of a plan that on its own start, and of zero action."""
    last = [result for result in results if result.name != REPLAYED][-1]
    success = "" if last.success is None else f", success {last.success:.0%}"
    zero = f"{results[0].name} {written_return(results[0].mean)}"
    return f"{config.algo} on {config.task}: return {written_return(last.mean)}{success} ({zero})"


def write_page(folder: Path, config: RunConfig, results: Sequence[Result], note: str) -> Path:
    """Write ``index.html`` beside the files of a finished run that it shows; returns its path.

    Args:
        folder: The folder of the run.
        config: Its options.
        results: The final table, zero action first.
        note: What to say beside the table, see `cfp.evaluation.returns.explain`.
    """
    title = escape(headline(config, results))
    film = '<video class="film" src="video.mp4" controls loop muted></video>'
    replay = '<p><a href="replay.html">Replay of this episode</a>, to step through, with other speeds and colours.</p>'
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>",
        film if (folder / "video.mp4").exists() else "",
        replay if (folder / "replay.html").exists() else "",
        Table("Final evaluation", note, RESULTS, to_rows(results)).to_html(),
        '<h2>Learning curve</h2><img src="curve.png" alt="Return over environment steps">',
        f"<h2>Options</h2><p>Preset {config.preset}, seed {config.seed}, torchmpm {torchmpm.__version__}. This command "
        "repeats the training:</p>",
        "<pre>torchmpm train --config config.json --out FOLDER</pre>",
        f"<pre>{escape(json.dumps(to_json(config), indent=2))}</pre></body></html>",
    ]
    path = folder / "index.html"
    write_text(path, "\n".join(part for part in parts if part) + "\n")
    return path
