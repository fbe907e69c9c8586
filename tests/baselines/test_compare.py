"""Comparisons: tiny plans, in processes of their own where that matters, and the report about them."""

import contextlib
import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock

import baselines
from baselines.compare import processes, worker
from baselines.compare.__main__ import Command, main
from baselines.compare.evaluation import Protocol, evaluate_run
from baselines.compare.plan import PlannedRun, make_runs, read_plan, to_words
from baselines.compare.processes import LocalExecutor, Resources, carry_out
from baselines.compare.report import align, make_table, read_result, write_report
from cfp.errors import ConfigError
from cfp.evaluate import main as evaluate
from cfp.files import write_json, write_text
from cfp.tables import read_table

ROOT = Path(__file__).resolve().parents[2]
MPC = {"grid": 8, "horizon": 3, "commit": 2, "iterations": 1, "eval_every": 12, "checkpoint_every": 3}
SHAC = {"train_particles": 100, "steps": 48, "window": 6, "grid": 8, "max_episode_steps": 20, "critic_updates": 2}
PLAN = {
    "common": {"particles": 100, "substeps": 1, "num_envs": 1, "eval_episodes": 1},
    "algos": {
        "mpc": MPC,
        "shac-wide": {"algo": "shac", "noise": 0.3, **SHAC, "eval_every": 24, "checkpoint_every": 12},
    },
}
COMMON = "--device cpu --episodes 2 --particles 100 --cpus-per-run 1".split()
ALGOS = "--algos zero shac-wide --seeds 0 1".split()
NAMES = [f"{name}-shapematch-quick-{seed}" for name, seed in (("zero", 0), ("shac-wide", 0), ("shac-wide", 1))]


@pytest.fixture(autouse=True, scope="module")
def packages_of_this_folder():
    """Also in the processes of the runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
        yield


def call_here(words, run, threads, urgency):
    """Stands for `processes._call`: the run takes place in this process, which saves a start of Python."""
    output = io.StringIO()
    values = json.loads(words[-1])
    with contextlib.redirect_stderr(output):
        code = worker.train_and_evaluate(run, Protocol(**values["protocol"]))
    return code, output.getvalue().rstrip().rpartition("\n")[2]


@pytest.fixture
def here(monkeypatch):
    monkeypatch.setattr(processes, "_call", call_here)


def words(out, *more, plan=PLAN):
    path = out.parent / f"{out.name}.json"
    path.write_text(json.dumps(plan))
    return [*COMMON, "--out", str(out), "--plan", str(path), *more]


def compare(out, *more, plan=PLAN):
    return main(words(out, *more, plan=plan))


def rows(folder):
    with open(folder / "episodes.csv", newline="") as file:
        return list(csv.DictReader(file))


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file() and path.name != "log.txt"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A comparison of a reference policy, in a process of its own, and of trainings with two seeds."""
    out = tmp_path_factory.mktemp("compare") / "whole"
    assert compare(out, "--algos", "zero", "--seeds", "0") == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "_call", call_here)
        assert compare(out, *ALGOS) == 0
    return out


def test_every_policy_plays_the_same_episodes_and_all_are_reported(finished):
    assert sorted(path.name for path in (finished / "runs").iterdir()) == sorted(NAMES)
    table = rows(finished)
    layouts = {(row["algorithm"], row["seed"]): [] for row in table}
    for row in table:
        layouts[row["algorithm"], row["seed"]].append(row["layout"])
    assert len(layouts) == 3 and {tuple(each) for each in layouts.values()} == {("20000", "20001")}
    assert {(row["algorithm"], row["observes"]) for row in table} == {("zero", "nothing"), ("shac-wide", "state")}
    report, page = (finished / "report.md").read_text(), (finished / "index.html").read_text()
    for text in (report, page):
        assert "3 of 3 runs are finished and evaluated." in text and "shac-wide" in text
    assert "http" not in page and (finished / "returns.png").read_bytes()[:4] == b"\x89PNG"


def test_evaluation_is_that_of_the_policy_alone(finished):
    """Each episode can be asked for by itself and is the same to the last bit."""
    options = json.loads((finished / "runs" / NAMES[1] / "comparison.json").read_text())["options"]
    run = PlannedRun("shac-wide", "shapematch", 0, options, finished / "runs" / NAMES[1])
    found = run.record["evaluation"]
    run.update_record(evaluation={})
    for episodes in (1, 2):
        evaluate_run(run, Protocol(episodes, 100))
        assert run.record["evaluation"]["returns"] == found["returns"][:episodes]
    assert run.record["evaluation"] == found
    evaluate_run(run, Protocol(1, 100, "with"))
    assert run.record["evaluation"]["noise"] and len(run.record["evaluation"]["returns"]) == 1
    run.update_record(evaluation=found)


