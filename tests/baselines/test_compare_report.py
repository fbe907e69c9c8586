"""The report of a comparison, from run folders whose contents are written by the test."""

import csv
import hashlib
import json
from dataclasses import replace

import pytest
import torch

from baselines.compare.__main__ import main
from baselines.compare.final_evaluation import Protocol
from baselines.compare.jobs import Plan, make_jobs
from baselines.compare.plots import learning_curves
from baselines.compare.report import make_tables
from baselines.compare.results import group_results, read_result
from baselines.compare.tables import aggregate_table, cost_table, efficiency_table, paper_table
from cfp.config import to_json
from cfp.files import write_json, write_text
from cfp.policy import describe_run, write_policy

LABELS = ["zero", "cfp", "shac", "shac-image"]
PLAN = {"algos": {"shac-image": {"algo": "shac", "sees": "image"}}}


def plan_jobs(folder, tasks, labels, seeds, protocol, plan=None):
    return make_jobs(plan or Plan(), tasks, labels, seeds, folder, protocol)


def write_run(job, scores, curve, *, successes=0, seconds=100.0, cases=(0.8, 0.5)):
    """A folder as a run that was trained to step 1000 and evaluated leaves it."""
    write_json(job.folder / "config.json", to_json(job.config))
    newest = job.folder / "policy.safetensors"
    write_policy(newest, {}, describe_run(job.config, job.config.algo, 1, 0))
    lines = [f"{step},{value}" for step, value in curve.items()]
    write_text(job.folder / "evaluations.csv", "\n".join(["step,mean", *lines]) + "\n")
    session = {"from": 0, "to": 1000, "seconds": seconds + 7, "evaluation_seconds": 7.0, "memory": 2**30}
    session |= {"device": "cpu"}
    write_json(job.folder / "sessions.json", {"finished": job.config.ends()[-1], "sessions": [session]})
    protocol, task = replace(job.protocol, episodes=len(scores)), job.config.task
    (first,) = protocol.batches(task)
    entries = {first: {"returns": scores, "successes": successes}}
    for case, share in zip(protocol.disturbed_cases(), cases, strict=True):
        (key,) = protocol.batches(task, case)
        found = share and {"returns": [share * sum(scores) / len(scores)], "successes": 0}
        entries[key] = found
    policy = "zero" if job.untrained else hashlib.sha256(newest.read_bytes()).hexdigest()
    write_json(job.folder / "final_evaluation.json", {"policy": policy, "entries": entries})


def two_or_four(config):
    """Episodes of the runs below: SLOT has four of each algorithm."""
    return Protocol(4 if config.task == "slot" and config.algo == "zero" else 2)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """RUN and SLOT; zero, cfp, shac (state) and shac-image; seeds 0 and 1; shac-image failed on SLOT."""
    out = tmp_path_factory.mktemp("report")
    (out / "plan.json").write_text(json.dumps(PLAN))
    jobs = plan_jobs(out / "runs", ["run", "slot"], LABELS, [0, 1], two_or_four, Plan(**PLAN))
    for job in jobs:
        if job.label == "zero":
            write_run(job, [3000, 3000] if job.config.task == "run" else [5000] * 4, {1: 2990})
            continue
        shift = {"cfp": 0, "shac": 3000, "shac-image": 1000}[job.label] + 100 * job.config.seed
        curve = {500: 2600 + shift, 1000: 4000 + shift}
        if job.config.task == "run":
            blind = job.label == "shac"
            write_run(job, [3900 + shift, 4100 + shift], curve, cases=(0.8, None if blind else 0.5))
        elif job.label != "shac-image":
            write_run(job, [8000 + shift] * 2, {}, successes=job.config.seed)
        else:
            write_text(job.folder / "error.txt", "NonFiniteError: a loss | is not finite\n")
    options = f"--tasks run slot --algos {' '.join(LABELS)} --seeds 0 1 --plan {out / 'plan.json'} --out {out}"
    code = main([*options.split(), "--episodes", "2", "--slot-episodes", "4", "--report-only"])
    assert code == 1  # two runs are missing
    return out


def read_groups(jobs):
    return group_results([read_result(job) for job in jobs])


def groups_of(report, tasks=("run", "slot"), labels=LABELS):
    return read_groups(plan_jobs(report / "runs", tasks, labels, [0, 1], two_or_four, Plan(**PLAN)))


def rows(folder, name):
    with open(folder / f"{name}.csv", newline="") as file:
        return list(csv.DictReader(file))


