"""`make gpu`: what becomes of a stage that fails, dies or hangs, and all stages on the imitation of a GPU."""

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchmpm.backends import compiler_found

PROGRAM = Path(__file__).resolve().parents[1] / "benchmarks/gpu.py"
spec = importlib.util.spec_from_file_location("gpu_program", PROGRAM)
assert spec is not None and spec.loader is not None
gpu = sys.modules["gpu_program"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(gpu)


def follow(tmp_path, script, seconds=20.0):
    """The check to go on with after a stage, and its rows in the file of results."""
    report = gpu.Report(tmp_path / "results.json", "imitation")
    going_on = gpu.follow([sys.executable, "-uc", script], "parity", seconds, report)
    rows = json.loads((tmp_path / "results.json").read_text())["rows"] if report.rows else []
    assert rows == report.rows
    return going_on, rows


ROW = json.dumps(
    {"stage": "parity", "check": "one", "backend": "native", "figures": {"x": 1.0}, "wrong": [], "seconds": 1}
)


def test_a_stage_that_ends_well(tmp_path):
    going_on, rows = follow(tmp_path, f"print('CHECK 0 one'); print('some warning'); print('ROW ' + '''{ROW}''')")
    assert going_on is None and rows == [json.loads(ROW)]


@pytest.mark.parametrize("end", ["import os; os.abort()", "raise MemoryError('none left')"])
def test_a_stage_that_dies_goes_on_with_the_next_check(tmp_path, end):
    script = f"print('CHECK 0 one'); print('ROW ' + '''{ROW}'''); print('CHECK 1 the other one'); {end}"
    going_on, rows = follow(tmp_path, script)
    assert going_on == 2 and [row["check"] for row in rows] == ["one", "the other one"]
    assert rows[1]["wrong"][0].startswith("the process ended with ")


def test_a_context_that_is_lost_goes_on_in_another_process(tmp_path):
    """The row of the failure has been written already."""
    going_on, rows = follow(tmp_path, f"print('CHECK 0 one'); print('ROW ' + '''{ROW}'''); exit({gpu.LOST})")
    assert going_on == 1 and len(rows) == 1


def test_a_stage_out_of_time(tmp_path):
    going_on, rows = follow(tmp_path, "print('CHECK 4 slow'); import time; time.sleep(60)", seconds=2.0)
    assert going_on == 5 and rows[0]["check"] == "slow" and "out of time" in rows[0]["wrong"][0]


def test_a_stage_that_does_not_start(tmp_path):
    going_on, rows = follow(tmp_path, "import no_such_module")
    assert going_on is None and "No module named 'no_such_module'" in rows[0]["wrong"][0]


def run_checks(monkeypatch, capsys, checks):
    """Rows of a stage of these checks, and its exit code."""
    monkeypatch.setitem(gpu.STAGES, "parity", lambda lab: iter(checks.items()))
    code = gpu.run_stage(gpu.Lab("cpu", True, Path(), 10.0), "parity", 0)
    return code, [json.loads(line[4:]) for line in capsys.readouterr().out.splitlines() if line.startswith("ROW ")]


def test_a_check_that_fails_is_passed_over(monkeypatch, capsys):
    checks = {"broken": lambda: 1 / 0, "exact": lambda: gpu.judged({"backend": "native", "x": 0.0}, {"x": 0})}
    code, rows = run_checks(monkeypatch, capsys, checks)
    assert code == 0 and [bool(row["wrong"]) for row in rows] == [True, False]
    assert rows[0]["wrong"] == ["ZeroDivisionError: division by zero"]


def test_eager_in_silence_fails(monkeypatch, capsys):
    _, rows = run_checks(
        monkeypatch, capsys, {"a": lambda: {"backend": "eager"}, "a, eager": lambda: {"backend": "eager"}}
    )
    assert [row["wrong"] for row in rows] == [["it ran on the eager backend"], []]


def test_no_check_runs_in_a_context_that_is_lost(monkeypatch, capsys):
    def lost():
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    code, rows = run_checks(monkeypatch, capsys, {"a": lost, "b": lost})
    assert code == gpu.LOST and len(rows) == 1


@pytest.mark.parametrize("value", [2.0, math.nan])
def test_a_figure_beyond_its_bound_or_no_number_is_wrong(value):
    assert len(gpu.judged({"x": value}, {"x": 1.0})["wrong"]) == 1
    assert gpu.judged({"x": 1.0}, {"x": 1.0})["wrong"] == []


needs_compiler = pytest.mark.skipif(not compiler_found(), reason="no C++ compiler")


@needs_compiler
@pytest.mark.parametrize("stage", ["card", "paper"])
def test_a_stage_on_the_imitation(stage, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", list(sys.path))
    with gpu.imitation():
        assert gpu.run_stage(gpu.Lab("cpu", True, tmp_path, 60.0), stage, 0) == 0
    (row,) = [json.loads(line[4:]) for line in capsys.readouterr().out.splitlines() if line.startswith("ROW ")]
    assert row["wrong"] == [] and row["backend"] == {"card": None, "paper": "native"}[stage]


@needs_compiler
@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="it would run on the GPU")
def test_all_stages_on_the_imitation(tmp_path):
    """None of them fails, and nothing is written where the results of GPUs are."""
    before = sorted(gpu.RESULTS.glob("*"))
    command = [sys.executable, str(PROGRAM), "--out", str(tmp_path / "results.json"), "--seconds", "900"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["device"] == "imitation" and {row["stage"] for row in found["rows"]} == set(gpu.STAGES)
    assert f"{len(found['rows'])} checks, 0 failed" in done.stdout
    assert sorted(gpu.RESULTS.glob("*")) == before