def test_what_is_finished_is_left_alone_and_listed(finished, capsys):
    before = contents(finished / "runs")
    for more in ([], ["--report-only"], ["--dry-run"]):
        assert compare(finished, *ALGOS, *more) == 0
    lines = capsys.readouterr().out.splitlines()[-3:]
    assert [line.split()[:3] for line in lines] == [[str(k), name, "finished"] for k, name in enumerate(NAMES)]
    assert "torchmpm train --algo shac --task shapematch" in lines[1] and "torchmpm" not in lines[0]
    assert contents(finished / "runs") == before


def test_other_options_are_refused_and_named(finished, capsys):
    plan = {**PLAN, "algos": {"shac-wide": {**PLAN["algos"]["shac-wide"], "window": 8}}}
    assert compare(finished, *ALGOS, plan=plan) == 2
    assert "window must be 6 as in the run in" in capsys.readouterr().err
    without_influence = {**PLAN, "common": {**PLAN["common"], "log_every": 7}}
    assert compare(finished, *ALGOS, "--dry-run", plan=without_influence) == 0


def test_an_array_job_does_one_run_and_several_fill_one_folder(finished, here, tmp_path):
    out = tmp_path / "out"
    for number in (0, 1):
        assert compare(out, "--algos", "zero", "mpc", "--seeds", "0", "--only", str(number)) == 0
        assert [path.name for path in out.iterdir()] == ["runs"] and len(list((out / "runs").iterdir())) == number + 1
    assert compare(out, "--algos", "zero", "mpc", "--seeds", "0", "--report-only") == 0
    zero, mpc = (
        [row for row in rows(out) if (row["algorithm"], row["observes"]) == pair]
        for pair in (("zero", "nothing"), ("mpc", "simulator"))
    )
    assert zero == [row for row in rows(finished) if row["algorithm"] == "zero"] and len(mpc) == 2
    own = json.loads((out / "runs" / "mpc-shapematch-quick-0" / "comparison.json").read_text())["evaluation"]
    assert own["own_layout"] not in own["returns"]  # on the only layout that it is made for


def test_an_algorithm_of_ones_own_is_named_by_its_module(here, tmp_path, monkeypatch, capsys):
    (tmp_path / "own_planner.py").write_text("from baselines.planning.mpc import MPC as Planner\n")
    monkeypatch.syspath_prepend(tmp_path)
    plan = {**PLAN, "algos": {"own_planner:Planner": MPC}}
    out = tmp_path / "own"
    assert compare(out, "--algos", "own_planner:Planner", "--seeds", "0", plan=plan) == 0
    run = baselines.Run(out / "runs" / "Planner-shapematch-quick-0")
    assert run.config.algo == run.policy.description["kind"] == "own_planner:Planner"
    assert {row["algorithm"] for row in rows(out)} == {"own_planner:Planner"}
    assert evaluate(["--episodes", "1", str(run.folder)]) == 0 and "replayed" in capsys.readouterr().out


def test_failed_run_is_reported_and_stops_no_other(here, tmp_path, capsys):
    damaged = tmp_path / "out" / "runs" / "mpc-shapematch-quick-0" / "checkpoint" / "state.pt"
    write_text(damaged, "no checkpoint")
    assert compare(tmp_path / "out", "--algos", "mpc", "zero", "--seeds", "0") == 1
    output = capsys.readouterr().out
    assert "mpc-shapematch-quick-0: failed error: " in output and "zero-shapematch-quick-0: finished" in output
    for name in ("report.md", "index.html"):
        text = (tmp_path / "out" / name).read_text()
        assert "1 of 2 runs are finished and evaluated; the others:" in text and "state.pt" in text