def find(table, **wanted):
    (row,) = [row for row in table if all(row[key] == value for key, value in wanted.items())]
    return row


def test_final_evaluation(report):
    table = rows(report, "returns")
    row = find(table, task="run", algo="cfp")
    assert [float(row[name]) for name in ("iqm", "low", "high")] == [4050, 4000, 4100]
    assert float(row["std"]) == pytest.approx(70.71, abs=0.01)
    assert (row["seeds"], row["episodes"]) == ("2", "4")
    assert find(table, task="slot", algo="shac-image")["iqm"] == ""


def test_what_is_seen_is_never_ranked_together(report):
    table = rows(report, "returns")
    ranks = {(row["sees"], row["algo"]): row["rank"] for row in table if row["task"] == "run"}
    assert ranks.pop(("nothing", "zero")) == "1"
    # shac has the highest return, but is alone with the state.
    assert ranks == {("image", "cfp"): "2", ("image", "shac-image"): "1", ("state", "shac"): "1"}
    assert [row["sees"] for row in table] == ["image", "image", "state", "nothing"] * 2
    for name in ("index.html", "report.md"):
        text = (report / name).read_text()
        assert "image: cfp, shac-image; state: shac; nothing: zero." in text
        assert "never ranked together" in text


def test_what_learns_nothing_is_one_run(report):
    row = find(rows(report, "returns"), task="run", algo="zero")
    assert (row["seeds"], row["episodes"], row["iqm"], row["low"]) == ("1", "2", "3000.0", "")
    assert find(rows(report, "returns"), task="slot", algo="zero")["episodes"] == "4", "as many as of two seeds"
    assert "One run stands for all seeds of zero." in (report / "index.html").read_text()


def test_paper_s_returns_are_set_beside_full_size_only(report):
    assert rows(report, "aggregate") == rows(report, "paper") == []
    for name in ("index.html", "report.md"):
        assert "They are not compared with the paper" in (report / name).read_text()
    groups = groups_of(report)
    full, lite = (
        {each.name: each.rows for each in make_tables([], groups, Protocol(2, tier))} for tier in ("full", "lite")
    )
    assert full["aggregate"] and full["paper"] and not lite["aggregate"] and not lite["paper"]


def test_all_tasks_together_rank_only_who_did_all(report):
    table = aggregate_table(groups_of(report)).rows
    cfp = find(table, algo="cfp")
    # (4000 - 2500) / 6150, with seed 1 a hundred more; (8000 - 7000) / 58000: four scores, the middle two.
    assert float(cfp["iqm"]) == pytest.approx((1100 / 58000 + 1500 / 6150) / 2)
    assert cfp["rank"] == 1
    assert "rank" not in find(table, algo="shac-image")


def test_sample_efficiency(report):
    row = find(rows(report, "efficiency"), task="run", algo="cfp")
    # Best of those that see the image: shac-image, 5050; half of the way from zero's 3000 to there is 4025.
    assert (float(row["rest"]), float(row["best"])) == (3000, 5050)
    assert (row["steps_50%"], row["reached_50%"]) == ("1000.0", "1/2")
    assert (row["steps_75%"], row["reached_75%"]) == ("", "0/2")
    assert float(find(rows(report, "efficiency"), task="run", algo="shac")["best"]) == 7050
    assert all(row["algo"] != "zero" for row in rows(report, "efficiency"))


@pytest.mark.parametrize(
    ("labels", "tier", "words"),
    [
        (["cfp"], "lite", "add zero to --algos"),
        (["zero", "cfp"], "full", "No entry for cfp, evaluated during training with particles other than full"),
    ],
)
def test_efficiency_without_a_rest_of_its_size_says_so(report, labels, tier, words):
    table = efficiency_table(groups_of(report, ["run"], labels), tier)
    assert words in table.description and "steps_50%" not in find(table.rows, algo="cfp")


def test_cost_beside_the_paper_s(report):
    row = find(rows(report, "cost"), task="run", algo="cfp")
    assert float(row["speed"]) == 10  # without the 7 s of evaluations
    assert float(row["episode"]) == 80  # 800 steps
    assert (row["memory"], row["paper_episode"], row["paper_memory"]) == ("1024.0", "54", "4053")
    assert find(rows(report, "cost"), task="slot", algo="cfp")["paper_episode"] == ""


