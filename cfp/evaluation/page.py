"""What is shown of a run: pictures of its policy, its learning curve, and a page that opens from disk."""

from __future__ import annotations

import json
import shlex
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

import torchmpm
from cfp.agent.actor import Actor
from cfp.config import RunConfig, differences, to_json, to_words
from cfp.evaluation.returns import Result, to_rows
from cfp.files import write_atomically, write_text
from cfp.tables import Table, columns, read_table
from dittogym.observation import silhouette
from dittogym.render.frame import GROUND, TARGET, png
from dittogym.render.recording import Recording
from dittogym.render.scene import ROBOT

#: Pictures of every evaluation (TensorBoard only), and what they show.
PICTURES: dict[str, str] = {
    "picture/observation": "what the first training robot shows: red occupancy, green and blue velocity in x and y",
    "picture/action": "the mean action for it, x-muscles left, y-muscles right: red contracts, blue expands",
    "picture/gate": "the gate of a residual actor in the same way: white keeps the coarse action, red replaces it",
}

#: Colour of the robot's pixels outside the target.
MISPLACED = (206, 60, 52)
SIZE = 192  # rows of a picture, pixels
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #282c34; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; } h2 { font-size: 1.3rem; margin-top: 2rem; } img, video { max-width: 100%; }
.episode { display: flex; flex-wrap: wrap; align-items: flex-start; gap: 1rem 2rem; }
.episode > div { flex: 1 1 20rem; }
.film { flex: 0 1 auto; width: 32rem; border-radius: 6px; } .episode h2 { margin-top: 0; }
figure { display: inline-block; margin: 0 1rem 1rem 0; vertical-align: top; width: min(7rem, 25vw); }
figure img { width: 100%; image-rendering: pixelated; }
.wide { overflow-x: auto; } table { border-collapse: collapse; }
th, td { padding: 0.2rem 0.8rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #ccc; }
th.text, td.text { text-align: left; }
@media (max-width: 40rem) { th, td { padding: 0.2rem 0.25rem; font-size: 0.75rem; } th { white-space: normal; } }
pre { background: #f4f4f4; padding: 1rem; overflow-x: auto; white-space: pre-wrap; } pre span { white-space: nowrap; }
"""
RESULTS = (
    *columns(policy="policy", action="action"),
    *columns("d", episodes="episodes"),
    *columns(".1f", mean="mean return", interval="± 95 %", std="std"),
    *columns(".0%", success="success"),
)
OPTIONS = columns(option="option", own="this run", preset="preset")
#: When the picture that a film shows before it plays was taken, as a share of the episode.
POSTER_TIME = 0.6


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


def match_pictures(target: np.ndarray, observation: np.ndarray) -> tuple[dict[str, np.ndarray], float]:
    """How well the robot matches a target (64, 64): pictures by name, and the intersection over union.

    Args:
        target: Bool.
        observation: (3, 64, 64) uint8.
    """
    robot = silhouette(torch.from_numpy(observation)[None])[0].numpy()
    layers = {
        "target": [(target, TARGET)],
        "result": [(robot, ROBOT)],
        "overlap": [(target, TARGET), (robot, MISPLACED), (robot & target, ROBOT)],
    }
    pictures = {}
    for name, painted in layers.items():
        pictures[name] = np.full((*target.shape, 3), GROUND, np.uint8)
        for mask, colour in painted:
            pictures[name][mask] = colour
    return pictures, float((robot & target).sum() / (robot | target).sum())


def _enlarged(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(np.ascontiguousarray(pixels), (SIZE, SIZE), interpolation=cv2.INTER_NEAREST))


# The learning curve.


def plot_curve(run: Path, config: RunConfig, baselines: dict[str, float]) -> Path:
    """Draw training and evaluation returns over environment steps into ``curve.png``; returns its path."""
    figure = Figure(figsize=(8, 4.5), dpi=150, layout="constrained")
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
    axes.legend(fontsize=8)
    write_figure(run / "curve.png", figure)
    return run / "curve.png"


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


def write_page(
    folder: Path,
    config: RunConfig,
    preset: RunConfig,
    results: Sequence[Result],
    recording: Recording | None = None,
    seconds: float = 0.0,
) -> Path:
    """Write ``index.html`` beside the files of a finished run that it shows; returns its path.

    Args:
        folder: Of the run.
        config: Its options.
        preset: Those that its preset has for the task.
        results: The final evaluation.
        recording: An episode of its last policy, if one was recorded.
        seconds: Wall time of the training, s.
    """
    title = escape(f"{config.algo} on {config.task}, preset {config.preset}, seed {config.seed}")
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        f"<title>{title}</title><style>{STYLE}</style></head><body>",
        f"<h1>{title}</h1>",
        _episode(folder, config, recording) if recording else "",
        Table("results", "Final evaluation", "", RESULTS, to_rows(results)).to_html(),
        f'<h2>Learning curve</h2><img src="curve.png" alt="Return over environment steps"><p>{_training(folder)}</p>',
        _films(folder),
        f"<h2>This run</h2><p>{_about(seconds)}</p><pre>{_command(config, preset)}</pre>",
        _changes(config, preset),
        f"<details><summary>All options</summary><pre>{escape(json.dumps(to_json(config), indent=2))}</pre></details>",
        "</body></html>",
    ]
    path = folder / "index.html"
    write_text(path, "\n".join(part for part in parts if part) + "\n")
    return path


def changed_options(config: RunConfig, preset: RunConfig) -> dict[str, tuple[Any, Any]]:
    """Options that differ from the preset: their value, and that of the preset."""
    return differences(to_json(config), to_json(preset))


def command_words(config: RunConfig, preset: RunConfig) -> list[str]:
    """The words of the command that trains with these options."""
    given: dict[str, Any] = {"task": config.task, "algo": config.algo, "preset": config.preset, "seed": config.seed}
    given |= {name: value for name, (value, _) in changed_options(config, preset).items()}
    return ["torchmpm", "train", *to_words(given)]


def _command(config: RunConfig, preset: RunConfig) -> str:
    """The command, whose lines do not end within a word: browsers break them after hyphens."""
    return " ".join(f"<span>{escape(shlex.quote(word))}</span>" for word in command_words(config, preset))


def _episode(folder: Path, config: RunConfig, recording: Recording) -> str:
    """The film, or a picture where it could not be written; beside it the match, and the replay."""
    poster = png(recording.picture(POSTER_TIME * recording.duration))
    write_atomically(folder / "poster.png", lambda file: file.write(poster))
    video = '<video class="film" src="video.mp4" poster="poster.png" controls loop muted></video>'
    shown = video if (folder / "video.mp4").exists() else '<img class="film" src="poster.png" alt="The robot">'
    link = '<a href="replay.html">Replay of this episode</a>, to step through, with other speeds and colours.'
    about = f"<p>Return of this episode: {sum(recording.rewards):.1f}.</p><p>{link}</p>"
    return f'<div class="episode">{shown}<div>{_match(config, recording)}{about}</div></div>'


def _match(config: RunConfig, recording: Recording) -> str:
    """Target, result and overlap, in a task that has a target."""
    target = config.make_spec().target
    if target is None or recording.observation is None:
        return ""
    pictures, iou = match_pictures(target, recording.observation)
    figures = [
        f'<figure><img src="data:image/png;base64,{b64encode(png(picture)).decode()}" alt="{name}">'
        f"<figcaption>{name}</figcaption></figure>"
        for name, picture in pictures.items()
    ]
    about = f"<p>Intersection over union at the end of this episode: {iou:.2f}. Red lies outside the target.</p>"
    return f"<h2>Match</h2>{''.join(figures)}{about}"


def _training(folder: Path) -> str:
    """The best evaluation while training; where there was none, the return of training episodes."""
    evaluations = read_table(folder / "evaluations.csv", ("step", "mean"))
    if evaluations:
        best = max(evaluations, key=lambda row: float(row["mean"]))
        return f"Best evaluation while training: {float(best['mean']):.1f} at step {best['step']}."
    returns = [row["rollout/return"] for row in read_table(folder / "progress.csv") if row.get("rollout/return")]
    last = f"; the last training episodes had a mean return of {float(returns[-1]):.1f}" if returns else ""
    return f"No evaluation was made while training{last}."


def _films(folder: Path) -> str:
    """Links to the films made while training."""
    names = sorted(path.name for path in (folder / "videos").glob("*.mp4"))
    items = "".join(f'<li><a href="videos/{escape(name)}">{escape(name)}</a></li>' for name in names)
    return f"<h2>While training</h2><ul>{items}</ul>" if items else ""


def _about(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    spans = {"h": minutes // 60, "min": minutes % 60, "s": rest}
    time = " ".join(f"{number} {unit}" for unit, number in spans.items() if number)
    with_version = f"with torchmpm {torchmpm.__version__}"
    return f"Trained {f'in {time} ' if time else ''}{with_version}. The command with all of its options:"


def _changes(config: RunConfig, preset: RunConfig) -> str:
    changes = changed_options(config, preset)
    if not changes:
        return "<p>All options are those of the preset.</p>"
    rows = [{"option": name, "own": _value(own), "preset": _value(usual)} for name, (own, usual) in changes.items()]
    return Table("options", "Options that differ from the preset", "", OPTIONS, rows).to_html()


def _value(value: Any) -> str:
    """A value as the command line takes it."""
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
