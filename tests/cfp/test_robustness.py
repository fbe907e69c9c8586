"""The evaluation of a policy: what it plays, that its rows are kept and repeatable, and what follows from them."""

import csv
from dataclasses import replace
from unittest import mock

import gymnasium
import pytest
import torch
from policy_files import save_actor

from cfp import robustness
from cfp.agent.actor import build_actor
from cfp.evaluate import open_policy
from cfp.presets import preset, sac_preset
from cfp.robustness import DISTURBANCES, effective, ratios
from dittogym import TASKS, Conditions, TorchEnv, make_spec


def test_disturbances_that_change_nothing_in_a_task_or_for_a_policy_are_left_out():
    every = list(DISTURBANCES)
    assert effective(make_spec("run"), True) == every
    assert effective(make_spec("shapematch"), True) == [name for name in every if "gravity" not in name]
    assert "observation dropout" not in effective(make_spec("run"), False)


# The command


@pytest.fixture
def made(monkeypatch):
    """The environments that are made, whose episodes last two steps."""
    envs, init, step = [], TorchEnv.__init__, TorchEnv.step

    def noted(self, *arguments, **options):
        envs.append(self)
        init(self, *arguments, **options)

    def shortened(self, action, **options):
        observation, reward, terminated, truncated, info = step(self, action, **options)
        return observation, reward, terminated, truncated | (self.env_state.steps >= 2), info

    monkeypatch.setattr(TorchEnv, "__init__", noted)
    monkeypatch.setattr(TorchEnv, "step", shortened)
    return envs


CONFIG = sac_preset("shapematch")


def save(folder, steps=0, config=CONFIG):
    folder.mkdir(parents=True, exist_ok=True)
    save_actor(folder / "policy.safetensors", build_actor(config.actor_spec(2)), config, 2, steps)


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(0)
    save(tmp_path / "mine")
    return tmp_path / "mine"


def command(folder, table, words="--episodes 2 --full 0 --disturbed 2"):
    return robustness.main([str(folder), "--rows", str(table), "--device", "cpu", *words.split()])


def rows_of(table):
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_case_has_its_starts_disturbance_and_particles(folder, made, tmp_path, capsys):
    assert command(folder, tmp_path / "rows.csv", "--episodes 1 --full 1 --disturbed 1") == 0
    rows = rows_of(tmp_path / "rows.csv")
    own = [row for row in rows if row["policy"] == "mine"]
    names = effective(make_spec("shapematch"), True)
    wanted = [("undisturbed", "lite"), *((name, "lite") for name in names)]
    assert [(row["case"], row["particles"]) for row in own] == [*wanted, ("undisturbed", "full"), ("own start", "full")]
    assert [row["policy"] for row in rows if row not in own] == ["zero", "random", "zero"]
    starts = {"shift": 0.01, "turn": 5.0, "velocity": 0.05}
    played = {id(row): env for row, env in zip(rows, made[-len(rows) :], strict=True)}
    for row in rows:
        env = played[id(row)]
        assert env.model.num_robot_particles == {"lite": 2000, "full": 16000}[row["particles"]]
        if row["case"] == "own start":
            assert env.conditions is None
        else:
            assert env.conditions == Conditions(**starts, **DISTURBANCES.get(row["case"], {}), grid=env.conditions.grid)
    # The policy enlarges what it decides, and is disturbed before that.
    sizes = {(played[id(row)].conditions.grid, played[id(row)].action_resolution) for row in own[:-1]}
    assert sizes == {(32, 64)}
    assert len({row["mean"] for row in rows}) > len(rows) / 2
    assert {len(row["mean"].partition(".")[2]) for row in rows} == {3}  # ratios of small rewards are made from them
    printed = capsys.readouterr().out
    assert "mine on shapematch" in printed and all(f"| {name} | lite |" in printed for name in names)


def test_rows_are_kept_until_the_policy_or_the_number_of_episodes_is_another(folder, made, tmp_path):
    table, short = tmp_path / "rows.csv", "--cases latency --episodes 2 --full 0 --disturbed 1"
    assert command(folder, table, short) == 0
    first, made[:] = table.read_text(), []
    assert [row["case"] for row in rows_of(table)] == ["undisturbed"] * 3 + ["latency"]

    def played():
        count, made[:] = len(made), []
        return count

    assert command(folder, table, short) == 0
    assert table.read_text() == first and played() == 0
    table.write_text(first, encoding="utf-8-sig")  # as a spreadsheet saves it
    assert command(folder, table, short) == 0 and played() == 0
    assert command(folder, table, short.replace("--episodes 2", "--episodes 3")) == 0
    assert played() == 3 and len(rows_of(table)) == 4
    save(folder, steps=1)
    assert command(folder, table, short.replace("--episodes 2", "--episodes 3")) == 0
    assert played() == 3 + 1  # the policy's two rows, and not those of zero and random actions
    save(folder, steps=2)
    assert command(folder, table, short.replace("latency", "noise")) == 0
    own = [row["case"] for row in rows_of(table) if row["policy"] == "mine"]
    assert own == ["undisturbed", "action noise"]  # nothing is left of the earlier file


