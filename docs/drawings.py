"""Draws the diagrams of the documents into `docs/images`: ``python docs/drawings.py``."""

from __future__ import annotations

import hashlib
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from tables import DOCS, constants, evaluated, geometry, name_of, read

import cfp
import dittogym
from baselines.compare import paper
from cfp.robustness import OWN_START, UNDISTURBED
from dittogym.action import patch_field, place, to_grid_layout

IMAGES = DOCS / "images"
NODES = 128
VIEW, PATCH, NODE = "#26798c", "#b03a2e", "0.35"
#: Colours of the paper's returns, of this package's, and of zero and random actions.
PAPER, OURS, ZERO, RANDOM = "#b03a2e", "#26798c", "0.65", "0.35"
matplotlib.rcParams["svg.hashsalt"] = "torchmpm"  # the same file for the same data
matplotlib.rcParams["font.size"] = 9


def source(name: str) -> str:
    """Hash of the data that a picture shows, which is stored in its file: a test compares them."""
    if name == "returns.svg":
        data = "".join((DOCS / f"{table}.csv").read_text() for table in ("evaluations", "training"))
    elif name == "rewards.svg":
        data = (DOCS / "rewards-long.csv").read_text()
    elif name.startswith("tasks/"):
        data = geometry(Path(name).stem) + constants(Path(name).stem)
    else:
        data = name  # an illustration
    return hashlib.sha256(data.encode()).hexdigest()


def save(figure: Figure, name: str) -> None:
    """Write a figure, without a date, so that it changes with the data only."""
    path = IMAGES / name
    path.parent.mkdir(exist_ok=True)
    nameless = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    figure.savefig(path, dpi=110, bbox_inches="tight", metadata=nameless | {"Description": source(name)})


def robot(task: str, steps: int = 0) -> dittogym.TorchEnv:
    """An environment of a task, after some steps of the policy that comes with the package."""
    policy = cfp.load(task)
    env = dittogym.TorchEnv(task, particles="lite", resolution=policy.resolution)
    observation, _ = env.reset(seed=0)
    for _ in range(steps):
        torch.manual_seed(0)
        action, _ = policy.predict(observation.numpy(), deterministic=True)
        observation, *_ = env.step(torch.as_tensor(action))
    return env


def window(axes: Axes, env: dittogym.TorchEnv) -> tuple[float, float]:
    """Show the simulation window; returns its lower left corner, m."""
    x, y = env.env_state.origin[0].tolist()
    axes.imshow(env.render(0, size=512, zoom=1), extent=(x, x + 1, y, y + 1))
    axes.set(xlim=(x, x + 1), ylim=(y, y + 1))
    return x, y


def square(
    axes: Axes,
    env: dittogym.TorchEnv,
    centre: tuple[float | None, float | None],
    nodes: int,
    colour: str,
    line: str = "-",
) -> None:
    """Outline a square of nodes around a centre in the window, of which None follows the robot."""
    origin, middle = env.env_state.origin[0].tolist(), env.env_state.centre[0].tolist()
    half = nodes / NODES / 2
    corner = []
    for low, own, given in zip(origin, middle, centre, strict=True):
        inside = own - low if given is None else given
        corner.append(low + min(max(inside - half, 0.0), 1 - 2 * half))
    axes.add_patch(Rectangle(corner, 2 * half, 2 * half, fill=False, ec=colour, lw=2.5, ls=line))


def draw_windows() -> None:
    """Window, observed region and action patch in RUN, where all follow the robot, and in DIG, where one does."""
    figure = Figure(figsize=(7.2, 4.1), layout="constrained")
    for axes, task, steps in zip(figure.subplots(1, 2), ("run", "dig"), (60, 60), strict=True):
        env = robot(task, steps)
        window(axes, env)
        square(axes, env, env.spec.view, 64, VIEW)
        square(axes, env, env.spec.patch_centre, env.spec.patch, PATCH, "--")
        axes.set_title(name_of(task))
        axes.set_xlabel("x, m")
    lines = [Line2D([], [], color=colour, lw=2, ls=ls) for colour, ls in (("0", "-"), (VIEW, "-"), (PATCH, "--"))]
    labels = ["simulation window, 128 × 128 nodes", "observed region, 64 × 64 pixels", "action patch"]
    figure.legend(lines, labels, loc="outside lower center", ncols=3, frameon=False)
    save(figure, "windows.png")


