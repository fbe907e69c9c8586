"""Films of the policies that come with the package: `python docs/media.py [POLICY ...]`.

Each policy gets `images/films/POLICY.webp`, that of OBSTACLE some moments beside each other in `images/hero.png`, and
those of all tasks together, one policy for each (`SHOWN`), `images/tasks.webp`. The hash of the policy
behind each film is kept in `images/films/sources.json`; a test compares them with those of the package.
"""

import argparse
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import cfp
import dittogym
from dittogym.render.film import write_film
from dittogym.render.frame import INK, Canvas
from dittogym.render.recording import Recording
from dittogym.tasks import headline

IMAGES = Path(__file__).resolve().parent / "images"
SHIPPED = Path(cfp.__file__).parent / "pretrained"
FILMS = IMAGES / "films"
SOURCES = FILMS / "sources.json"
POLICIES = sorted(path.stem for path in SHIPPED.glob("*.safetensors"))
#: In the film of all tasks, where a task has two: the policy that reaches the goal, or stays in one piece.
SHOWN = {"grow": "grow-success", "slot": "slot-success", "obstacle": "obstacle-rewards"}
#: Pixels of a task's own film and of a cell of the grid, and cells in a row.
SIZE, CELL, COLUMNS = 360, 240, 4
#: White pixels between pictures beside each other.
BETWEEN = 8
#: Duration of a film, s, and pictures per second.
SECONDS, RATE = 6.0, 10
#: Of the moments beside each other: the policy, their number, what each shows of the world, m, and its pixels.
HERO, MOMENTS = "obstacle", 4
LEFT, RIGHT, BOTTOM, TOP = -0.08, 0.80, 0.10, 0.45
LAST = 0.63  # where the robot's centre is at the last moment, m
WIDE = 320


def record_policy(name: str) -> Recording:
    """One episode of a policy at the lite tier."""
    policy = cfp.load(name)
    env = dittogym.TorchEnv(policy.description["task"], particles="lite", resolution=policy.resolution)
    return env.film(policy, seed=0)


def policy_hash(name: str) -> str:
    """Hash of a policy that comes with the package."""
    return hashlib.sha256((SHIPPED / f"{name}.safetensors").read_bytes()).hexdigest()


def grid_frames(recordings: dict[str, Recording]) -> list[np.ndarray]:
    """The film of all tasks, each from the start to the end of its episode."""
    frames = []
    for moment in np.linspace(0.0, 1.0, round(SECONDS * RATE)):
        cells = []
        for task, recording in recordings.items():
            time = moment * recording.duration
            picture = recording.picture(time, size=CELL, caption=(headline(task)[0], f"{time:.1f} s"))
            cells.append(np.pad(picture, ((0, BETWEEN), (0, BETWEEN), (0, 0)), constant_values=255))
        rows = [np.concatenate(cells[i : i + COLUMNS], 1) for i in range(0, len(cells), COLUMNS)]
        frames.append(np.concatenate(rows, 0)[:-BETWEEN, :-BETWEEN])
    return frames


def moments(recording: Recording) -> np.ndarray:
    """Moments between which the robot comes equally far, seen by a camera that rests, with their times below."""
    places = np.array([shot.centre[0] for shot in recording.shots])
    span = RIGHT - LEFT
    rows = slice(*(round((span - y) / span * WIDE) for y in (TOP, BOTTOM)))
    side = MOMENTS * (WIDE + BETWEEN) - BETWEEN
    below = Canvas(side, np.zeros(2))
    below.font, below.image[:] = 20, 255
    pictures = []
    for number, place in enumerate(np.linspace(places[0], LAST, MOMENTS)):
        step = int(np.argmax(places >= place - 1e-6))
        there = {"origin": np.array((LEFT, 0.0)), "view": np.full(2, span / 2)}
        still = replace(recording, shots=[recording.shots[step]._replace(**there)])
        picture = still.picture(0.0, size=WIDE, zoom=1 / span)[rows]
        pictures += [picture, np.full((len(picture), BETWEEN, 3), 255, np.uint8)]
        middle = number * (WIDE + BETWEEN) + WIDE // 2
        below.text(f"{step * recording.scene.dt:.2f} s", (middle, 4), INK, 0.5)
    below.legend([], muscles=True)
    return np.concatenate([np.concatenate(pictures[:-1], 1), below.image[: below.strip(2)]])


def main() -> None:
    """Make the films of some policies, or of all, and the grid."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="*", metavar="POLICY", help="all by default")
    names = parser.parse_args().policies
    if unknown := [name for name in names if name not in POLICIES]:
        parser.error(f"policy must be one of {', '.join(POLICIES)}, got {unknown[0]}")
    sources = json.loads(SOURCES.read_text()) if SOURCES.exists() else {}
    recordings = {name: record_policy(name) for name in POLICIES}
    for name in names or recordings:
        speed = max(0.1, round(recordings[name].duration / SECONDS, 1))
        recordings[name].save(FILMS / f"{name}.webp", size=SIZE, rate=RATE, speed=speed)
        sources[name] = policy_hash(name)
    if HERO in (names or recordings):
        Image.fromarray(moments(recordings[HERO])).save(IMAGES / "hero.png", optimize=True)
    shown = {task: recordings[SHOWN.get(task, task)] for task in dittogym.TASKS}
    write_film(IMAGES / "tasks.webp", grid_frames(shown), RATE)
    SOURCES.write_text(json.dumps(dict(sorted(sources.items())), indent=2) + "\n")


if __name__ == "__main__":
    main()
