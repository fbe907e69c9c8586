"""Whole runs: what they leave, how they are stopped and resumed, and what goes wrong around them."""

import html
import json
import re
import resource
import shutil
import signal
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from tiny_runs import OF_LEARNER, ONE_STAGE, TABLES, assert_same_run, resume, run
from watching import at_step, interrupt

from cfp import registry
from cfp.config import to_json
from cfp.evaluation.returns import Played, Result
from cfp.experiment import callbacks
from cfp.experiment.checkpoint import Checkpoint
from cfp.policy import read_policy
from cfp.tables import read_table
from cfp.train import parse
from dittogym.render.frame import png
from dittogym.tasks.targets import load_target

pytestmark = pytest.mark.usefixtures("short")

SHORT = "--steps 40 --handover 0.5 --eval-every 0 --eval-episodes 1".split()


def terminate():
    signal.raise_signal(signal.SIGTERM)


def test_run_trains_both_stages_and_leaves_its_files(finished):
    progress, evaluations = read_table(finished / "progress.csv"), read_table(finished / "evaluations.csv")
    assert [row["step"] for row in progress] == [str(step) for step in range(10, 151, 10)]
    assert [row["stage"] for row in progress] == ["1"] * 7 + ["2"] * 8
    assert [row["step"] for row in evaluations] == ["60", "70", "70", "120", "150"]
    assert progress[-1]["train/gate"] and not progress[3]["train/gate"]
    stages = [json.loads((finished / name).read_text()) for name in ("stage1.json", "policy.json")]
    assert [(stage["stage"], stage["resolution"]) for stage in stages] == [(1, 4), (2, 8)]
    for stage in stages:  # each is the policy with the best evaluation of its stage, the first of equals
        rows = [row for row in evaluations if int(row["stage"]) == stage["stage"]]
        assert stage["steps"] == int(max(rows, key=lambda row: float(row["mean"]))["step"])
    results = json.loads((finished / "results.json").read_text())
    assert [row["policy"] for row in results] == ["zero action", "random action", "stage 1", "stage 2"]
    assert [row["action"] for row in results] == ["4x4", "4x4", "4x4", "8x8"]


@pytest.mark.parametrize("learner", ["sac", "analytic"])
def test_the_seed_of_a_run_chooses_its_first_weights(learner, tmp_path):
    config = parse(OF_LEARNER[learner]).run
    actors = [
        registry.find(config.algo).create(replace(config, seed=seed), 1, tmp_path).trained_actor for seed in (0, 0, 1)
    ]
    first, again, other = (torch.nn.utils.parameters_to_vector(actor.mean.parameters()) for actor in actors)
    assert torch.equal(first, again) and not torch.equal(first, other)


@pytest.mark.parametrize("precision", ["double", "autocast"])
@pytest.mark.parametrize("learner", OF_LEARNER)
def test_networks_have_single_precision_whatever_that_of_torch_is(learner, precision, tmp_path):
    torch.set_default_dtype(torch.float64 if precision == "double" else torch.float32)
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "autocast"):
        assert run(tmp_path, *SHORT, learner=learner) == 0
    weights, _ = read_policy(tmp_path)
    assert {tensor.dtype for tensor in weights.values()} == {torch.float32}


