"""Films of the tasks, with the policies that come with the package: `python docs/media.py [TASK ...]`.

Each task gets `images/films/TASK.webp`, and all of them together `images/tasks.webp`. `images/films/sources.json` keeps
the hash of the policy behind each film; a test compares them with those of the package.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import torch

import cfp
import dittogym
from cfp.weights import SHIPPED
from dittogym.render.film import write_film
from dittogym.render.recording import Recording
from dittogym.tasks import headline

IMAGES = Path(__file__).resolve().parent / "images"
FILMS = IMAGES / "films"
SOURCES = FILMS / "sources.json"
#: Pixels of a task's own film and of a cell of the grid, and cells in a row.
SIZE, CELL, COLUMNS = 360, 240, 4
#: Duration of a film, s, and pictures per second.
SECONDS, RATE = 6.0, 10
#: Seed of the episode, where that of seed 0 is not typical: in GROW it earns 3,061, those of other seeds about 8,000.
SEEDS = {"grow": 1}


def record_task(task: str) -> Recording:
    """One episode of a task at the lite tier."""
    seed = SEEDS.get(task, 0)
    policy = cfp.load(task)
    env = dittogym.TorchEnv(task, particles="lite", resolution=policy.resolution)
    with torch.random.fork_rng():
        torch.manual_seed(seed)  # policies act with noise
        return env.film(policy, seed=seed)


def write_replays(folder: Path) -> None:
    """Write `TASK.html`, an episode of each task, unless it is newer than the policy."""
    for task in dittogym.TASKS:
        path, policy = folder / f"{task}.html", SHIPPED / f"{task}.safetensors"
        if not path.exists() or path.stat().st_mtime < policy.stat().st_mtime:
            record_task(task).save(path)


def policy_hash(task: str) -> str:
    """Hash of the policy of a task that comes with the package."""
    return hashlib.sha256((SHIPPED / f"{task}.safetensors").read_bytes()).hexdigest()


def grid_frames(recordings: dict[str, Recording]) -> list[np.ndarray]:
    """The film of all tasks, each from the start to the end of its episode."""
    frames = []
    for moment in np.linspace(0.0, 1.0, round(SECONDS * RATE)):
        cells = []
        for task, recording in recordings.items():
            time = moment * recording.duration
            cells.append(recording.picture(time, size=CELL, caption=(headline(task)[0], f"{time:.1f} s")))
        rows = [np.concatenate(cells[i : i + COLUMNS], 1) for i in range(0, len(cells), COLUMNS)]
        frames.append(np.concatenate(rows, 0))
    return frames


def main(tasks: list[str]) -> None:
    """Make the films of some tasks, or of all, and the grid."""
    sources = json.loads(SOURCES.read_text()) if SOURCES.exists() else {}
    recordings = {task: record_task(task) for task in dittogym.TASKS}
    for task in tasks or dittogym.TASKS:
        speed = max(0.1, round(recordings[task].duration / SECONDS, 1))
        recordings[task].save(FILMS / f"{task}.webp", size=SIZE, rate=RATE, speed=speed)
        sources[task] = policy_hash(task)
    write_film(IMAGES / "tasks.webp", grid_frames(recordings), RATE)
    SOURCES.write_text(json.dumps(dict(sorted(sources.items())), indent=2) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