def draw_step() -> None:
    """One control step: image, action grid, muscle field, grid and particles."""
    env = robot("run", 40)
    policy = cfp.load("run")
    image = env.observation()[0]
    action = torch.as_tensor(policy.predict(image[None].numpy(), deterministic=True)[0])
    centre = env.env_state.centre - env.env_state.origin
    stress = patch_field(to_grid_layout(action, "image"), env.spec.patch, env.spec.max_actuation)
    field = place(stress, centre, NODES)[0, 0].T.numpy()
    figure = Figure(figsize=(8.6, 2.4), layout="constrained")
    first, second, third, fourth, fifth = figure.subplots(1, 5)
    first.imshow(image[0], cmap="gray_r")
    first.set_title("observation\n3 × 64 × 64, here occupancy")
    second.imshow(action[0, 0], cmap="RdBu_r", vmin=-1, vmax=1)
    second.set_title(f"action, 2 × {policy.resolution} × {policy.resolution}\nhere the horizontal muscles")
    scale = env.spec.max_actuation
    third.imshow(field, origin="lower", cmap="RdBu_r", vmin=-scale, vmax=scale, extent=(0, NODES, 0, NODES))
    third.set_title(f"muscle stress on the nodes\nof the window, ± {scale:g} Pa")
    x = env.state.x[0] - env.env_state.origin
    nodes = NODES * x.numpy()
    low = np.floor(nodes.mean(0) - (4, 6)).astype(int)
    grid = np.stack(np.meshgrid(*(np.arange(8) + corner for corner in low)), -1).reshape(-1, 2)
    for axes in (fourth, fifth):
        axes.plot(*nodes.T, ".", ms=5, color=OURS)
        axes.set(xlim=(low[0] - 0.5, low[0] + 7.5), ylim=(low[1] - 0.5, low[1] + 7.5))
        axes.set_aspect("equal")
    particle = nodes[np.abs(nodes - low - 3.5).sum(1).argmin()]
    corner = (particle - 0.5).astype(int)
    for offset in np.stack(np.meshgrid(range(3), range(3)), -1).reshape(-1, 2):
        node = corner + offset
        fourth.annotate("", node, particle, arrowprops={"arrowstyle": "->", "color": PATCH, "lw": 1})
        fifth.annotate("", particle, node, arrowprops={"arrowstyle": "->", "color": PATCH, "lw": 1})
    for axes in (fourth, fifth):
        axes.plot(*grid.T, "+", ms=6, color=NODE)
        axes.plot(*particle, "o", ms=6, color=PATCH)
    fourth.set_title("100 × particles to grid:\nmass, momentum, stress")
    fifth.set_title("... and grid to particles:\nvelocity, deformation")
    for axes in (first, second, third, fourth, fifth):
        axes.set(xticks=[], yticks=[])
        axes.title.set_fontsize(7.5)
    save(figure, "step.png")


def draw_scene(task: str) -> None:
    """The initial state of a task in coordinates of nodes, with the names of its obstacles."""
    env = robot(task)
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.subplots()
    left, bottom = window(axes, env)
    axes.images[0].set_extent([NODES * value for value in (left, left + 1, bottom, bottom + 1)])
    left, bottom = NODES * left, NODES * bottom
    axes.set(xlim=(left, left + NODES), ylim=(bottom, bottom + NODES), xlabel="node i", ylabel="node j")
    axes.xaxis.set_major_locator(matplotlib.ticker.MultipleLocator(16))
    axes.yaxis.set_major_locator(matplotlib.ticker.MultipleLocator(16))
    axes.grid(color="0.5", alpha=0.25, lw=0.6)
    label = {"ha": "center", "va": "center", "fontsize": 8}
    label["bbox"] = {"boxstyle": "round,pad=0.15", "fc": "1", "ec": "none", "alpha": 0.85}
    sides = (left, left + NODES, bottom, bottom + NODES)
    for obstacle in env.spec.obstacles:
        named = False
        for box in obstacle.boxes:
            ends = np.clip(NODES * np.array([box.left, box.right]), *sides[:2])
            heights = np.clip(NODES * np.array([box.bottom, box.top]), *sides[2:])
            width, height = np.diff(ends)[0], np.diff(heights)[0]
            if width > 0 and height > 0:
                axes.add_patch(Rectangle((ends[0], heights[0]), width, height, fill=False, ec=PATCH, lw=1.2))
                if not named:
                    middle = (ends.mean(), heights.mean())
                    turn = 90 if width < 8 else 0
                    axes.text(*middle, obstacle.name, label | {"rotation": turn})
                    named = True
    save(figure, f"tasks/{task}.png")