def test_the_end_of_a_run_names_an_earlier_stage_that_returns_more(finished, tmp_path, monkeypatch, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")

    def named(**returns):
        episodes = {name.replace("_", " "): (Played(value, None, False, 1.0, 1.0),) for name, value in returns.items()}
        results = [Result(name, 4, played) for name, played in episodes.items()]
        monkeypatch.setattr("cfp.experiment.run.compare", lambda *_: results)
        assert resume(folder) == 0
        return re.findall(r"(stage .) has the highest mean return", capsys.readouterr().out)

    assert named(zero_action=9.0, random_action=9.0, stage_1=2.0, stage_2=1.0) == ["stage 1"]
    assert named(zero_action=0.0, random_action=0.0, stage_1=1.0, stage_2=2.0) == []


# The first stop of soft actor-critic is in its random phase; one of each learner is between the stages.
@pytest.mark.parametrize(("learner", "stops"), [("sac", (8, 44, 70)), ("analytic", (48, 64))])
def test_run_that_is_stopped_and_killed_goes_on_as_if_nothing_had_happened(learner, stops, tmp_path, request, capsys):
    whole = request.getfixturevalue("finished" if learner == "sac" else "finished_analytic")
    folder = tmp_path / "stopped"

    def kill():
        raise RuntimeError("killed")

    with at_step(stops[0], interrupt):
        assert run(folder, learner=learner) == 128 + signal.SIGINT
    assert "--resume" in capsys.readouterr().out
    for before, stop in pairwise(stops):
        with at_step(stop, terminate):
            assert resume(folder) == 128 + signal.SIGTERM
        assert f"resuming {folder} at step {before}" in capsys.readouterr().out
    with at_step(88, kill), pytest.raises(RuntimeError, match="killed"):
        resume(folder)
    assert f"resuming {folder} at step {stops[-1]}" in capsys.readouterr().out
    assert resume(folder) == 0  # from its last checkpoint
    assert_same_run(folder, whole)


def test_run_stopped_in_an_evaluation_repeats_it(finished, tmp_path):
    folder, real = tmp_path / "stopped", callbacks.make_trial

    def stop(*arguments, **options):
        terminate()
        return real(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callbacks, "make_trial", stop)
        assert run(folder) == 128 + signal.SIGTERM
    assert read_table(folder / "evaluations.csv") == []
    evaluate_first = callbacks.RunCallback._on_training_start

    def crash(callback):
        evaluate_first(callback)
        raise RuntimeError("killed")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr(callbacks.RunCallback, "_on_training_start", crash)
        resume(folder)
    with at_step(66, interrupt):
        assert resume(folder) == 128 + signal.SIGINT
    rows = read_table(finished / "evaluations.csv")
    assert read_table(folder / "evaluations.csv") == rows[:1]  # the row of the killed session is not added again


@pytest.mark.slow
def test_layouts_that_are_drawn_anew_go_on_as_if_nothing_had_happened(tmp_path):
    options = ["--resample", *ONE_STAGE, "--steps", "128"]
    assert run(tmp_path / "whole", *options) == 0
    with at_step(80, interrupt):  # in the second episode; the third begins at 120
        assert run(tmp_path / "stopped", *options) == 128 + signal.SIGINT
    assert resume(tmp_path / "stopped") == 0
    assert_same_run(tmp_path / "stopped", tmp_path / "whole", ("progress.csv", "results.json"))


def test_only_some_options_may_change_when_a_run_is_resumed(finished, tmp_path, capsys):
    (tmp_path / "new.json").write_text('{"gamma": 0.5}')
    for options, named in (
        (["--task", "run"], "task: the run was started with 'shapematch', got 'run'"),
        (["--gamma", "0.5"], "gamma: the run was started with 0.95, got 0.5"),
        (["--config", str(tmp_path / "new.json")], "gamma: the run was started with 0.95, got 0.5"),
        (["--eval-episodes", "9"], "eval_episodes: the run was started with 2, got 9"),
        (["--learner", "analytic"], "algo must be 'cfp-sac', that of the run"),
    ):
        assert resume(finished, *options) == 2
        assert named in capsys.readouterr().err
    changed = "--steps 160 --backend eager --eval-every 7 --log-every 9 --no-video".split()
    assert parse(["--resume", "--out", str(finished), *changed]).run.eval_every == 7
    assert run(finished) == 2
    assert "already holds a run" in capsys.readouterr().err


def test_finished_run_can_be_prolonged_and_its_results_do_not_outlive_it(tmp_path, capsys):
    folder = tmp_path / "run"
    assert run(folder, "--resume", *SHORT) == 0
    assert "holds no run yet" in capsys.readouterr().out and (folder / "results.json").exists()
    with at_step(44, terminate):
        assert resume(folder, "--steps", "60", "--eval-every", "8") == 128 + signal.SIGTERM
    assert not (folder / "results.json").exists()
    assert resume(folder, "--eval-every", "0") == 0
    assert read_table(folder / "progress.csv")[-1]["step"] == "60" and (folder / "results.json").exists()
    assert read_policy(folder / "policy.safetensors")[1]["steps"] == 60  # without evaluations the newest is kept
    before = {path: path.read_bytes() for path in folder.glob("*.json")}
    capsys.readouterr()
    assert resume(folder, "--steps", "44") == 2
    assert "steps must be at least 60, those that the run has taken, got 44" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.glob("*.json")} == before


