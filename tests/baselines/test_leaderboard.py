"""The leaderboard: a protocol that is fixed, submissions that are checked, and their ranking."""

import csv
import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from policy_files import save_actor

import dittogym
from baselines import leaderboard
from baselines.compare.__main__ import main as compare
from baselines.leaderboard.__main__ import main as check
from baselines.leaderboard.__main__ import rankings
from baselines.leaderboard.protocol import PROTOCOLS, V1
from baselines.leaderboard.submission import Scores, Submission, Training, read_submission, read_submissions
from cfp.agent.actor import build_actor
from cfp.config import EVALUATION_SEED, LARGEST_SEED
from cfp.errors import ConfigError
from cfp.evaluation.returns import Played
from cfp.files import write_json
from cfp.policy import SHIPPED, shipped
from cfp.presets import preset

COMMITTED = Path(__file__).resolve().parents[2] / "docs" / "leaderboard"
RETURNS = tuple(float(value) for value in range(100, 108))
SUCCESSES = (True, True, *[False] * 6)
VALID = Submission(
    protocol="v1",
    task="run",
    policy="mine",
    sha256="0a" * 32,
    sees="image",
    training=Training(1000, 2.5),
    library="0.1.0",
    returns=RETURNS,
    successes=SUCCESSES,
    scores=Scores.of(RETURNS, SUCCESSES),
)


@pytest.fixture
def tiny(monkeypatch):
    """The protocol with a hundred particles, one substep in a step, and two layouts."""
    environment = replace(V1.environment, particles=100, substeps=1)
    seeds = range(V1.seeds[0], V1.seeds[0] + 2)
    monkeypatch.setitem(PROTOCOLS, "v1", replace(V1, environment=environment, seeds=seeds, counts=(100, 90)))
    return environment


def written(folder, *submissions):
    """Files of submissions."""
    paths = [folder / f"{number}.json" for number in range(len(submissions))]
    for path, submission in zip(paths, submissions, strict=True):
        write_json(path, asdict(submission))
    return paths


def scored(mean, **changes):
    """A valid submission with a mean return."""
    returns = tuple(value - 103.5 + mean for value in RETURNS)
    return replace(VALID, returns=returns, scores=Scores.of(returns, SUCCESSES), **changes)


def rest(task, seed, particles):
    """The return of a robot at rest, played without the package's evaluation."""
    env = dittogym.TorchEnv(task, 1, particles=particles, substeps=1, resolution=8)
    env.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(torch.zeros(1, 2, 8, 8))
        total, ended = total + reward.item(), bool(terminated | truncated)
    return round(total, 3)


def test_the_protocol_never_changes():
    assert asdict(V1) == {
        "version": "v1",
        "tasks": ("shapematch", "run", "grow", "kick", "dig", "obstacle", "catch", "slot"),
        "environment": {
            "num_envs": 1,
            "particles": "lite",
            "substeps": 100,
            "dt": 1e-4,
            "dtype": "float32",
            "backend": "auto",
            "action_layout": None,
            "parity": "clean",
            "resample": False,
            "target": None,
            "variant": None,
        },
        "seeds": range(3_000_000_000, 3_000_000_008),
        "counts": (2000, 1960, 1920, 1880, 1840, 1800, 1760, 1720),
        "deterministic": True,
        "device": "cpu",
    }


def test_no_run_comes_to_its_layouts():
    assert V1.seeds[0] > LARGEST_SEED + 3 * EVALUATION_SEED


@pytest.mark.parametrize("task", V1.tasks)
def test_all_layouts_of_a_task_differ(task):
    environment = replace(V1.environment, num_envs=1)
    first, second = (V1.config(task, seed, environment).environment.particles for seed in V1.seeds[:2])
    states = []
    for seed, particles in zip(V1.seeds[:2], (first, second), strict=True):
        env = dittogym.TorchEnv(task, 1, particles=particles)
        env.reset(seed=seed)
        states.append(env.state.x)
    assert (first == second) == (task not in ("grow", "obstacle"))
    assert states[0].shape != states[1].shape or not torch.equal(*states)