@pytest.fixture
def killed(tmp_path):
    """A comparison in a process of its own, with a run that has a checkpoint and much to do."""
    slow = {**MPC, "commit": 1, "iterations": 10, "checkpoint_every": 1}
    plan, out = {**PLAN, "algos": {"mpc": slow}}, tmp_path / "out"
    arguments = words(out, "--algos", "mpc", "--seeds", "0", plan=plan)
    process = subprocess.Popen([sys.executable, "-m", "baselines.compare", *arguments], cwd=ROOT)
    folder, end = out / "runs" / "mpc-shapematch-quick-0", time.monotonic() + 120
    while not (folder / "checkpoint" / "state.pt").exists():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)
    return process, folder, arguments


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_comparison_that_is_stopped_or_killed_goes_on(killed, number):
    """Also where the parent dies without a word, its run stops with a checkpoint."""
    process, folder, arguments = killed
    process.send_signal(number)
    assert process.wait(60) == (130 if number != signal.SIGKILL else -signal.SIGKILL)
    assert main(arguments) == 0
    assert "resuming" in (folder / "log.txt").read_text()
    assert [row["step"] for row in read_table(folder / "progress.csv")][-1] == "30"
    assert not (folder / "error.txt").exists()


# Processes: short programs stand for the real worker.

PATIENT = "import os, sys; open('ready', 'w').close(); os.read(0, 1); open('ended', 'w').close(); sys.exit(143)"


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return PlannedRun("zero", "run", 0, {"algo": "zero"}, tmp_path / "run")


@pytest.fixture
def use_program(monkeypatch):
    return lambda program: monkeypatch.setattr(processes, "WORKER", (sys.executable, "-c", program))


@pytest.mark.parametrize(
    ("program", "outcome", "reason"),
    [
        ("", "finished", ""),
        ("import sys; sys.exit(3)", "in use", ""),
        ("raise ImportError('no such module')", "failed", "ImportError: no such module (exit code 1; see log.txt)"),
        ("import os; os._exit(7)", "failed", "no output (exit code 7; see log.txt)"),
        (
            "import os; open('count', 'a').write('x'); os.kill(os.getpid(), 9)",
            "failed",
            "killed by SIGKILL (exit code -9; see log.txt)",
        ),
    ],
)
def test_a_process_that_fails_leaves_a_reason_and_a_killed_one_is_started_again(
    run, use_program, program, outcome, reason
):
    use_program(program)
    run.folder.mkdir()
    for name in ("error.txt", "log.txt"):
        (run.folder / name).write_text("of an earlier attempt\n")
    assert carry_out(run, Protocol(), Resources()) == outcome and run.error == reason
    if "SIGKILL" in reason:
        assert Path("count").read_text() == "xxx"


@pytest.mark.parametrize("urgency", [1, 2])
def test_a_process_is_asked_to_stop_before_it_is_killed(run, use_program, urgency):
    use_program(PATIENT)
    executor = LocalExecutor(1, Resources())
    futures = [executor.submit(run, Protocol()) for _ in range(2)]
    while not Path("ready").exists():
        time.sleep(0.01)
    executor.stop(urgency)
    executor.shutdown()
    assert [future.result() for future in futures] == ["stopped", "stopped"] and not run.error
    assert urgency == 2 or Path("ended").exists()


def test_a_folder_in_use_is_left_alone(finished, monkeypatch):
    monkeypatch.setattr(worker, "WAIT", 0.0)
    folder = finished / "runs" / NAMES[0]
    options = json.loads((folder / "comparison.json").read_text())["options"]
    before = (folder / "comparison.json").read_bytes()
    with FileLock(folder / ".comparison.lock"):
        code = worker.train_and_evaluate(PlannedRun("zero", "shapematch", 0, options, folder), Protocol(9, 100))
    assert code == worker.IN_USE and (folder / "comparison.json").read_bytes() == before


def test_missing_ray_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert compare(tmp_path / "out", "--algos", "zero", "--executor", "ray") == 2
    assert "pip install 'torchmpm[ray]'" in capsys.readouterr().err


def test_workers_share_the_cores(monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(4)), raising=False)
    assert Command(workers=2).make_executor().resources.threads == 2
    assert Command(workers=2, cpus_per_run=3).make_executor().resources.threads == 3


# The plan.


def runs_of(plan, *labels, task="run", **options):
    file = {"common": {}, "tasks": {}, "algos": {}} | plan
    return make_runs(file, [task], labels, [0], Path("runs"), device="cpu", **options)


