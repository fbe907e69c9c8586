"""A training of seconds: a robot of a hundred particles that moves one substep at a time."""

from contextlib import contextmanager

import pytest

from cfp import train
from cfp.experiment.callbacks import StopCallback

TINY = (
    "--task shapematch --learner sac --particles 100 --substeps 1 --num-envs 2 --resolutions 4 8 --steps 150 "
    "--handover 70 --random-steps 10 4 --batch-size 4 --buffer-size 60 --update-start 8 --actor-start 0 "
    "--gradient-steps 1 --eval-every 60 --eval-episodes 2 --checkpoint-every 20 --log-every 10 --no-video "
    "--device cpu"
).split()
TABLES = ("progress.csv", "evaluations.csv", "results.json")


def run(folder, *more):
    return train.main([*TINY, "--out", str(folder), *more])


def assert_same_run(folder, other, tables=TABLES):
    for name in tables:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


@contextmanager
def at_step(step, action):
    """Do something at a step of the run, after everything else that is done there."""
    on_step = StopCallback._on_step

    def act(callback):
        if callback.stage.step == step:
            action()
        return on_step(callback)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StopCallback, "_on_step", act)
        yield