def test_cost_names_the_particles_of_planners_without_a_tier_of_their_own(tmp_path):
    (job,) = plan_jobs(tmp_path, ["run"], ["mpc"], [0], lambda _: Protocol(1))
    write_run(job, [1.0], {})
    (row,) = cost_table(read_groups([job])).rows
    assert row["particles"] == "lite"


def test_training_of_a_teacher_is_counted_by_itself(tmp_path):
    (job,) = plan_jobs(tmp_path, ["run"], ["distill"], [0], lambda _: Protocol(1))
    write_run(job, [1.0], {500: 1.0, 1000: 2.0}, seconds=100.0)
    write_json(job.folder / "teacher" / "cost.json", {"steps": 300, "seconds": 65.0, "evaluation_seconds": 5.0})
    groups = read_groups([job])
    (row,) = cost_table(groups).rows
    assert (row["speed"], row["minutes"], row["teacher"], row["teacher_steps"]) == (10, 100 / 60, 1, 300)
    (line,) = learning_curves(groups, minutes=True).axes[0].lines
    assert line.get_xdata().tolist() == pytest.approx([1 + 50 / 60, 1 + 100 / 60])


def test_legend_of_learning_curves_names_those_that_are_drawn(tmp_path):
    jobs = plan_jobs(tmp_path, ["run"], ["zero", "shac"], [0], lambda _: Protocol(1))
    write_run(jobs[0], [1.0], {})
    write_run(jobs[1], [1.0], {500: 1.0, 1000: 2.0})
    (legend,) = learning_curves(read_groups(jobs)).legends
    assert [text.get_text() for text in legend.get_texts()] == ["shac (observes state)"]


def test_success_of_slot(report):
    row = find(rows(report, "success"), task="slot", algo="cfp")
    assert (row["successes"], row["episodes"], row["rate"], row["paper"]) == ("1", "4", "0.25", "0.154")
    assert float(row["low"]) == pytest.approx(0.0456, abs=1e-4)
    assert float(row["high"]) == pytest.approx(0.6994, abs=1e-4)


def test_robustness_beside_the_paper_s(report):
    table = rows(report, "robustness")
    row = find(table, task="run", algo="cfp", case="action dropout 20%")
    assert (float(row["ratio"]), row["paper"]) == (0.8, "0.954")
    assert find(table, task="run", algo="cfp", case="observation dropout 20%")["paper"] == "0.877"
    blind = find(table, task="run", algo="shac", case="observation dropout 20%")
    assert (blind["ratio"], blind["seeds"], blind["paper"]) == ("", "0", "")
    assert "| run | state | shac | observation dropout 20% | 0 | – | – | – | – |" in (report / "report.md").read_text()
    assert find(table, task="run", algo="shac", case="action dropout 20%")["ratio"] != ""


def test_paper_s_returns_stand_beside_ours(report):
    row = find(paper_table(groups_of(report)).rows, task="run", algo="cfp")
    assert (row["ours"], row["paper"], row["band"], row["paper_steps"]) == (4050, 8650, 420, 550_000)


def test_failures_are_named(report):
    row = find(rows(report, "runs"), run="shac-image-slot-quick-1")
    assert (row["state"], row["error"]) == ("failed", "NonFiniteError: a loss | is not finite")
    assert "12 of 14 runs are finished and evaluated; the others:" in (report / "index.html").read_text()
    assert "NonFiniteError: a loss \\| is not finite" in (report / "report.md").read_text()


def test_page_shows_only_files_beside_it(report):
    page = (report / "index.html").read_text()
    for name in ("curves.png", "minutes.png", "returns.png", "returns.csv", "cost.csv"):
        assert f'"{name}"' in page and (report / name).stat().st_size > 0
    assert "http" not in page
    assert page.count("<table>") == page.count("</table>") == 6


def test_evaluations_of_another_policy_do_not_count(report, tmp_path):
    (job,) = plan_jobs(tmp_path / "runs", ["run"], ["cfp"], [0], lambda _: Protocol(2))
    write_run(job, [1.0, 2.0], {1000: 5.0})
    write_policy(job.folder / "policy.safetensors", {"more": torch.zeros(1)}, describe_run(job.config, "cfp", 1, 0))
    assert main(f"--tasks run --algos cfp --seeds 0 --out {tmp_path} --episodes 2 --report-only".split()) == 1
    assert find(rows(tmp_path, "returns"), task="run")["iqm"] == ""
    assert find(rows(tmp_path, "runs"), task="run")["state"] == "unevaluated"
