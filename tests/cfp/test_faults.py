"""A full disk, and files of another run where this one's should be."""

import pickle
import resource
import shutil
from contextlib import contextmanager

import pytest
import torch
from tiny_runs import assert_same_run, at_step, run

import cfp
from cfp import evaluate
from cfp.experiment.callbacks import StopCallback
from cfp.policy import read_policy, write_policy

pytestmark = pytest.mark.usefixtures("short")


@contextmanager
def small_files():
    """No file may grow beyond a mebibyte: a state no longer fits."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.slow
def test_full_disk_is_an_error_and_the_last_checkpoint_still_good(finished, tmp_path, capsys):
    folder = tmp_path / "run"
    with small_files() as fill, at_step(50, fill):
        assert run(folder) == 1
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith(f"error: [Errno 27] File too large: '{folder}")
    assert not list(folder.rglob("*.part"))
    assert run(folder, "--resume") == 0
    assert f"resuming {folder} at step 40 of 150" in capsys.readouterr().out
    assert_same_run(folder, finished)


@pytest.mark.parametrize("changes", [{"task": "run"}, {"resolution": 16}])
def test_policy_of_another_run_is_refused(finished, tmp_path, capsys, changes):
    folder = shutil.copytree(finished, tmp_path / "run")
    path = folder / "policy.safetensors"
    tensors, description = read_policy(path)
    write_policy(path, tensors, description | changes)
    assert evaluate.main([str(folder), "--episodes", "1", "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert f"{path}: " in error and str(next(iter(changes.values()))) in error and "stage 2 of this run" in error


def test_loading_a_policy_unpickles_nothing(finished, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("unpickled")

    for owner, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(owner, name, refuse)
    assert cfp.load(finished).description["task"] == "shapematch"


def test_first_stage_of_other_resolutions_is_refused(finished, tmp_path, capsys):
    folder = tmp_path / "run"
    options = "--steps 40 --handover 20 --resolutions 8 16 --eval-every 0 --eval-episodes 1".split()
    assert run(folder, *options) == 0
    for suffix in ("safetensors", "json"):
        (folder / f"stage1.{suffix}").write_bytes((finished / f"stage1.{suffix}").read_bytes())
    assert run(folder, *options, "--steps", "50", "--resume") == 2
    assert "stage1.safetensors: weights and description do not match" in capsys.readouterr().err


def test_a_training_that_diverges_says_that_its_checkpoint_is_whole(finished, tmp_path, capsys):
    folder, on_step = tmp_path / "run", StopCallback._on_step

    def act(callback):
        if callback.stage.step == 50:
            next(callback.stage.algorithm.model.actor.parameters()).data.fill_(torch.nan)
        return on_step(callback)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StopCallback, "_on_step", act)
        assert run(folder) == 1
    assert "; the last checkpoint is untouched" in capsys.readouterr().err
    assert run(folder, "--resume") == 0
    assert_same_run(folder, finished)
