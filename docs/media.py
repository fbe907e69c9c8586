"""Makes the films of the documentation from the pretrained policies: `python docs/media.py [TASK ...]`.

Each task gets `images/films/TASK.webp`, one episode at the lite tier on a layout that its policy was not trained on, and
all of them together `images/tasks.webp`. `images/films/sources.json` keeps the hash of the policy behind each film; a
test compares them with the policies of the package.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np

import cfp
import dittogym
from cfp.config import EVALUATION_SEED
from cfp.weights import SHIPPED
from dittogym.render.film import write_film
from dittogym.render.recording import Recording, record

IMAGES = Path(__file__).resolve().parent / "images"
FILMS = IMAGES / "films"
SOURCES = FILMS / "sources.json"
#: Pixels and pictures per second of a task's own film, and of one cell of the grid.
SIZE, RATE = 360, 15
CELL, COLUMNS = 240, 4
#: Seconds that the grid takes, whatever the length of the episodes.
GRID_SECONDS, GRID_RATE = 8.0, 12


def policy_hash(task: str) -> str:
    """Hash of the pretrained policy of a task."""
    return hashlib.sha256((SHIPPED / f"{task}.safetensors").read_bytes()).hexdigest()


def play(task: str) -> Recording:
    """An episode of the pretrained policy of a task."""
    policy = cfp.load(task)
    env = dittogym.TorchEnv(task, resolution=policy.resolution, particles="lite")
    return record(env, lambda observation: policy.predict(observation)[0], 2 * EVALUATION_SEED)


def grid(recordings: dict[str, Recording]) -> None:
    """Write the film of all tasks, each from the start to the end of its episode."""
    frames = []
    for moment in np.linspace(0.0, 1.0, round(GRID_SECONDS * GRID_RATE)):
        cells = []
        for task, recording in recordings.items():
            time = moment * recording.duration
            cells.append(recording.picture(time, size=CELL, caption=(task.upper(), f"{time:.1f} s")))
        rows = [np.concatenate(cells[i : i + COLUMNS], 1) for i in range(0, len(cells), COLUMNS)]
        frames.append(np.concatenate(rows, 0))
    write_film(IMAGES / "tasks.webp", frames, GRID_RATE)


def main(tasks: list[str]) -> None:
    sources = json.loads(SOURCES.read_text()) if SOURCES.exists() else {}
    recordings = {task: play(task) for task in dittogym.TASKS}
    for task in tasks or dittogym.TASKS:
        speed = max(0.5, recordings[task].duration / 10.0)  # at most ten seconds
        recordings[task].save(FILMS / f"{task}.webp", size=SIZE, rate=RATE, speed=round(speed, 1))
        sources[task] = policy_hash(task)
    grid(recordings)
    SOURCES.write_text(json.dumps(dict(sorted(sources.items())), indent=2) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