def test_an_evaluation_that_was_stopped_goes_on_to_the_same_rows(folder, made, tmp_path, monkeypatch):
    whole, table = tmp_path / "whole.csv", tmp_path / "rows.csv"
    assert command(folder, whole) == 0
    play, left = robustness.Evaluation.play, iter(range(5))

    def stopping(evaluation):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return play(evaluation)

    with monkeypatch.context() as patch:
        patch.setattr(robustness.Evaluation, "play", stopping)
        assert command(folder, table) == 130
    assert rows_of(table) == rows_of(whole)[:5]
    assert command(folder, table) == 0 and table.read_text() == whole.read_text()


def test_action_noise_of_the_policy_is_an_option_and_has_rows_of_its_own(folder, made, tmp_path):
    table, few = tmp_path / "rows.csv", "--cases latency --episodes 1 --full 0 --disturbed 1 --noise "
    assert command(folder, table, few + "with") == 0 and command(folder, table, few + "without") == 0
    own = [(row["case"], row["noise"]) for row in rows_of(table) if row["policy"] == "mine"]
    assert own == [(case, noise) for noise in ("with", "without") for case in ("undisturbed", "latency")]


def test_policies_of_two_tasks_of_one_name_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    files = [tmp_path / f"{module}.safetensors" for module in ("first_slope", "second_slope")]
    config = sac_preset("run")
    with mock.patch.dict(TASKS), mock.patch.dict(gymnasium.registry):  # saving a policy imports its task, too
        for file in files:
            file.with_suffix(".py").write_text(
                "import dataclasses, dittogym\n"
                "def slope(): return dataclasses.replace(dittogym.make_spec('run'), name='slope')\n"
                "dittogym.register('slope', slope)"
            )
            save_actor(file, build_actor(config.actor_spec(1)), replace(config, task=f"{file.stem}:slope"), 1, 0)
        assert robustness.main([*map(str, files), "--device", "cpu"]) == 2
    assert "module 'second_slope' has registered another 'slope' since" in capsys.readouterr().err


def test_policy_of_a_run_with_more_robots_than_the_preset_has_steps_for(tmp_path):
    config = preset("run")
    there = replace(config, num_envs=1024)
    save_actor(tmp_path / "a.safetensors", build_actor(config.actor_spec(1)), there, 1, 0)
    config, policies = open_policy(str(tmp_path / "a.safetensors"), "cpu", None)
    assert list(policies) == ["a"] and config.num_envs != there.num_envs


# Ratios


def row(policy, case, mean, particles="lite", noise="with"):
    names = dict.fromkeys(robustness.COLUMNS, "")
    about = {"protocol": "v2", "task": "run", "policy": policy, "case": case, "particles": particles, "noise": noise}
    return names | about | {"mean": str(mean), "sha256": "" if policy == "zero" else "abc"}


def test_a_ratio_counts_from_zero_actions_with_the_same_particles():
    noisy = row("mine", "action noise", 60.0)
    full, own = row("mine", "undisturbed", 90.0, "full"), row("mine", "own start", 95.0, "full")
    rows = [
        *(row("zero", "undisturbed", mean, count, "without") for mean, count in ((20.0, "lite"), (10.0, "full"))),
        *(row("mine", "undisturbed", mean, noise=noise) for mean, noise in ((1000.0, "without"), (100.0, "with"))),
        row("other", "undisturbed", 7.0),
        *(noisy, full, own),
    ]
    assert ratios(noisy, rows) == pytest.approx((0.5, 0.6))
    assert ratios(full, rows) == pytest.approx((1.0, 0.9))
    assert ratios(own, rows) == (None, None)


def test_there_is_no_ratio_to_a_policy_that_is_no_better_than_zero_actions():
    noisy, base = row("mine", "action noise", 5.0), row("mine", "undisturbed", 10.0)
    assert ratios(noisy, [noisy, base, row("zero", "undisturbed", 20.0, noise="without")]) == (None, 0.5)
    assert ratios(noisy, [noisy, row("mine", "undisturbed", -10.0)]) == (None, None)
    assert ratios(noisy, [noisy]) == (None, None)
