"""Training from Python is training from the command line."""

import importlib
import io
import random
import sys
from unittest import mock

import cv2
import gymnasium
import matplotlib
import numpy as np
import pytest
import torch
from short_episodes import HORIZON
from tiny_runs import TABLES, assert_same_run
from watching import at_step, interrupt

import cfp
from cfp import registry
from cfp.policy import read_policy
from cfp.train import from_python
from dittogym import TASKS

pytestmark = pytest.mark.usefixtures("short")

#: The options of `tiny_runs.TINY`.
OPTIONS = {
    **{"algo": "cfp-sac", "particles": 100, "substeps": 1, "num_envs": 2, "resolutions": (4, 8), "handover": [0.4667]},
    **{"random_steps": (10, 4), "batch_size": 4, "buffer_size": 60, "update_start": 8, "critics_first": (0.0,)},
    **{"gradient_steps": 1, "eval_every": 60, "eval_episodes": 2, "checkpoint_every": 20, "log_every": 10},
    **{"video": False, "device": "cpu"},
}


class Pruned(Exception):
    """As a library that searches for options raises it to end a training that does not look promising."""


def test_fit_is_the_command_line_and_goes_on_after_whatever_has_ended_it(finished, tmp_path, capfd):
    """After Ctrl-C, and after an exception that its evaluations have led to; quietly if asked to."""
    folder, rows = tmp_path / "run", []

    def prune(row):
        rows.append(row)
        if row["step"] in (60, 120):
            raise Pruned

    before = torch.get_rng_state(), np.random.get_state(), random.getstate()
    with at_step(14, interrupt), pytest.raises(KeyboardInterrupt, match="resume=True"):
        cfp.fit("shapematch", steps=150, out=str(folder), **OPTIONS)
    assert torch.equal(torch.get_rng_state(), before[0]) and random.getstate() == before[2]
    np.testing.assert_array_equal(np.random.get_state()[1], before[1][1])
    capfd.readouterr()
    for _ in range(2):  # each goes on after the evaluation that has ended the one before
        with pytest.raises(Pruned):
            cfp.fit("shapematch", out=folder, resume=True, quiet=True, on_evaluation=prune, **OPTIONS)
    assert [(row["step"], row["stage"]) for row in rows] == [(60, 1), (70, 1), (70, 2), (120, 2)]
    assert not (folder / "results.json").exists()
    run = cfp.fit("shapematch", out=folder, resume=True, quiet=True, on_evaluation=rows.append, **OPTIONS)
    assert run.evaluations == cfp.Run(finished).evaluations == [*rows[:4], rows[-1]]
    assert_same_run(folder, finished, (*TABLES, "policy.safetensors", "config.json"))
    assert capfd.readouterr() == ("", "")


def test_other_programs_find_the_task_of_a_module(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "ledges.py").write_text(
        "import dataclasses, dittogym\n"
        "def ledge(): return dataclasses.replace(dittogym.make_spec('run'), name='ledge')\n"
        "dittogym.register('ledge', ledge)"
    )
    with mock.patch.dict(TASKS), mock.patch.dict(gymnasium.registry):
        importlib.import_module("ledges")
        assert from_python({"task": "ledge"}, None, False).run.task == "ledges:ledge"
        assert from_python({"task": "run"}, None, False).run.task == "run"


class Bare:
    """A standard error that can do no more than Python asks for."""

    write = flush = staticmethod(lambda *text: None)


@pytest.mark.parametrize("error", [Bare(), None])
def test_a_run_ends_with_its_page_whatever_is_around_it(error, tmp_path, monkeypatch):
    """Output in ASCII, figures of LaTeX, an ffmpeg that does not start, and little or no standard error."""
    output = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(sys, "stderr", error)
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)
    monkeypatch.setitem(matplotlib.rcParams, "figure.facecolor", "red")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    short = {"eval_every": 10, "eval_episodes": 2, "resolutions": [4], "handover": [], "video": True}
    cfp.fit("shapematch", steps=20, out=tmp_path / "run", **OPTIONS | short)
    assert (tmp_path / "run" / "index.html").exists() and (tmp_path / "run" / "replay.html").exists()
    assert cv2.imread(str(tmp_path / "run" / "curve.png"))[0, 0].tolist() == [255, 255, 255]
    output.flush()
    text = output.buffer.getvalue().decode("ascii")
    assert "\\xb1" in text and "no video: " in text and output.errors == "strict"


def test_run_holds_policy_evaluations_results_and_film(finished, tmp_path):
    run = cfp.Run(finished)
    assert run.policy.resolution == 64 and run.policy.description == read_policy(finished)[1]
    assert [row["step"] for row in run.evaluations] == [60, 70, 70, 120, 150]
    assert [row["policy"] for row in run.results] == ["zero action", "random action", "stage 1", "stage 2"]
    returned = f"{run.results[-1]['mean']:.1f}"
    assert repr(run) == f"Run({str(finished)!r}, task='shapematch', resolution=8, mean_return={returned})"
    assert run._repr_png_().startswith(b"\x89PNG")
    recording = run.film(tmp_path / "film.html", speed=0.5)
    assert len(recording.rewards) == HORIZON and (tmp_path / "film.html").stat().st_size > 10_000
    with pytest.raises(cfp.CheckpointError, match="no run"):
        cfp.Run(tmp_path)


def test_unfinished_run_has_no_results(finished, tmp_path):
    for name in ("config.json", "policy.safetensors"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    run = cfp.Run(tmp_path)
    assert run.policy.resolution == 64 and run.evaluations == []
    assert repr(run) == f"Run({str(tmp_path)!r}, task='shapematch', resolution=8)"
    assert run._repr_png_().startswith(b"\x89PNG")  # no evaluation yet
    with pytest.raises(cfp.CheckpointError, match="not finished"):
        _ = run.results
    (tmp_path / "results.json").write_text('[{"policy": ')
    with pytest.raises(cfp.CheckpointError, match=r"results\.json: cannot be read"):
        _ = run.results


def test_an_algorithm_of_baselines_is_pointed_to(monkeypatch):
    monkeypatch.setattr(registry, "OTHER_NAMES", {})  # as long as baselines is not imported
    monkeypatch.setattr(registry, "ALGORITHMS", {"cfp-sac": registry.ALGORITHMS["cfp-sac"]})
    with pytest.raises(cfp.ConfigError, match=r"one of cfp-sac or .*, got 'shac'; baselines\.fit and baselines\.Run"):
        cfp.fit("run", algo="shac")