def test_the_narrower_section_of_a_plan_wins():
    plan = {
        "common": {"algo": "coarse", "num_envs": 2, "eval_every": 500},
        "tasks": {"run": {"eval_every": 600}},
        "algos": {
            "shac": {"num_envs": 4, "tasks": {"run": {"steps": 480}}},
            "long": {"tasks": {"run": {"alpha": [1.0]}}},
        },
    }
    shac, long = (run.options for run in runs_of(plan, "shac", "long", steps=96000))
    assert (shac["algo"], shac["num_envs"], shac["eval_every"], shac["steps"]) == ("shac", 4, 600, 480)
    assert (long["algo"], long["num_envs"], long["alpha"], long["steps"]) == ("coarse", 2, [1.0], 96000)
    assert "steps" not in runs_of({}, "gradient", steps=960)[0].options


def test_names_in_a_plan_that_mean_nothing_are_reported(capsys):
    algos = {"shca": {"steps": 480}, "shac": {"tasks": {"run": {}, "rnu": {"steps": 480}}}}
    runs_of({"tasks": {"rnu": {}}, "algos": algos}, "shac")
    assert capsys.readouterr().out.splitlines() == [
        "plan: tasks rnu are not in this comparison",
        "plan: algos shca are not in this comparison",
        "plan: algos.shac.tasks rnu are not in this comparison",
    ]


def test_options_become_words():
    options = {"eval_every": 5, "video": False, "resample": True, "handover": [], "resolutions": [4, 8], "clip": None}
    assert to_words(options) == (
        "--eval-every 5 --no-video --resample --handover --resolutions 4 8 --clip None".split()
    )


def test_tasks_of_one_name_in_two_modules_are_refused(monkeypatch):
    """They would have one folder, and the results of one of them would stand in the rows of both."""
    monkeypatch.setattr("baselines.compare.plan.reference_config", lambda options: None)
    with pytest.raises(ConfigError, match="zero on first:hop and zero on second:hop are both named zero-hop-quick-0"):
        make_runs(read_plan(None), ["first:hop", "second:hop"], ["zero"], [0], Path("runs"))


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("compare-plan*.json")), ids=lambda path: path.stem)
def test_plans_of_the_documentation_hold(path):
    plan = read_plan(path)
    assert make_runs(plan, ["run"], list(plan["algos"]), [0], Path("runs"))


def test_a_folder_that_is_no_comparison_s_is_refused(tmp_path):
    (run,) = runs_of({}, "zero")
    run = PlannedRun("zero", "run", 0, run.options, tmp_path)
    write_text(tmp_path / "config.json", "{}")
    with pytest.raises(ConfigError, match="no comparison has begun"):
        run.check_folder()
    write_text(tmp_path / "comparison.json", '{"options": {')
    with pytest.raises(ConfigError, match=r"comparison\.json"):
        run.check_folder()


# Statistics and the report.


def test_curves_are_aligned_where_all_have_values():
    one = np.array([0.0, 10.0, 20.0]), np.array([0.0, 10.0, 20.0])
    two = np.array([5.0, 15.0]), np.array([1.0, 3.0])
    steps, values = align([one, two])
    assert steps.tolist() == [5, 10, 15]
    assert values.tolist() == [[5, 10, 15], [1, 2, 3]]
    apart = np.array([30.0]), np.array([1.0])
    assert align([one, apart])[1].shape == (2, 0)


def written(folder, label, seed, returns, observes="image", curve=None, plan=None):
    """A run as it lies in its folder."""
    run = PlannedRun(label, "run", seed, {"algo": label, "device": "cpu"}, folder / f"{label}-{seed}")
    layouts, successes = list(range(20000, 20000 + len(returns))), [value > 5 for value in returns]
    evaluation = {"policy": label if label == "zero" else "", "particles": "lite", "noise": True, "observes": observes}
    evaluation |= {"episodes": len(returns), "layouts": layouts, "own_layout": plan}
    evaluation |= {"returns": returns, "successes": successes}
    record = {"options": run.options, "evaluation": evaluation}
    write_json(run.folder / "comparison.json", record | ({"seconds": 120.0} if curve else {}))
    if curve:
        write_text(run.folder / "results.json", "[]")
        write_text(run.folder / "evaluations.csv", "step,mean\n" + "".join(f"{s},{v}\n" for s, v in curve.items()))
    return run


