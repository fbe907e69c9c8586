"""Trainings that are killed outright (``kill -9``) again and again, and go on each time.

``KILLS=20 python -m pytest -m "" tests/baselines/test_kills.py`` kills each of them twenty times.
"""

import json
import os
import random
import subprocess
import sys
import time

import pytest
from test_programs import COMMON, TINY, run

import baselines
from cfp.experiment.checkpoint import Checkpoint
from cfp.tables import read_table

KILLS = int(os.environ.get("KILLS", "3"))
#: Seconds after its first words within which a training is killed.
SPAN = 3.0
#: Long enough that most kills hit the training itself.
STEPS = {"cfp-sac": "--steps 160 --handover 0.5", "shac": "--steps 480", "distill": "--steps 160 --handover 0.5"}
TABLES = ("evaluations.csv", "progress.csv", "results.json")


def begin(algo, folder):
    """Start or resume a training in a process of its own; returns once it has read its options."""
    options = [*COMMON, "--task", "shapematch", "--algo", algo, *TINY[algo][0].split(), *STEPS[algo].split()]
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "baselines.train", *options, "--out", str(folder), "--resume"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},  # as here; another number of threads gives other last digits
    )
    assert any(line.startswith(f"{algo} on shapematch") for line in process.stdout)
    return process


def check_whole(folder):
    """Every file that is there can be read to its end, and what is written aside is not taken for one."""
    for path in folder.rglob("*.json"):
        json.loads(path.read_text())
    for path in folder.glob("*.safetensors"):
        baselines.load(path)
    if (folder / "checkpoint" / "state.pt").exists():
        Checkpoint(folder / "checkpoint").read()
    return [row["step"] for row in read_table(folder / "evaluations.csv")]


@pytest.mark.slow
@pytest.mark.parametrize("algo", STEPS)
def test_killed_training_ends_like_one_that_was_left_alone(algo, tmp_path):
    alone = tmp_path / "alone"
    assert run(algo, alone, *STEPS[algo].split()) == 0
    steps = [row["step"] for row in read_table(alone / "evaluations.csv")]
    chance, kills, lives = random.Random(0), 0, 0
    while kills < KILLS or lives == 0:
        folder, finished = tmp_path / f"killed{lives}", False
        while not finished:
            with begin(algo, folder) as process:
                if kills < KILLS:
                    time.sleep(chance.uniform(0.0, SPAN))
                    process.kill()
                finished = process.wait() == 0
            kills += not finished
            assert finished or process.returncode == -9
            seen = check_whole(folder)
            assert seen == steps[: len(seen)]
        lives += 1
        for name in TABLES:
            assert (folder / name).read_bytes() == (alone / name).read_bytes()
        assert not list(folder.rglob("*.part"))
    print(f"{algo}: killed {kills} times in {lives} run(s)")