def test_policies_are_evaluated_and_ranked(tiny, tmp_path, capsys):
    config = replace(preset("shapematch", "quick"), environment=replace(tiny, action_layout="grid"))
    policy = tmp_path / "my policy.safetensors"
    save_actor(policy, build_actor(config.actor_spec(1)), config, 1, 1234)
    words = f"--protocol v1 --tasks shapematch --out {tmp_path} --policies zero random".split()
    assert compare([*words, str(policy)]) == 0
    files = {path.name: path for path in (tmp_path / "submissions").iterdir()}
    assert set(files) == {"shapematch-zero.json", "shapematch-random.json", "shapematch-my-policy.json"}
    mine, zero = (read_submission(files[f"shapematch-{name}.json"]) for name in ("my-policy", "zero"))
    assert mine.sha256 == hashlib.sha256(policy.read_bytes()).hexdigest() and mine.sees == "image"
    assert mine.training == Training(1234, None) and zero.training == Training() and zero.sha256 is None
    assert zero.returns == pytest.approx([rest("shapematch", seed, 100) for seed in PROTOCOLS["v1"].seeds])

    capsys.readouterr()
    assert check([str(path) for path in files.values()]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "## shapematch" and [line.split(" | ")[:3] for line in lines[6:]] == [
        ["| 1", "my-policy", "image"],
        *(["| 1", name, "nothing"] for name in [max("zero", "random", key=lambda name: mean_of(files, name))]),
        *(["| 2", name, "nothing"] for name in [min("zero", "random", key=lambda name: mean_of(files, name))]),
    ]


def mean_of(files, name):
    return read_submission(files[f"shapematch-{name}.json"]).scores.mean


def test_tasks_without_random_positions_vary_the_particles(tiny, tmp_path, monkeypatch):
    def count_particles(trials, steps):
        envs = [trials[0].make_env(seed, 1) for seed in PROTOCOLS["v1"].seeds]
        for env in envs:
            env.reset()
        return [[Played(float(env.unwrapped.torch_env.state.x.shape[1]), False) for env in envs]]

    monkeypatch.setattr(leaderboard.evaluation, "play", count_particles)
    assert compare(f"--protocol v1 --tasks obstacle grow --out {tmp_path} --policies zero".split()) == 0
    for task in ("obstacle", "grow"):
        assert read_submission(tmp_path / "submissions" / f"{task}-zero.json").returns == (100, 90)


def test_runs_of_a_comparison_are_submitted_once(tiny, tmp_path, monkeypatch, capsys):
    options = {"grid": 8, "planner": {"horizon": 3, "commit": 2, "iterations": 1}, "report": {"eval_every": 12}}
    plan = {"common": {"environment": {"particles": 100, "substeps": 1, "num_envs": 1}}, "algos": {"mpc": options}}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    words = "--protocol v1 --algos zero mpc --seeds 0 --device cpu --episodes 1 --particles 100".split()
    words += "--robustness none --workers 0".split()
    words += ["--plan", str(tmp_path / "plan.json"), "--out", str(tmp_path)]
    assert compare(words) == 0
    paths = sorted((tmp_path / "submissions").iterdir())
    assert [path.name for path in paths] == ["shapematch-mpc-shapematch-quick-0.json", "shapematch-zero.json"]
    planned = read_submission(paths[0])
    assert planned.sees == "simulator" and planned.training.steps == 30 and planned.training.minutes is not None

    monkeypatch.setattr(leaderboard.evaluation, "evaluate", None)  # must not be needed again
    assert compare(words) == 0
    assert read_submission(paths[0]) == planned


def test_policies_of_other_tasks_are_refused(tmp_path, capsys):
    def error(*words):
        assert compare([*words, "--out", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err

    protocol = ["--protocol", "v1", "--policies"]
    config = preset("shapematch", "quick")
    for changes, expected in (
        ({"target": "T"}, "policies must be a policy for the target of the task, got T"),
        ({"substeps": 50}, "policies must be a policy for environment steps of 0.01 s, got 0.005"),
    ):
        there = replace(config, environment=replace(config.environment, **changes))
        save_actor(tmp_path / "a.safetensors", build_actor(config.actor_spec(1)), there, 1, 0)
        assert expected in error(*protocol, str(tmp_path / "a.safetensors"))
    assert "there is no policy" in error(*protocol, "none")
    assert "got several for run-pretrained.json" in error(*protocol, "run", "run")
    assert "got several for grow-grow-success.json" in error(*protocol, "grow", "grow-success", "grow-success")
    assert "policies requires protocol" in error("--policies", "run")
    assert "policies requires protocol, and none of only" in error(*protocol, "run", "--dry-run")
    assert not (tmp_path / "out").exists()


def test_a_submission_is_read_as_it_was_written(tmp_path):
    paths = written(tmp_path, VALID)
    assert read_submissions(paths) == [VALID]
    assert VALID.scores == Scores(103.5, pytest.approx(2.048, abs=1e-3), 0.25)  # t(7) = 2.365, s = 2.449


@pytest.mark.parametrize(
    ("changes", "defects"),
    [
        ({"protocol": "v0"}, ["protocol must be v1, got 'v0'"]),
        ({"scores": {**asdict(VALID.scores), "mean": 103.6}}, ["scores.mean must be 103.500, as the episodes give, "]),
        ({"returns": [*RETURNS[:7], 187.0]}, ["scores.mean must be 113.500", "scores.interval must be 24."]),
        ({"successes": [True] * 8}, ["scores.success must be 1.000, as the episodes give, got 0.25"]),
        ({"scores": {}}, ["scores.mean must be", "scores.interval must be", "scores.success must be"]),
        ({"scores": {"mean": float("nan")}}, ["scores.mean must be", "scores.interval must be", "scores.success must"]),
        ({"returns": RETURNS[:7]}, ["returns must have 8 values, one per layout, got 7"]),
        ({"returns": [*RETURNS[:7], float("inf")]}, ["returns must be finite"]),
        ({"returns": [*RETURNS[:7], "1"]}, ["returns must be a number, got '1'"]),
        (
            {"task": "swim", "sha256": "0A", "policy": "<b>"},
            ["task must be one of", "policy must be", "sha256 must be"],
        ),
        ({"policy": "zero"}, ["sha256 and sees must be null and 'nothing' for zero"]),
        ({"sha256": None}, ["sha256 must be 64 hexadecimal digits for a trained policy, got None"]),
        ({"sees": "everything", "colour": 1}, ["'colour' is not an entry", "sees must be 'image' or 'state'"]),
        ({"library": "new"}, ["library must be a version such as '0.1.0', got 'new'"]),
        ({"training": {"steps": -1, "minutes": None}}, ["training.steps must be null or at least 0, got -1"]),
    ],
)
def test_every_defect_has_a_line(tmp_path, capsys, changes, defects):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(json.loads(json.dumps(asdict(VALID))) | changes))
    assert check([str(path)]) == 2
    captured = capsys.readouterr()
    lines = captured.err.removeprefix("error: ").splitlines()
    assert captured.out == "" and len(lines) == len(defects)
    for line, defect in zip(lines, defects, strict=True):
        assert line.startswith(f"{path}: {defect}")


def test_all_files_are_checked_and_copies_are_refused(tmp_path, capsys):
    paths = written(tmp_path, VALID, replace(VALID, policy="again"), replace(VALID, library=""))
    (tmp_path / "3.json").write_text("[1")
    assert check([*map(str, paths), str(tmp_path / "3.json"), str(tmp_path / "none.json")]) == 2
    lines = capsys.readouterr().err.splitlines()
    for line, word in zip(lines, ("one submission for a task", "library", "cannot be read", "none.json"), strict=True):
        assert word in line
    path = tmp_path / "4.json"
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"4\.json: protocol is missing\n.*4\.json: task is missing\n"):
        read_submission(path)


def test_ranks_are_by_mean_return_within_what_is_observed():
    hashes = (f"{number:064x}" for number in range(5))
    submissions = [
        scored(5.0, policy="good", sha256=next(hashes)),
        scored(9.0, policy="best", sha256=next(hashes)),
        scored(5.0, policy="as good", sha256=next(hashes)),
        scored(99.0, policy="planner", sha256=next(hashes), sees="simulator"),
        scored(-7.0, policy="bad", sha256=next(hashes)),
        scored(1.0, policy="zero", sha256=None, sees="nothing", task="kick"),
    ]
    run, kick = rankings(submissions)
    assert [(row["rank"], row["policy"]) for row in run.rows] == [
        (1, "best"),
        (2, "good"),
        (2, "as good"),
        (4, "bad"),
        (1, "planner"),
    ]
    assert (run.name, kick.name) == ("run", "kick") and [row["rank"] for row in kick.rows] == [1]


def test_committed_submissions_are_those_of_the_pretrained_policies():
    submissions = [each for each in read_submissions(sorted(COMMITTED.glob("*.json"))) if each.policy == "pretrained"]
    assert submissions and {each.task for each in submissions} <= set(shipped())
    costs = {row["task"]: row for row in csv.DictReader((COMMITTED.parent / "training.csv").read_text().splitlines())}
    for ours in submissions:
        assert ours.sha256 == hashlib.sha256((SHIPPED / f"{ours.task}.safetensors").read_bytes()).hexdigest()
        cost = costs[ours.task]
        assert asdict(ours.training) == {"steps": int(cost["steps"]), "minutes": float(cost["minutes"])}
