"""Writes a page for each task from its `TaskSpec`; only the descriptions of the scenes are written by hand."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import jinja2
from PIL import Image

import dittogym
from dittogym.bodies.positions import particle_counts
from dittogym.geometry import Obstacle
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks import headline
from torchmpm import Snow, VelocityRule

DOCS = Path(__file__).resolve().parent
NOTES, PAGES = DOCS / "tasks", DOCS / "generated"
SIZE = 384

#: Description of each task's scene.
SCENES = {
    "shapematch": "A disc of 17 cm lies in the middle of the window, without gravity.",
    "run": "A disc of 18 cm stands on a floor on which nothing slips.",
    "grow": "A block of 16 × 16 cm stands on the floor. One beam reaches in from the right, 15 cm above the floor, and "
    "another from the left, 27 cm above it. The goal is above the left one.",
    "kick": "A disc of 18 cm stands on the floor. An elastic cube of 5 cm lies to its right.",
    "dig": "A disc of 14 cm starts above a bed of soil, 50 cm wide and 33 cm deep, between two walls. The goal is near "
    "the bottom on the right.",
    "obstacle": "A block of 16 × 16 cm stands in front of stairs that are highest, 5 cm, on the robot's side.",
    "catch": "A disc of 18 cm lies on the right one of two blocks, between which a shaft of 9 cm leads down. An "
    "elastic cube of 5 cm lies on the floor below the shaft. The goal is to the right of it, below the right block.",
    "slot": "The way leads below a hanging block and a shelf. Behind the shelf stands a post, and the cap, an elastic "
    "plate of 13 × 3 cm, lies on both and covers the opening between them.",
}

TEMPLATE = """# [[ title ]]

[[ what ]]

```{image} ../images/films/[[ spec.name ]].webp
:alt: An episode of the pretrained policy
```

The pretrained policy with 2,000 particles; contraction is red, expansion blue.
<a href="../replays/[[ spec.name ]].html">Replay of a whole episode</a>, to pause, scrub and recolour.

## Scene

[[ scene ]]

```{image} [[ spec.name ]]-rest.png
:alt: The whole simulation window in the initial state
```

## Use

| | |
| --- | --- |
| Environments | `dittogym/[[ spec.name ]]-coarse-v0`, `dittogym/[[ spec.name ]]-fine-v0` |
| Action space | `Box(-1, 1, (2, [[ spec.coarse ]], [[ spec.coarse ]]), float32)`, fine: \
`(2, [[ spec.fine ]], [[ spec.fine ]])`; \
[muscle stress](../concepts/actions.md) along x and y |
| Observation space | `Box(0, 255, (3, 64, 64), uint8)`: occupancy, horizontal and vertical velocity |
| Steps in an episode | [[ spec.horizon ]], of 10 ms each |

```python
import cfp, gymnasium

policy = cfp.load("[[ spec.name ]]")
options = {"particles": "lite", "resolution": policy.resolution}
env = gymnasium.make("dittogym/[[ spec.name ]]-coarse-v0", **options)
env.unwrapped.film(policy, "[[ spec.name ]].webp")
```

```bash
python -m cfp.play [[ spec.name ]] --policy [[ spec.name ]]   # in the browser
python -m cfp.train --task [[ spec.name ]] --out runs/[[ spec.name ]]
```

## Arguments