def normalised(task: str, name: str, key: str) -> float:
    """A number of an evaluation on a scale where the paper's resting robot has 0 and its CFP 1."""
    case = (UNDISTURBED, "lite") if name in ("zero", "random") else (OWN_START, "full")
    return paper.normalised(task, float(evaluated(task, name, *case)[key]))


def draw_returns() -> None:
    """The normalised returns of all tasks, from the lowest to the highest episode."""
    tasks = [row["task"] for row in read("training.csv") if row["policy"] == row["task"]][::-1]
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.axvline(0, color="0.8", zorder=0)
    axes.axvline(1, color=PAPER, linestyle="--", zorder=0)
    for row, task in enumerate(tasks):
        for name, colour in (("zero", ZERO), ("random", RANDOM)):
            axes.plot(normalised(task, name, "mean"), row, "|", ms=11, mew=2, color=colour)
        low, mean, high = (normalised(task, task, key) for key in ("lowest", "mean", "highest"))
        axes.plot((low, high), (row, row), color=OURS, lw=2)
        axes.plot(mean, row, "o", ms=8, color=OURS)
    axes.set_yticks(range(len(tasks)), map(name_of, tasks))
    axes.set_xlabel("return; 0: a robot at rest, 1: the paper's CFP")
    axes.tick_params(axis="y", length=0)
    axes.spines[["left", "top", "right"]].set_visible(False)
    entries = [
        Line2D([], [], marker="o", ms=8, lw=2, color=OURS, label="this package, lowest to highest episode"),
        Line2D([], [], color=PAPER, linestyle="--", label="paper's CFP"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color=ZERO, label="zero actions"),
        Line2D([], [], marker="|", ms=11, mew=2, lw=0, color=RANDOM, label="random actions"),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=2, frameon=False)
    save(figure, "returns.svg")


#: What rows of trainings with the default options say of them: the default once, and today.
DEFAULT = ("", "critics alone for 2250 steps", "critics alone for 2250 steps; another processor")


def draw_rewards() -> None:
    """Evaluations during long trainings from rewards, in thousands of steps and of the return."""
    trainings: dict[str, dict[tuple[str, str], list[tuple[float, float]]]] = {}
    for row in read("rewards-long.csv"):
        if row["change"] in DEFAULT:
            point = int(row["step"]) / 1000, int(row["mean"]) / 1000
            trainings.setdefault(row["task"], {}).setdefault((row["seed"], row["change"]), []).append(point)
    figure = Figure(figsize=(8.6, 4.2), layout="constrained")
    for axes, task in zip(figure.subplots(2, 4).flat, paper.CURVES, strict=True):
        lines = list(trainings[task].values())
        for points in lines:
            axes.plot(*zip(*points, strict=True), color=OURS, lw=0.7, alpha=0.5)
        shared = [np.mean(points, axis=0) for points in zip(*lines, strict=False)]  # as far as the shortest
        axes.plot(*zip(*shared, strict=True), color=OURS, lw=1.5, marker=".", ms=5)
        zero = float(evaluated(task, "zero", UNDISTURBED, "lite")["mean"])
        axes.axhline(zero / 1000, color=ZERO, lw=1)
        axes.axhline(paper.CURVES[task][0][0] / 1000, color=PAPER, lw=1, ls="--")
        axes.axhline(paper.CURVES[task][1][0] / 1000, color=PAPER, lw=1, ls=":")
        axes.set_title(name_of(task), fontsize=9)
        axes.set_xlim(left=0)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("thousand steps", fontsize=9)
    figure.supylabel("return, thousands", fontsize=9)
    entries = [
        Line2D([], [], color=OURS, lw=0.7, alpha=0.5, label="coarse stage of each training, 2,000 particles"),
        Line2D([], [], marker=".", lw=1.5, ms=5, color=OURS, label="mean"),
        Line2D([], [], color=PAPER, lw=1, ls="--", label="paper's CFP"),
        Line2D([], [], color=PAPER, lw=1, ls=":", label="paper's coarse policy"),
        Line2D([], [], color=ZERO, lw=1, label="zero actions"),
    ]
    figure.legend(handles=entries, loc="outside upper center", ncols=5, columnspacing=1.2, frameon=False)
    save(figure, "rewards.svg")


def main() -> None:
    """Draw everything."""
    draw_step()
    draw_windows()
    for task in dittogym.TASKS:
        draw_scene(task)
    draw_returns()
    draw_rewards()


if __name__ == "__main__":
    main()