def test_table_against_values_worked_out_by_hand(tmp_path):
    runs = [
        written(tmp_path, "zero", 0, [1.0, 3.0], "nothing"),
        written(tmp_path, "shac", 0, [4.0, 6.0], "state", {500: 1, 1000: 2}),
        written(tmp_path, "shac", 1, [7.0, 7.0], "state", {500: 1, 1000: 2}),
        written(tmp_path, "coarse", 1, [8.0, 8.0], curve={500: 1}),
        PlannedRun("coarse", "run", 0, {"algo": "coarse"}, tmp_path / "coarse-0"),
    ]
    write_text(runs[-1].folder / "error.txt", "NonFiniteError: a loss | is not finite\n")
    results = [read_result(run, Protocol(2)) for run in runs]
    assert [result.state for result in results] == [*["finished"] * 4, "failed"]
    coarse, shac, zero = make_table(results, "zero", Protocol(2)).rows
    assert [row["algorithm"] for row in (coarse, shac, zero)] == ["coarse", "shac", "zero"]
    assert (shac["mean"], shac["seeds"], shac["episodes"], shac["success"]) == (6.0, 2, 4, 0.75)
    assert shac["interval"] == pytest.approx(12.7062, abs=1e-4)  # of 5 and 7
    assert (shac["difference"], shac["steps"], shac["minutes"]) == (4.0, 1000, 2.0)
    assert shac["difference_interval"] == pytest.approx(12.7062, abs=1e-4)
    assert (coarse["interval"], coarse["difference"], "difference" in zero) == (None, 6.0, False)
    against_shac = {row["algorithm"]: row for row in make_table(results, "shac", Protocol(2)).rows}
    assert (
        against_shac["coarse"]["difference"] == 1.0 and against_shac["zero"]["difference"] == -4.0
    )  # in pairs of seeds
    write_report(tmp_path, results, "zero", Protocol(2))
    for name in ("report.md", "index.html"):
        text = (tmp_path / name).read_text()
        assert "coarse-0: failed (NonFiniteError" in text and "+4.0" in text and "4 of 5 runs" in text
    assert len(rows(tmp_path)) == 8


def test_a_plan_has_a_row_for_its_own_start_and_one_for_others(tmp_path):
    runs = [written(tmp_path, "mpc", seed, [4.0, 6.0], "simulator", {500: 1}, plan=10.0 + seed) for seed in (0, 1)]
    results = [read_result(run, Protocol(2)) for run in [*runs, written(tmp_path, "zero", 0, [1.0, 3.0], "nothing")]]
    plan, replayed, zero = make_table(results, "zero", Protocol(2)).rows
    assert [row["algorithm"] for row in (plan, replayed)] == ["mpc: plan", "mpc: plan, replayed from another start"]
    assert (plan["mean"], plan["episodes"], "difference" in plan) == (10.5, 2, False)
    assert (replayed["mean"], replayed["episodes"], replayed["difference"]) == (5.0, 4, 3.0)
    assert zero["algorithm"] == "zero"


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_of_the_report_is_cut_off(tmp_path, browser, width):
    runs = [
        written(tmp_path, label, seed, [70_123.4, -60_123.4], what, {25_600: 1}, plan=plan)
        for label, what, plan in (
            ("cfp-analytic", "image", None),
            ("transformer-64", "state", None),
            ("gradient", "simulator", 1e5),
            ("zero", "nothing", None),
        )
        for seed in ((0,) if label == "zero" else (0, 1))
    ]
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.goto(write_report(tmp_path, [read_result(run, Protocol(2)) for run in runs], "zero", Protocol(2)).as_uri())
    boxes = "[...document.querySelectorAll('html, .wide, img')].map(box => [box.scrollWidth, box.clientWidth])"
    whole, table, picture = page.evaluate(boxes)
    assert whole == [width, width] and table[0] == table[1] > 0.9 * width and picture[1] > 0.9 * width


def test_evaluations_under_another_protocol_do_not_count(tmp_path):
    run = written(tmp_path, "shac", 0, [4.0, 6.0], "state", {500: 1})
    protocols = (Protocol(1), Protocol(3), Protocol(2, "full"), Protocol(2, "lite", "without"))
    found = [read_result(run, protocol).state for protocol in protocols]
    assert found == ["not evaluated"] * 4 and read_result(run, Protocol(2)).state == "finished"
    write_text(run.folder / "policy.safetensors", "another")
    assert read_result(run, Protocol(2)).state == "not evaluated"
    assert [Protocol().deterministic(task) for task in ("shapematch", "run", "module:own")] == [True, False, False]
