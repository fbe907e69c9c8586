"""``python -m baselines.compare`` on robots of a hundred particles that move one substep at a time."""

import json
import os
import signal
from dataclasses import replace

import pytest

from baselines.compare import final_evaluation as evaluations
from baselines.compare.__main__ import main
from baselines.compare.final_evaluation import Protocol, Record, evaluation_config
from baselines.compare.jobs import Job
from baselines.compare.worker import carry_out
from baselines.registry import configure, load
from cfp.envs.disturbances import make_cases
from cfp.errors import CheckpointError
from cfp.experiment.process import StopSignals
from cfp.experiment.run_lock import run_lock

ENVIRONMENT = {"particles": 100, "substeps": 1, "num_envs": 1}
MPC = {"grid": 8, "planner": {"horizon": 3, "commit": 2, "iterations": 1}}
SHAC = {"train_particles": 100, "steps": 48, "window": 6, "grid": 8, "max_episode_steps": 20, "critic_updates": 2}
PLAN = {
    "common": {"environment": ENVIRONMENT, "report": {"eval_episodes": 1}},
    "algos": {
        "mpc": {**MPC, "report": {"eval_every": 12, "checkpoint_every": 3}},
        "shac-image": {"algo": "shac", "sees": "image", **SHAC, "report": {"eval_every": 24, "checkpoint_every": 12}},
        "broken": {"algo": "mpc", **MPC, "environment": {"particles": -3}},
    },
}
COMMON = "--device cpu --episodes 2 --particles 100 --robustness none --workers 0".split()


