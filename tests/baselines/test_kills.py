"""Trainings that are killed outright (``kill -9``) again and again, and go on each time."""

import os
import random
import subprocess
import sys
import time

import pytest
from test_programs import options_of, run

import baselines
from cfp.experiment.checkpoint import Checkpoint
from cfp.tables import read_table

#: Long enough that most kills hit the training itself, which comes within these seconds after its first words.
STEPS = {"cfp-sac": "--steps 160 --handover 0.5", "shac": "--steps 480", "distill": "--steps 160 --handover 0.5"}
SPAN = 3.0


@pytest.mark.slow
@pytest.mark.parametrize("algo", STEPS)
def test_killed_training_ends_like_one_that_was_left_alone(algo, tmp_path):
    alone, folder = tmp_path / "alone", tmp_path / "killed"
    assert run(algo, alone, *STEPS[algo].split()) == 0
    options = [*options_of(algo, folder), "--task", "shapematch", *STEPS[algo].split()]
    command = [sys.executable, "-u", "-m", "baselines.train", *options, "--resume"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}  # as here; other numbers of threads give other last digits
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    chance, codes, rows = random.Random(0), [], read_table(alone / "evaluations.csv")
    for is_last in (False, False, False, True):
        with subprocess.Popen(command, env=environment, **pipes) as process:
            assert any(line.startswith(f"{algo} on shapematch") for line in process.stdout)
            if not is_last:
                time.sleep(chance.uniform(0.0, SPAN))
                process.kill()
            codes.append(process.wait())
        # What is there can be read to its end.
        seen = read_table(folder / "evaluations.csv")
        assert seen == rows[: len(seen)]
        for path in folder.glob("*.safetensors"):
            baselines.load(path)
        if (folder / "checkpoint" / "state.pt").exists():
            Checkpoint(folder / "checkpoint").read()
    assert codes[-1] == 0 and -9 in codes
    for name in ("evaluations.csv", "progress.csv", "results.json"):
        assert (folder / name).read_bytes() == (alone / name).read_bytes()
    assert not list(folder.rglob("*.part"))
