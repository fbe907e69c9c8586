"""A full disk, and files of another run where this one's should be."""

import pickle
import resource
import subprocess
from contextlib import ExitStack, contextmanager, suppress

import pytest
import torch
from test_train import run

import cfp
from cfp import evaluate
from cfp.experiment.callbacks import StopCallback
from cfp.weights import read_policy, write_policy

SHORT = "--steps 80 --handover 40 --eval-every 40 --log-every 10".split()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "short"
    assert run(folder, *SHORT) == 0
    return folder


@contextmanager
def small_files(folder):
    """No file may grow beyond a mebibyte: a state no longer fits."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@contextmanager
def full_disk(folder):
    """Another program fills the disk to the last byte."""
    filler = folder.parent / "filler"
    with open(filler, "wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    try:
        yield
    finally:
        filler.unlink()


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 48 MiB of its own."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(place)], capture_output=True)
    if done.returncode:
        pytest.skip("mounting a file system needs the rights of root")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize(
    ("place", "full", "message"),
    [
        ("tmp_path", small_files, "[Errno 27] File too large"),
        ("small_disk", full_disk, "[Errno 28] No space left on device"),
    ],
)
def test_full_disk_is_an_error_and_the_last_checkpoint_still_good(
    finished, request, monkeypatch, capsys, place, full, message
):
    folder, on_step = request.getfixturevalue(place) / "run", StopCallback._on_step
    with ExitStack() as stack:

        def fill(callback):
            if callback.stage.step == 50:
                stack.enter_context(full(folder))
            return on_step(callback)

        monkeypatch.setattr(StopCallback, "_on_step", fill)
        assert run(folder, *SHORT) == 1
    monkeypatch.undo()
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"error: {message}: '{folder}")
    assert not list(folder.rglob("*.part"))
    assert run(folder, *SHORT, "--resume") == 0
    assert f"resuming {folder} at step 40 of 80" in capsys.readouterr().out
    for name in ("progress.csv", "evaluations.csv", "results.json"):
        assert (folder / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"task": "run"},
            "must be a policy for shapematch on a grid of 8, got one for run on a grid of 8",
        ),
        ({"resolution": 16}, "got one for shapematch on a grid of 16"),
    ],
)
def test_policy_of_another_run_is_refused(finished, capsys, changes, message):
    path = finished / "policy.safetensors"
    tensors, description = read_policy(path)
    try:
        write_policy(path, tensors, description | changes)
        assert evaluate.main([str(finished), "--episodes", "1", "--device", "cpu"]) == 2
    finally:
        write_policy(path, tensors, description)
    error = capsys.readouterr().err
    assert str(path) in error and message in error


def test_loading_a_policy_unpickles_nothing(finished, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("unpickled")

    for owner, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(owner, name, refuse)
    assert cfp.load(finished).description["task"] == "shapematch"


def test_first_level_of_another_ladder_is_refused(finished, tmp_path, capsys):
    folder = tmp_path / "run"
    assert run(folder, *SHORT, "--resolutions", "8", "16") == 0
    for suffix in ("safetensors", "json"):
        (folder / f"stage1.{suffix}").write_bytes((finished / f"stage1.{suffix}").read_bytes())
    assert run(folder, *SHORT, "--resolutions", "8", "16", "--steps", "100", "--resume") == 2
    assert "stage1.safetensors: weights and description do not match" in capsys.readouterr().err
