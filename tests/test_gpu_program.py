"""`make gpu`: what becomes of a stage that fails, dies or hangs, and all stages on the imitation of a GPU."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchmpm.native.library import find_compiler

PROGRAM = Path(__file__).resolve().parents[1] / "benchmarks/gpu.py"
spec = importlib.util.spec_from_file_location("gpu_program", PROGRAM)
assert spec is not None and spec.loader is not None
gpu = sys.modules["gpu_program"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(gpu)


ROW = json.dumps(
    {"stage": "parity", "check": "one", "backend": "native", "figures": {"x": 1.0}, "wrong": [], "seconds": 1}
)
#: A process whose first check has ended, and one that is in its second check.
ONE = f"print('CHECK 0 one'); print('ROW ' + '''{ROW}''')"
OTHER = f"{ONE}; print('CHECK 1 the other one')"


@pytest.mark.parametrize(
    ("script", "going_on", "checks", "wrong"),
    [
        (f"{ONE}; print('some warning')", None, ["one"], None),
        (f"{OTHER}; import os; os.abort()", 2, ["one", "the other one"], "the process ended with "),
        (f"{OTHER}; raise MemoryError('none left')", 2, ["one", "the other one"], "none left"),
        (f"{ONE}; exit({gpu.LOST})", 1, ["one"], None),  # it has lost its context, and has written why
        ("print('CHECK 4 slow'); import time; time.sleep(60)", 5, ["slow"], "out of time"),
        ("import no_such_module", None, ["its start"], "No module named 'no_such_module'"),
    ],
    ids=["ends well", "aborts", "raises", "loses its context", "takes too long", "does not start"],
)
def test_a_stage_goes_on_after_the_check_in_which_its_process_has_ended(script, going_on, checks, wrong, tmp_path):
    report, seconds = gpu.Report(tmp_path / "results.json", "imitation"), 2.0 if "sleep" in script else 20.0
    assert gpu.follow([sys.executable, "-uc", script], "parity", seconds, report) == going_on
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert rows == report.rows and [row["check"] for row in rows] == checks
    assert wrong in rows[-1]["wrong"][0] if wrong else rows == [json.loads(ROW)]


def test_checks_that_fail_are_passed_over_until_the_context_is_lost(monkeypatch, capsys):
    """A check that ran on the eager backend in silence has failed, too."""

    def lost():
        raise RuntimeError("CUDA error: an illegal memory access was encountered")

    checks = {
        "broken": lambda: 1 / 0,
        "exact": lambda: gpu.judged({"backend": "native", "x": 0.0}, {"x": 0}),
        "far": lambda: gpu.judged({"backend": "native", "x": 2.0}, {"x": 1.0}),
        "no number": lambda: gpu.judged({"backend": "native", "x": float("nan")}, {"x": 1.0}),
        "slow": lambda: {"backend": "eager"},
        "slow, eager": lambda: {"backend": "eager"},
        "lost": lost,
        "never": lost,
    }
    monkeypatch.setitem(gpu.STAGES, "parity", lambda lab: iter(checks.items()))
    assert gpu.run_stage(gpu.Lab("cpu", True, Path(), 10.0), "parity", 0) == gpu.LOST
    rows = [json.loads(line[4:]) for line in capsys.readouterr().out.splitlines() if line.startswith("ROW ")]
    wrong = {row["check"]: row["wrong"] for row in rows}
    assert "illegal memory access" in wrong.pop("lost")[0]
    assert len(wrong.pop("far")) == len(wrong.pop("no number")) == 1
    assert wrong == {
        "broken": ["ZeroDivisionError: division by zero"],
        "exact": [],
        "slow": ["it ran on the eager backend"],
        "slow, eager": [],
    }


needs_compiler = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")


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