def compare(out, *more, plan=PLAN):
    path = out.parent / f"{out.name}.json"
    path.write_text(json.dumps(plan))
    return main([*COMMON, "--out", str(out), "--plan", str(path), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("compare") / "whole"
    assert compare(out, "--algos", "mpc", "shac-image", "--seeds", "0", "1") == 0
    return out


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("*") if path.is_file()}


def sessions(out, name):
    return json.loads((out / "runs" / name / "sessions.json").read_text())["sessions"]


def test_runs_are_made_once(finished, capsys):
    names = {path.name for path in (finished / "runs").iterdir()}
    assert names == {f"{algo}-shapematch-quick-{seed}" for algo in ("mpc", "shac-image") for seed in (0, 1)}
    before = contents(finished)
    assert compare(finished, "--algos", "mpc", "shac-image", "--seeds", "0", "1") == 0
    assert contents(finished) == before
    assert compare(finished, "--algos", "mpc", "--seeds", "0", "--dry-run") == 0
    assert capsys.readouterr().out.split()[-3:] == ["0", "mpc-shapematch-quick-0", "finished"]


def test_other_options_are_refused_and_named(finished, capsys):
    before = contents(finished)
    plan = {
        **PLAN,
        "algos": {"mpc": {**MPC, "planner": {**MPC["planner"], "horizon": 4}, "report": {"eval_every": 12}}},
    }
    assert compare(finished, "--algos", "mpc", "--seeds", "0", plan=plan) == 2
    error = capsys.readouterr().err
    assert "planner.horizon must be 3 as in the run in" in error and "mpc-shapematch-quick-0, got 4" in error
    assert contents(finished) == before


@pytest.mark.parametrize("content", ['{"finished": fal', '{"sessions": []}', "[]"])
def test_damaged_notes_are_named(tmp_path, capsys, content):
    folder = tmp_path / "out" / "runs" / "mpc-shapematch-quick-0"
    folder.mkdir(parents=True)
    (folder / "sessions.json").write_text(content)
    assert compare(tmp_path / "out", "--algos", "mpc", "--seeds", "0", "--dry-run") == 2
    assert "mpc-shapematch-quick-0/sessions.json: cannot be read (" in capsys.readouterr().err
    (folder / "policy.safetensors").touch()
    (folder / "final_evaluation.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"final_evaluation\.json: cannot be read \("):
        Record(configure({"algo": "mpc"}), folder)


def test_options_that_change_no_result_may_differ(finished):
    plan = {**PLAN, "common": {**PLAN["common"], "report": {"eval_episodes": 1, "log_every": 7}}}
    assert compare(finished, "--algos", "mpc", "--seeds", "0", "--dry-run", plan=plan) == 0


def test_variant_that_sees_the_image_is_labelled_so(finished):
    text = (finished / "report.md").read_text()
    assert "image: shac-image; simulator: mpc." in text and "action noise as in the paper: none in shapematch" in text


def test_more_episodes_are_added_to_those_that_are_there(finished, monkeypatch):
    record = finished / "runs" / "mpc-shapematch-quick-0" / "final_evaluation.json"
    before = json.loads(record.read_text())
    monkeypatch.setattr("baselines.compare.final_evaluation.BATCH", 2)
    assert compare(finished, "--algos", "mpc", "--seeds", "0", "--episodes", "3") == 0
    after = json.loads(record.read_text())
    assert after["policy"] == before["policy"]
    assert set(after["entries"]) - set(before["entries"]) == {"layouts 2 to 2, particles 100, without noise"}
    returns = [value for entry in after["entries"].values() for value in entry["returns"]]
    assert len(set(returns)) == 4  # three layouts and its own


def test_disturbed_cases_are_played_and_kept_in_the_same_parts(finished, monkeypatch):
    counts, report = [], evaluations.report

    def count(*arguments, **options):
        counts.append(arguments[-1])
        return report(*arguments, **options)

    monkeypatch.setattr(evaluations, "report", count)
    monkeypatch.setattr(evaluations, "BATCH", 2)
    options = ["--algos", "shac-image", "--seeds", "1", "--robustness", "paper"]
    for episodes, played in (("2", [2, 2]), ("3", [1, 1])):
        counts.clear()
        assert compare(finished, *options, "--episodes", episodes) == 0
        assert counts == played
    folder, case = finished / "runs" / "shac-image-shapematch-quick-1", make_cases()[1]
    entries = json.loads((folder / "final_evaluation.json").read_text())["entries"]
    last = entries[f"{case.name}, layouts 2 to 2, particles 100, without noise"]
    config = replace(evaluation_config(configure(json.loads((folder / "config.json").read_text())), 100), seed=2)
    assert last["returns"] == list(report(config, load(folder), [case], 1, deterministic=True)[0].returns)


def test_interrupted_comparison_goes_on(finished, tmp_path, monkeypatch, capsys, stop_at):
    stop_at(30)
    out, arguments = tmp_path / "out", ["--algos", "shac-image", "mpc", "--seeds", "0"]
    assert compare(out, *arguments) == 128 + signal.SIGINT
    output = capsys.readouterr().out
    assert "the same command resumes" in output
    assert "shac-image-shapematch-quick-0: stopped" in output and "mpc-shapematch-quick-0: not begun" in output
    assert [path.name for path in (out / "runs").iterdir()] == ["shac-image-shapematch-quick-0"]
    monkeypatch.undo()
    assert compare(out, *arguments) == 0
    steps = [(session["from"], session["to"]) for session in sessions(out, "shac-image-shapematch-quick-0")]
    assert steps == [(0, 30), (30, 48)]
    for name in ("returns.csv", "efficiency.csv", "success.csv"):
        assert (out / name).read_text().splitlines()[0] == (finished / name).read_text().splitlines()[0]
    same = "runs/shac-image-shapematch-quick-0/final_evaluation.json"
    assert json.loads((out / same).read_text()) == json.loads((finished / same).read_text())


def test_failing_run_is_reported_and_stops_no_other(tmp_path, capsys):
    assert compare(tmp_path / "out", "--algos", "broken", "mpc", "--seeds", "0") == 1
    output = capsys.readouterr().out
    assert "[1/2] broken-shapematch-quick-0: failed (ConfigError: particles" in output
    assert "[2/2] mpc-shapematch-quick-0: finished" in output
    assert "ConfigError: particles" in (tmp_path / "out" / "report.md").read_text()


def test_runs_of_the_paper_are_evaluated_in_the_same_environment_at_every_tier():
    for tier in ("full", "lite", 100):
        configs = [configure({"algo": algo, "preset": "paper"}) for algo in ("zero", "cfp")]
        configs.append(replace(configs[0], environment=replace(configs[0].environment, particles=tier)))
        environments = [evaluation_config(config, tier).environment for config in configs]
        assert {(each.particles, each.action_indexing) for each in environments} == {(tier, "image")}


def test_all_policies_are_evaluated_with_the_same_noise(finished, monkeypatch):
    """Whatever the run that trained a policy does by default."""
    used = []

    def evaluate(trials):
        used.extend(trial.deterministic for trial in trials)
        return [result]

    result = evaluations.Result("", 8, (1.0,))
    monkeypatch.setattr(evaluations, "evaluate", evaluate)
    folder = finished / "runs" / "shac-image-shapematch-quick-0"
    config = configure(json.loads((folder / "config.json").read_text()))
    for noise, deterministic in (("paper", True), ("with", False), ("without", True)):
        (folder / "final_evaluation.json").unlink()
        evaluations.evaluate_run(config, folder, Protocol(1, 100, "none", noise), lambda: None)
        assert used == [deterministic]
        used.clear()
    assert [Protocol(1).deterministic(task) for task in ("shapematch", "run", "slot", "module:own")] == [1, 0, 0, 0]


def test_evaluations_with_other_noise_do_not_count(finished):
    folder = finished / "runs" / "mpc-shapematch-quick-0"
    config = configure(json.loads((folder / "config.json").read_text()))
    for noise, found in (("without", True), ("paper", True), ("with", False)):
        protocol = Protocol(2, 100, "none", noise)
        assert (evaluations.read_evaluation(config, folder, protocol) is not None) == found


def test_reference_policies_are_evaluated_without_training(tmp_path):
    out = tmp_path / "out"
    assert compare(out, "--algos", "zero", "random", "--seeds", "3", "4") == 0
    folders = {name: out / "runs" / f"{name}-shapematch-quick-3" for name in ("zero", "random")}
    assert sorted((out / "runs").iterdir()) == sorted(folders.values())
    assert {path.name for path in folders["zero"].iterdir()} == {"config.json", "final_evaluation.json"}
    found = {name: json.loads((folder / "final_evaluation.json").read_text()) for name, folder in folders.items()}
    assert found["zero"]["policy"] == "zero" and found["zero"]["entries"] != found["random"]["entries"]
    before = contents(out)
    assert compare(out, "--algos", "zero", "random", "--seeds", "3", "4") == 0
    assert contents(out) == before


@pytest.mark.slow
def test_task_of_a_module_is_compared_in_processes_of_their_own(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(tmp_path), os.environ.get("PYTHONPATH", ""))))
    (tmp_path / "rolling.py").write_text(
        "import dataclasses, dittogym\n"
        "def roll(): return dataclasses.replace(dittogym.make_spec('run'), name='roll', horizon=12)\n"
        "dittogym.register('roll', roll)"
    )
    out = tmp_path / "out"
    assert compare(out, "--tasks", "rolling:roll", "--algos", "mpc", "--seeds", "0", "--workers", "1") == 0
    assert (out / "runs" / "mpc-roll-quick-0" / "policy.safetensors").exists()
    assert "rolling:roll" in (out / "report.md").read_text()


def test_array_job_does_one_run_and_no_report(tmp_path):
    out = tmp_path / "out"
    assert compare(out, "--algos", "shac-image", "mpc", "--seeds", "0", "--only", "1") == 0
    assert [path.name for path in out.iterdir()] == ["runs"]
    assert [path.name for path in (out / "runs").iterdir()] == ["mpc-shapematch-quick-0"]


def test_folder_in_use_is_left_alone(finished):
    folder = finished / "runs" / "mpc-shapematch-quick-0"
    before = (folder / "final_evaluation.json").read_bytes()
    config = configure(json.loads((folder / "config.json").read_text()))
    with run_lock(folder):
        assert carry_out(Job("mpc", config, folder, Protocol(9, 100, "none")), StopSignals(), 0.0) == "busy"
    assert (folder / "final_evaluation.json").read_bytes() == before