def test_a_run_that_failed_before_its_first_checkpoint_does_not_block_its_folder(tmp_path, capsys):
    def fail():
        raise OSError("no space left on device")

    with at_step(14, fail):
        assert run(tmp_path / "run", *SHORT) == 1
    assert run(tmp_path / "run", *SHORT) == 0
    assert "holds no checkpoint: starting from the beginning" in capsys.readouterr().out
    assert [row["step"] for row in read_table(tmp_path / "run" / "progress.csv")] == ["10", "20", "30", "40"]
    shutil.rmtree(tmp_path / "run" / "checkpoint")  # a finished run is not started anew
    assert run(tmp_path / "run", "--resume", *SHORT) == 2
    assert "the run is finished, but its checkpoint is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("step", "says"), [(50, "the last checkpoint is untouched"), (10, "there is no checkpoint yet")]
)
def test_a_training_that_diverges_says_whether_a_checkpoint_is_left(tmp_path, capsys, step, says):
    folder, on_step = tmp_path / "run", callbacks.RunCallback._on_step

    def act(callback):
        if callback.stage.step == step:
            next(callback.stage.learner.policy.actor.parameters()).data.fill_(torch.nan)
        return on_step(callback)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callbacks.RunCallback, "_on_step", act)
        assert run(folder) == 1
    error = capsys.readouterr().err  # without a bar, which is for long trainings where there is no terminal
    assert error.startswith("error: ") and error.endswith(f"; {says}\n")
    checkpoint = Checkpoint(folder / "checkpoint")
    if step == 50:
        state = checkpoint.read()
        assert state["num_timesteps"] == 40
        assert all(bool(weights.isfinite().all()) for weights in state["learner"]["policy"].values())
    assert checkpoint.path.exists() == (step == 50)


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
    assert resume(folder) == 0
    assert_same_run(folder, finished, TABLES)


def test_first_stage_of_other_resolutions_is_refused(finished, tmp_path, capsys):
    folder = shutil.copytree(finished, tmp_path / "run")
    shutil.copy(folder / "policy.safetensors", folder / "stage1.safetensors")
    assert resume(folder, "--steps", "160") == 2
    assert "stage1.safetensors: weights and description do not match" in capsys.readouterr().err


def test_page_shows_the_run_and_opens_from_disk(finished):
    page = (finished / "index.html").read_text()
    assert 'src="curve.png"' in page and "http" not in page and "<video" not in page  # filmed nothing
    for row in json.loads((finished / "results.json").read_text()):
        means = {f"{row['mean'] + rounding:.1f}</td>" for rounding in (-5e-4, 5e-4)}  # the file has three digits
        assert f">{row['policy']}</td>" in page and any(mean in page for mean in means)
    assert html.escape((finished / "config.json").read_text().strip()) in page
    assert "chose the policy" in page  # why the table and the curve differ


def test_page_of_a_run_with_a_film_and_a_target(tmp_path, capsys):
    folder, drawing = tmp_path / "run", tmp_path / "bar & box.png"
    pixels = np.full((90, 200, 3), 255, np.uint8)
    pixels[30:60, 20:120] = 0
    drawing.write_bytes(png(pixels))
    assert run(folder, *SHORT, "--video", "--target", str(drawing), "--seed", "3") == 0
    assert f"target: {folder / 'target.png'}" in capsys.readouterr().out
    target = load_target(drawing)
    assert np.array_equal(load_target(folder / "target.png"), target) and np.ptp(np.argwhere(target), 0)[1] > 30
    page = (folder / "index.html").read_text()
    assert (
        'src="video.mp4"' in page and 'href="replay.html"' in page and (folder / "replay.html").stat().st_size > 10_000
    )
    again = parse(["--config", str(folder / "config.json")]).run  # as the page says
    assert json.loads(json.dumps(to_json(again))) == json.loads((folder / "config.json").read_text())
    assert resume(folder, "--steps", "60", "--no-video") == 0  # the film shows the policy of 40 steps
    assert "video.mp4" not in (folder / "index.html").read_text() and not (folder / "replay.html").exists()
