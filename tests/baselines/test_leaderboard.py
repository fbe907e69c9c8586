"""The leaderboard: a protocol that is fixed, files of results that are checked, and their ranking."""

import csv
import hashlib
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from policy_files import save_actor

import dittogym
from baselines import leaderboard
from baselines.leaderboard import COUNTS, ENVIRONMENT, SEEDS, TASKS, main, rankings, read_results, scores
from cfp.agent.actor import build_actor
from cfp.config import EVALUATION_SEED, LARGEST_SEED
from cfp.files import write_json
from cfp.policy import SHIPPED, shipped
from cfp.presets import preset

COMMITTED = Path(__file__).resolve().parents[2] / "docs" / "leaderboard"
RETURNS, SUCCESSES = [float(value) for value in range(100, 108)], [True, True, *[False] * 6]
VALID = {
    "protocol": "v1",
    "task": "run",
    "policy": "mine",
    "sha256": "0a" * 32,
    "sees": "image",
    "training": {"steps": 1000, "minutes": 2.5},
    "library": "0.1.0",
    "returns": RETURNS,
    "successes": SUCCESSES,
    "scores": scores(RETURNS, SUCCESSES),
}


@pytest.fixture
def tiny(monkeypatch):
    """The protocol with a hundred particles, one substep in a step, and two layouts."""
    environment = replace(ENVIRONMENT, particles=100, substeps=1)
    for name, value in {"ENVIRONMENT": environment, "SEEDS": SEEDS[:2], "COUNTS": (100, 90)}.items():
        monkeypatch.setattr(leaderboard, name, value)
    return environment


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
    expected = {"num_envs": 1, "particles": "lite", "substeps": 100, "dt": 1e-4, "dtype": "float32", "resample": False}
    expected |= {"action_layout": "image", "target": None, "variant": None}
    assert {name: asdict(ENVIRONMENT)[name] for name in expected} == expected
    assert TASKS == ("shapematch", "run", "grow", "kick", "dig", "obstacle", "catch", "slot")
    assert SEEDS == range(3_000_000_000, 3_000_000_008)
    assert list(COUNTS) == [2000, 1960, 1920, 1880, 1840, 1800, 1760, 1720]
    assert SEEDS[0] > LARGEST_SEED + 3 * EVALUATION_SEED  # no run comes to its layouts


def test_policies_are_evaluated_and_ranked(tiny, tmp_path, capsys):
    config = replace(preset("shapematch", "quick"), **vars(tiny) | {"action_layout": "grid"})
    save_actor(tmp_path / "my policy.safetensors", build_actor(config.actor_spec(1)), config, 1, 1234)
    policies = [str(tmp_path / "my policy.safetensors"), "zero"]
    assert main([*policies, "--tasks", "shapematch", "--out", str(tmp_path / "out")]) == 0
    files = [tmp_path / "out" / f"shapematch-{name}.json" for name in ("my-policy", "zero")]
    mine, zero = map(read_results, files)
    assert mine["sha256"] == hashlib.sha256((tmp_path / "my policy.safetensors").read_bytes()).hexdigest()
    assert mine["sees"] == "image" and mine["training"] == {"steps": 1234, "minutes": None}
    assert (zero["sha256"], zero["sees"]) == (None, "nothing")
    assert zero["returns"] == pytest.approx([rest("shapematch", seed, 100) for seed in SEEDS[:2]])
    capsys.readouterr()
    # Results that are given twice, or replaced by new ones, count once.
    again = [*map(str, [*files, *files]), "zero", "--tasks", "shapematch"]
    assert main([*again, "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines[0] == "## shapematch"
    assert [line.split(" | ")[:3] for line in lines[6:]] == [
        ["| 1", "my-policy", "image"],
        ["| reference", "zero", "nothing"],
    ]


@pytest.mark.slow
def test_tasks_without_random_positions_vary_the_particles(tiny, tmp_path):
    assert main(["zero", "--tasks", "obstacle", "--out", str(tmp_path)]) == 0
    returns = read_results(tmp_path / "obstacle-zero.json")["returns"]
    assert returns == pytest.approx([rest("obstacle", 0, count) for count in (100, 90)], abs=1e-2)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"protocol": "v0"}, "protocol"),
        ({"task": "swim"}, "task"),
        ({"sees": "everything"}, "sees"),
        ({"sha256": 5}, "sha256"),
        ({"returns": RETURNS[:7]}, "returns"),
        ({"returns": [*RETURNS[:7], "1"]}, "returns"),
        ({"returns": [*RETURNS[:7], 187.0]}, "scores.mean"),
        ({"successes": [True] * 8}, "scores.success"),
        ({"scores": {}}, "scores.mean"),
        ({"scores": {"mean": float("nan")}}, "scores.mean"),
        ({"scores": {"mean": "103.5"}}, "scores.mean"),
        ({"training": {"steps": "many"}}, "training.steps"),
    ],
)
def test_wrong_results_are_named(tmp_path, capsys, changes, named):
    write_json(tmp_path / "a.json", VALID)
    assert read_results(tmp_path / "a.json") == VALID
    assert VALID["scores"] == {"mean": 103.5, "interval": pytest.approx(2.048, abs=1e-3), "success": 0.25}
    write_json(tmp_path / "a.json", VALID | changes)
    assert main([str(tmp_path / "a.json"), "--out", str(tmp_path)]) == 2
    assert f"a.json: {named} must " in capsys.readouterr().err


def test_ranks_are_by_mean_return_within_what_is_observed():
    def scored(policy, mean, **changes):
        returns = [value - 103.5 + mean for value in RETURNS]
        return VALID | {"policy": policy, "returns": returns, "scores": scores(returns, SUCCESSES)} | changes

    run, kick = rankings(
        [
            scored("good", 5.0),
            scored("best", 9.0),
            scored("as good", 5.0),
            scored("planner", 99.0, sees="simulator"),
            scored("bad", -7.0),
            scored("zero", 7.0, sees="nothing", sha256=None),
            scored("open loop", 1.0, sees="nothing"),
            scored("zero", 1.0, sees="nothing", sha256=None, task="kick"),
        ]
    )
    ranks = [(row["rank"], row["policy"]) for row in run.rows]
    ranked = [(1, "best"), (2, "good"), (2, "as good"), (4, "bad"), (1, "planner"), (1, "open loop")]
    assert ranks == [*ranked, ("reference", "zero")]
    assert (run.title, kick.title) == ("run", "kick") and [row["rank"] for row in kick.rows] == ["reference"]


def test_committed_results_are_those_of_the_package():
    results = [read_results(path) for path in sorted(COMMITTED.glob("*.json"))]
    costs = {row["policy"]: row for row in csv.DictReader((COMMITTED.parent / "training.csv").read_text().splitlines())}
    pretrained = [row for row in results if row["policy"] == "pretrained"]
    assert {row["task"] for row in pretrained} <= set(shipped())
    for row in pretrained:
        assert row["sha256"] == hashlib.sha256((SHIPPED / f"{row['task']}.safetensors").read_bytes()).hexdigest()
        cost = costs[row["task"]]
        assert row["training"] == {"steps": int(cost["steps"]), "minutes": float(cost["minutes"])}