This task has the [arguments of all tasks](../tasks.md#arguments).
[[ notes ]]

## Results

```{include} returns-[[ spec.name ]].md
```

[](../results.md) explains how the pretrained policies and the planners were evaluated, and
[](../experiments/rewards.md) the coarse stage of `--learner sac`, and [](../experiments/algorithms.md) the other
algorithms. `coarse`, `fine`, `gnn-*` and `transformer-*`, and `cfp` where no learner is named, were measured with
earlier defaults.

## Geometry

Ranges of nodes are inclusive, and nodes are counted from the origin of the world, 128 per metre. Where several rules
for the same direction cover a node, the first one applies.

| Obstacle | In the observation | Velocity rules |
| --- | --- | --- |
[% for row in geometry %]| [[ row | join(" | ") ]] |
[% endfor %]
## Constants

| | |
| --- | --- |
[% for name, value in numbers %]| [[ name ]] | [[ value ]] |
[% endfor %]
## Versions

- `v0`: the dynamics and rewards of the reference implementation, with the exceptions listed in
  [](../concepts/deviations.md).
"""


#: Square brackets, because the pages hold curly ones.
ENVIRONMENT = jinja2.Environment(
    undefined=jinja2.StrictUndefined,
    variable_start_string="[[",
    variable_end_string="]]",
    block_start_string="[%",
    block_end_string="%]",
)


def write_pages() -> None:
    """Write `generated/{task}.md` and a picture for every task."""
    PAGES.mkdir(exist_ok=True)
    write(PAGES / "summary.md", summary())
    for name in dittogym.TASKS:
        spec, module = dittogym.make_spec(name), importlib.import_module(f"dittogym.tasks.{name}")
        picture(name)
        title, what = headline(name)
        context: dict[str, Any] = {"spec": spec, "weights": spec.weights, "module": module}
        notes = ENVIRONMENT.from_string((NOTES / f"{name}.md").read_text()).render(context)
        page = ENVIRONMENT.from_string(TEMPLATE).render(
            **context,
            title=title,
            what=what,
            scene=SCENES[name],
            notes=notes,
            numbers=numbers(spec),
            geometry=[row(obstacle) for obstacle in spec.obstacles],
        )
        write(PAGES / f"{name}.md", page)


def write(path: Path, text: str) -> None:
    """Write a file if its content has changed; Sphinx reads it again only then."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def summary() -> str:
    """A table of all tasks."""
    lines = [
        "| Task | Goal | Steps | Action resolution: coarse, fine | Objects |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in dittogym.TASKS:
        spec, (_, what) = dittogym.make_spec(name), headline(name)
        objects = ", ".join(matter(body) for body in spec.objects)
        lines.append(
            f"| [`{name}`](generated/{name}.md) | {what} | {spec.horizon} | {spec.coarse}, {spec.fine} | {objects} |"
        )
    return "\n".join(lines) + "\n"


def numbers(spec: TaskSpec) -> list[tuple[str, str]]:
    """Names and values of the constants of a task."""
    full, lite = (particle_counts(spec, tier) for tier in ("full", "lite"))
    window = spec.window
    rows = [
        ("steps per episode", f"{spec.horizon}"),
        (
            "action resolution, coarse and fine",
            f"{spec.coarse} × {spec.coarse} and {spec.fine} × {spec.fine}, two muscle directions",
        ),
        ("width of the action patch", f"{spec.patch} nodes"),
        (
            "particles of the robot, full and lite",
            f"{full[0]:,} and {lite[0]:,}, {spec.robot.mass:g} kg each with full particles",
        ),
    ]
    for body, one, other in zip(spec.objects, full[1:], lite[1:], strict=True):
        rows.append((f"particles of the object ({matter(body)})", f"{one:,} and {other:,}, {body.mass:g} kg each"))
    rows += [
        ("Lamé parameters μ, λ", f"{spec.mu:g} Pa, {spec.lam:g} Pa"),
        ("yield stress", f"{spec.yield_stress:g} Pa"),
        ("muscle stress for an action of 1", f"{spec.max_actuation:g} Pa"),
        ("gravity", f"{spec.gravity[1]:g} m/s²"),
        ("damping factor of the node velocities per 0.1 ms", f"{spec.damping:g}"),
        (
            "simulation window",
            f"from x = {window.left:g} m"
            if window.follow is None
            else f"{window.follow:g} m behind the robot's centre",
        ),
        ("centre of the observed region", centre(spec.view)),
        ("centre of the action patch", centre(spec.patch_centre)),
        (
            "spread limit of the robot",
            "none" if spec.split_limit is None else f"{spec.split_limit:g} m",
        ),
    ]
    if spec.goal is not None:
        rows.append(("goal, drawn in the observation", f"({spec.goal[0]:g}, {spec.goal[1]:g}) m"))
    return rows


def matter(body: BodySpec) -> str:
    """Material of an object."""
    return "soil" if isinstance(body.material, Snow) else "elastic"


def centre(place: tuple[float | None, float | None]) -> str:
    """Describe a centre in window coordinates."""
    x, y = (("the robot's" if value is None else f"{value:g} m") for value in place)
    return f"x: {x}, y: {y}"


def row(obstacle: Obstacle) -> tuple[str, str, str]:
    """Name, visibility and velocity rules of an obstacle."""
    rules = "<br>".join(dict.fromkeys(map(describe, obstacle.velocity_rules)))
    return obstacle.name, "yes" if obstacle.observed_boxes else "no", rules


def describe(rule: VelocityRule) -> str:
    """Describe a velocity rule."""
    ways = {"+x": "to the right", "-x": "to the left", "+y": "upwards", "-y": "downwards"}
    where = [
        f"{axis} {extent(low, high)}"
        for axis, (low, high) in (("i", rule.i), ("j", rule.j))
        if (low, high) != (None, None)
    ]
    hold = f", friction {rule.friction:g}" if rule.friction else ""
    if math.isinf(rule.friction):
        hold = ", no slip"
    frame = " of the window" if rule.frame == "window" else ""
    return f"no motion {ways[rule.direction]}{hold}: {', '.join(where) or 'everywhere'}{frame}"


def extent(low: int | None, high: int | None) -> str:
    """Describe an inclusive range of nodes."""
    if low is None:
        return f"≤ {high}"
    if high is None:
        return f"≥ {low}"
    return f"{low}" if low == high else f"{low} … {high}"


def picture(task: str) -> None:
    """Draw the whole window of a task in its initial state, unless an earlier build has done so."""
    path = PAGES / f"{task}-rest.png"
    if not path.exists():
        env = dittogym.TorchEnv(task, particles="lite")
        env.reset(seed=0)
        Image.fromarray(env.render(size=SIZE, zoom=1)).save(path)
