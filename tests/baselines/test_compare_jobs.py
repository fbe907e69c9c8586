"""The runs of a comparison and their options."""

from pathlib import Path

import pytest
from test_compare import PLAN, compare

from baselines.compare.final_evaluation import Protocol
from baselines.compare.jobs import Job, Plan, make_jobs, resolve
from baselines.compare.worker import decode, encode
from baselines.registry import configure


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--seeds 9500 --algos mpc", "seeds must be between 0 and 8999, got 9500"),
        ("--only 0 --report-only", "only cannot be combined with --report-only"),
        ("--address head:6379", "address requires --executor ray, got head:6379"),
        ("--protocol v1 --report-only", "protocol cannot be combined with --only or --report-only, got v1"),
        (
            "--algos mpc other",
            "target must be the same for all algorithms on shapematch, got 'M' for other and None for mpc",
        ),
    ],
)
def test_wrong_options_are_named(tmp_path, capsys, options, message):
    plan = {"algos": {**PLAN["algos"], "other": {"algo": "mpc", "environment": {"target": "M"}}}}
    assert compare(tmp_path / "out", *options.split(), plan=plan) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_algorithm_for_all_is_that_of_variants():
    plan = Plan(common={"algo": "coarse"}, algos={"long": {"steps": 9600}, "shac": {"algo": "cem"}})
    labels = ("zero", "gnn-16", "long", "shac")
    found = [resolve(plan, label, "run", "quick", 0, None, "cpu").algo for label in labels]
    assert found == ["zero", "gnn-16", "coarse", "cem"]


def test_presets_follow_the_learner_and_the_policy_to_start_from():
    algos = {
        "gradients": {"algo": "cfp", "learner": "analytic", "steps": 6400},
        "refined": {"algo": "coarse", "start_from": "run", "refine": True},
        "late": {"algo": "cfp", "steps": 1000, "learning": {"actor_start": 4000}},
    }
    gradients, refined, late = (resolve(Plan(algos=algos), name, "run", "quick", 0, None, "cpu") for name in algos)
    assert (gradients.learner, gradients.handover) == ("analytic", (4800,))
    assert (refined.resolutions, refined.network.encoder, refined.learning.batch_size) == ((8,), "paper", 64)
    assert late.learning.actor_start == 4000


def test_other_spellings_are_reported_under_the_name(tmp_path, capsys):
    assert compare(tmp_path / "out", "--dry-run", "--algos", "gnn16", "--tasks", "run", plan={}) == 0
    assert capsys.readouterr().out.split()[:2] == ["0", "gnn-16-run-quick-0"]


def test_a_plan_may_spell_algorithms_in_another_way(tmp_path):
    (tmp_path / "plan.json").write_text('{"algos": {"gnn16": {"alpha": 0.5, "steps": 3840}}}')
    config = resolve(Plan.read(tmp_path / "plan.json"), "gnn-16", "run", "quick", 0, None, "cpu")
    assert config.alpha == 0.5 and config.learning.actor_start == 80  # scaled with the steps


def test_names_in_a_plan_that_mean_nothing_are_reported(tmp_path, capsys):
    algos = {"cfp": {"tasks": {"rnu": {"steps": 9600}, "run": {"steps": 6400}}}, "shac": {"tasks": {"kick": {}}}}
    assert compare(tmp_path / "out", "--dry-run", "--algos", "cfp", "--tasks", "run", plan={"algos": algos}) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("plan")]
    assert said == [
        "plan: algos shac are not in this comparison",
        "plan: algos.cfp.tasks rnu are not in this comparison",
    ]


def test_options_without_effect_are_refused_where_they_are_for_one_algorithm(tmp_path, capsys):
    idle = {"learning": {"noise_cells": 4}}
    for algos in ({"gnn-16": idle}, {"gnn-16": {"tasks": {"run": idle}}}, {"gnn": {"algo": "gnn-16", **idle}}):
        (label,) = algos
        assert compare(tmp_path / "out", "--algos", label, "--tasks", "run", plan={"algos": algos}) == 2
        error = capsys.readouterr().err
        assert f"{label} on run: noise_cells requires " in error
    full = {"network": {"encoder": "paper"}}
    plan = {"common": idle, "algos": {"cfp": full, "coarse": full, "gnn-16": {"learning": {"noise_cells": 0}}}}
    assert compare(tmp_path / "out", "--dry-run", "--algos", "cfp", "coarse", "gnn-16", plan=plan) == 0


def test_default_of_a_task_is_the_same_task_by_name(tmp_path):
    for task, option, default in (("shapematch", "target", "star"), ("slot", "variant", "registered")):
        plan = {"algos": {"mpc": {"environment": {option: default}}}}
        assert compare(tmp_path / "out", "--dry-run", "--algos", "zero", "mpc", "--tasks", task, plan=plan) == 0


@pytest.mark.parametrize("path", sorted((Path(__file__).parents[2] / "docs").glob("compare-plan*.json")), ids=str)
def test_plans_of_the_documentation_hold(path, tmp_path):
    plan = Plan.read(path)
    assert make_jobs(plan, ["run"], list(plan.algos), [0], tmp_path, lambda _: Protocol(1))


@pytest.mark.parametrize("tier", ["lite", 100, (100, 50)])
def test_job_is_the_same_in_another_process(tmp_path, tier):
    job = Job("mine", configure({"algo": "cem", "task": "kick"}), tmp_path, Protocol(3, tier, "all", "with"))
    assert decode(encode(job, 1.5).decode()) == (job, 1.5)


def test_steps_of_the_command_line_hold_where_the_plan_has_none():
    assert resolve(Plan(), "shac", "run", "quick", 0, 960, "cpu").steps == 960
    plan = Plan(algos={"shac": {"steps": 480}})
    assert resolve(plan, "shac", "run", "quick", 0, 960, "cpu").steps == 480
