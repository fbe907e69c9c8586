"""``python -m baselines.compare`` on robots of a hundred particles that move one substep at a time."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from baselines.compare import evaluations as judging
from baselines.compare import worker as work
from baselines.compare.__main__ import main
from baselines.compare.local import run_process
from baselines.compare.plan import Plan, judged, make_jobs, resolve
from baselines.registry import configure, load
from cfp.envs.disturbances import make_cases
from cfp.errors import CheckpointError
from cfp.tables import read_table

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
PLACES = [(tier, parity) for tier in ("full", "lite") for parity in ("clean", "reference")]
COMMON = "--device cpu --episodes 2 --tier 100 --robustness none --workers 0".split()


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
    assert "planner.horizon: the run in" in error and "mpc-shapematch-quick-0 has 3, got 4" in error
    assert contents(finished) == before


@pytest.mark.parametrize("content", ['{"finished": fal', '{"sessions": []}', "[]"])
def test_damaged_notes_are_named(tmp_path, capsys, content):
    folder = tmp_path / "out" / "runs" / "mpc-shapematch-quick-0"
    folder.mkdir(parents=True)
    (folder / "sessions.json").write_text(content)
    assert compare(tmp_path / "out", "--algos", "mpc", "--seeds", "0", "--dry-run") == 2
    assert "mpc-shapematch-quick-0/sessions.json: cannot be read (" in capsys.readouterr().err
    (folder / "policy.safetensors").touch()
    (folder / "judged.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"judged\.json: cannot be read \("):
        judging.Record(folder)


def test_options_that_change_no_result_may_differ(finished):
    plan = {**PLAN, "common": {**PLAN["common"], "report": {"eval_episodes": 1, "log_every": 7}}}
    assert compare(finished, "--algos", "mpc", "--seeds", "0", "--dry-run", plan=plan) == 0


def test_variant_that_sees_the_image_is_labelled_so(finished):
    text = (finished / "report.md").read_text()
    assert "image: shac-image; simulator: mpc." in text


def test_more_episodes_are_added_to_those_that_are_there(finished, monkeypatch):
    record = finished / "runs" / "mpc-shapematch-quick-0" / "judged.json"
    before = json.loads(record.read_text())
    monkeypatch.setattr("baselines.compare.evaluations.CHUNK", 2)
    assert compare(finished, "--algos", "mpc", "--seeds", "0", "--episodes", "3") == 0
    after = json.loads(record.read_text())
    assert after["policy"] == before["policy"]
    assert set(after["entries"]) - set(before["entries"]) == {"layouts 2 to 2, particles 100"}
    judged = [value for entry in after["entries"].values() for value in entry["returns"]]
    assert len(set(judged)) == 4  # three layouts and its own


def test_disturbed_cases_are_played_and_kept_in_the_same_parts(finished, monkeypatch):
    counts, report = [], judging.report
    monkeypatch.setattr(judging, "report", lambda *given: counts.append(given[-1]) or report(*given))
    monkeypatch.setattr(judging, "CHUNK", 2)
    options = ["--algos", "shac-image", "--seeds", "1", "--robustness", "paper"]
    for episodes, played in (("2", [2, 2]), ("3", [1, 1])):
        counts.clear()
        assert compare(finished, *options, "--episodes", episodes) == 0
        assert counts == played
    folder, case = finished / "runs" / "shac-image-shapematch-quick-1", make_cases()[1]
    entries = json.loads((folder / "judged.json").read_text())["entries"]
    (last,) = entries[f"{case.name}, layouts 2 to 2, particles 100"]
    config = replace(judged(configure(json.loads((folder / "config.json").read_text())), 100), seed=2)
    assert last["returns"] == list(report(config, load(folder), [case], 1)[0].returns)


def test_interrupted_comparison_goes_on(finished, tmp_path, monkeypatch, capsys, stop_at):
    stop_at(30)
    out, arguments = tmp_path / "out", ["--algos", "shac-image", "mpc", "--seeds", "0", "1"]
    assert compare(out, *arguments) == 128 + signal.SIGINT
    assert "stopped; the same command goes on" in capsys.readouterr().out
    assert [path.name for path in (out / "runs").iterdir()] == ["shac-image-shapematch-quick-0"]
    monkeypatch.undo()
    assert compare(out, *arguments) == 0
    steps = [(session["from"], session["to"]) for session in sessions(out, "shac-image-shapematch-quick-0")]
    assert steps == [(0, 30), (30, 48)]
    for name in ("returns.csv", "efficiency.csv", "success.csv"):
        assert (out / name).read_text().splitlines()[0] == (finished / name).read_text().splitlines()[0]
    same = "runs/shac-image-shapematch-quick-0/judged.json"
    assert json.loads((out / same).read_text()) == json.loads((finished / same).read_text())


def test_failing_run_is_reported_and_stops_no_other(tmp_path, capsys):
    assert compare(tmp_path / "out", "--algos", "broken", "mpc", "--seeds", "0") == 1
    output = capsys.readouterr().out
    assert "[1/2] broken-shapematch-quick-0: failed (ConfigError: particles" in output
    assert "[2/2] mpc-shapematch-quick-0: finished" in output
    assert "ConfigError: particles" in (tmp_path / "out" / "report.md").read_text()


def test_runs_of_the_paper_are_judged_in_the_same_sound_world_at_every_tier():
    for tier, parity in (("full", "reference"), ("lite", "clean"), (100, "clean")):
        configs = [configure({"algo": algo, "preset": "paper"}) for algo in ("zero", "cfp")]
        configs.append(replace(configs[0], environment=replace(configs[0].environment, particles=tier)))
        places = [judged(config, tier).environment for config in configs]
        assert {(place.particles, place.parity, place.action_indexing) for place in places} == {(tier, parity, "grid")}


def test_what_was_judged_in_another_world_is_judged_again():
    keys = {(tier, parity): judging.Judging(1, tier, "none", parity).key("own layout") for tier, parity in PLACES}
    assert keys["full", "reference"] == keys["full", "clean"] == "own layout, particles full"
    assert keys["lite", "clean"] == "own layout, particles lite" != keys["lite", "reference"]


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--algos alchemy", "algo: got 'alchemy', allowed cfp"),
        ("--tasks swim --algos mpc", "task must be catch"),
        ("--algos mpc mpc", "algos: got mpc mpc, allowed one or more, each once"),
        ("--seeds 9500 --algos mpc", "seeds: got 9500, allowed 0 to 8999"),
        ("--episodes 0", "episodes: got 0, allowed 1 or more"),
        ("--gpus-per-run 1", "gpus_per_run: got 1.0, allowed with --executor ray only"),
        ("--algos mpc --seeds 0 --only 1", "only: got 1, allowed 0 to 0"),
        ("--only 0 --report-only", "only: got 0, allowed without --report-only"),
        ("--algos mpc other", "target: got 'M' for other and None for mpc on shapematch, allowed is the same"),
    ],
)
def test_wrong_options_are_named(tmp_path, capsys, options, message):
    plan = {"algos": {**PLAN["algos"], "other": {"algo": "mpc", "environment": {"target": "M"}}}}
    assert compare(tmp_path / "out", *options.split(), plan=plan) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_algorithm_for_all_is_that_of_variants():
    plan = Plan(common={"algo": "coarse"}, algos={"long": {"steps": 9600}, "shac": {"algo": "cem"}})
    labels = ("zero", "gnn16", "long", "shac")
    found = [resolve(plan, label, "run", "quick", 0, None, "cpu").algo for label in labels]
    assert found == ["zero", "gnn-16", "coarse", "cem"]


def test_names_in_a_plan_that_mean_nothing_are_reported(tmp_path, capsys):
    algos = {"cfp": {"tasks": {"rnu": {"steps": 9600}, "run": {"steps": 6400}}}, "shac": {"tasks": {"kick": {}}}}
    assert compare(tmp_path / "out", "--dry-run", "--algos", "cfp", "--tasks", "run", plan={"algos": algos}) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("plan")]
    assert said == [
        "plan: algos shac are not in this comparison",
        "plan: algos.cfp.tasks rnu are not in this comparison",
    ]


def test_options_without_effect_are_refused_where_they_are_for_one_algorithm(tmp_path, capsys):
    idle = {"learning": {"warm_critic": True}}
    for algos in ({"gnn-16": idle}, {"gnn-16": {"tasks": {"run": idle}}}, {"gnn": {"algo": "gnn-16", **idle}}):
        (label,) = algos
        assert compare(tmp_path / "out", "--algos", label, "--tasks", "run", plan={"algos": algos}) == 2
        error = capsys.readouterr().err
        assert f"{label} on run: warm_critic requires " in error
    plan = {"common": idle, "algos": {"gnn-16": {"learning": {"warm_critic": False}}}}
    assert compare(tmp_path / "out", "--dry-run", "--algos", "cfp", "coarse", "gnn-16", plan=plan) == 0


def test_default_of_a_task_is_the_same_task_by_name(tmp_path):
    for task, option, default in (("shapematch", "target", "star"), ("slot", "variant", "registered")):
        plan = {"algos": {"mpc": {"environment": {option: default}}}}
        assert compare(tmp_path / "out", "--dry-run", "--algos", "zero", "mpc", "--tasks", task, plan=plan) == 0


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "docs").glob("compare-plan*.json")), ids=str)
def test_plans_of_the_documentation_hold(path, tmp_path):
    plan = Plan.read(path)
    assert make_jobs(plan, ["run"], list(plan.algos), [0], tmp_path)


def test_plan_file_that_is_none_is_named(tmp_path, capsys):
    assert compare(tmp_path / "out", plan={"runs": {}}) == 2
    assert "holds runs, allowed an object with common, tasks, algos" in capsys.readouterr().err
    assert main(["--plan", str(tmp_path / "missing.json")]) == 2
    assert "cannot be read as JSON" in capsys.readouterr().err


def test_ray_that_is_not_installed_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert compare(tmp_path / "out", "--algos", "mpc", "--seeds", "0", "--executor", "ray") == 2
    assert "pip install 'torchmpm[ray]'" in capsys.readouterr().err


def test_process_that_is_killed_is_begun_again_and_then_given_up(tmp_path, monkeypatch):
    kill = "import os; open('count', 'a').write('x'); os.kill(os.getpid(), 9)"
    monkeypatch.setattr("baselines.compare.local.MODULE", (sys.executable, "-c", kill))
    monkeypatch.chdir(tmp_path)
    assert run_process({"folder": str(tmp_path)}, 1, 2, lambda: 0) == "failed"
    assert (tmp_path / "count").read_text() == "xxx"
    assert (tmp_path / "error.txt").read_text() == "killed by SIGKILL, 3 times; see log.txt\n"


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("raise ImportError('no hop')", "ImportError: no hop (exit code 1; see log.txt)\n"),
        ("import os; os._exit(7)", "no word (exit code 7; see log.txt)\n"),
        ("import sys; open('error.txt', 'w').write('its own word'); sys.exit(1)", "its own word"),
    ],
)
def test_process_that_fails_leaves_its_last_word(tmp_path, monkeypatch, program, told):
    monkeypatch.setattr("baselines.compare.local.MODULE", (sys.executable, "-c", program))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "error.txt").write_text("of another time")
    (tmp_path / "log.txt").write_text("of another time\n")
    assert run_process({"folder": str(tmp_path)}, 1, 2, lambda: 0) == "failed"
    assert (tmp_path / "error.txt").read_text() == told


@pytest.mark.parametrize(("urgency", "ending"), [(1, "checkpoint"), (2, None)])
def test_process_is_asked_to_stop_before_it_is_made_to(tmp_path, monkeypatch, urgency, ending):
    waiting = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: (open('ended', 'w').write('checkpoint'), sys.exit(143)))\n"
        "open('ready', 'w').close(); time.sleep(60)"
    )
    monkeypatch.setattr("baselines.compare.local.MODULE", (sys.executable, "-c", waiting))
    monkeypatch.chdir(tmp_path)
    stopped = lambda: urgency if (tmp_path / "ready").exists() else 0  # noqa: E731
    assert run_process({"folder": str(tmp_path)}, 1, 2, stopped) == "stopped"
    path = tmp_path / "ended"
    assert (path.read_text() if path.exists() else None) == ending
    assert not (tmp_path / "error.txt").exists()


def test_comparison_that_is_killed_goes_on(tmp_path):
    """The parent dies without a word: the run stops with a checkpoint, and the next command goes on from there."""
    slow = {**MPC, "planner": {"horizon": 3, "commit": 1, "iterations": 10}, "report": {"checkpoint_every": 1}}
    plan, out = {**PLAN, "algos": {"mpc": slow}}, tmp_path / "out"
    path = tmp_path / "out.json"
    path.write_text(json.dumps(plan))
    command = [*COMMON, "--out", str(out), "--plan", str(path), "--algos", "mpc", "--seeds", "0", "--workers", "1"]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    parent = subprocess.Popen([sys.executable, "-m", "baselines.compare", *command], env=environment, cwd=tmp_path)
    folder, end = out / "runs" / "mpc-shapematch-quick-0", time.monotonic() + 120
    while not (folder / "checkpoint" / "state.pt").exists():
        assert parent.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    while not (folder / "sessions.json").exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert main([*command[:-2], "--workers", "0"]) == 0
    first, second = sessions(out, folder.name)
    assert 0 < first["to"] == second["from"] < second["to"] == 30
    assert not first["finished"] and second["finished"]
    assert [row["step"] for row in read_table(folder / "progress.csv")] == ["10", "20", "30"]


def test_folder_in_use_is_left_alone(finished, monkeypatch):
    from cfp.experiment.run_lock import claim

    folder = finished / "runs" / "mpc-shapematch-quick-0"
    before = (folder / "judged.json").read_bytes()
    values = {"label": "mpc", "folder": str(folder), "patience": 0.0}
    values["config"] = json.loads((folder / "config.json").read_text())
    values["judging"] = {"episodes": 9, "tier": 100, "robustness": "none"}
    with claim(folder):
        assert work.work(values) == work.BUSY
    assert (folder / "judged.json").read_bytes() == before
