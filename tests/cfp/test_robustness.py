"""The robustness report: what each disturbance does, that it is repeatable, and the command line."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from fakes import FakeEnv
from policy_files import save_actor
from scipy import stats

from cfp import robustness
from cfp.agent.actor import build_actor
from cfp.config import to_json
from cfp.envs.disturbances import Case, Disturbed, changes_something, disturbed_env, make_cases
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError
from cfp.evaluate import open_policy, open_run
from cfp.evaluation.returns import Result
from cfp.files import write_json
from cfp.presets import preset, sac_preset
from dittogym import make_spec
from dittogym.action import bicubic
from dittogym.tasks import TASKS


def disturbed(**disturbance):
    return Disturbed(monitored(FakeEnv(num_envs=2, horizon=3)), Case("case", **disturbance), seed=0)


def play(env, actions):
    """What reached the physics for actions (T, B, 2, R, R), and the first observation."""
    inner = env.unwrapped.torch_env
    inner.actions.clear()
    first = env.reset()
    for action in actions:
        env.step(action)
    return np.stack([action.numpy() for action in inner.actions]), first


def test_dropout_zeroes_its_share_of_the_entries_anew_in_every_step():
    actions = np.full((4, 2, 2, 8, 8), 0.5, np.float32)
    arrived, _ = play(disturbed(action_dropout=0.2), actions)
    assert set(np.unique(arrived)) == {0.0, 0.5}
    assert (arrived == 0).mean() == pytest.approx(0.2, abs=0.04)
    assert not np.array_equal(arrived[0], arrived[1])
    env = disturbed(observation_dropout=0.2)
    _, seen = play(env, actions)
    whole = play(disturbed(), actions)[1]
    assert seen.dtype == np.uint8 and (whole[:, 0] > 0).all()
    assert (seen[:, 0] == 0).mean() == pytest.approx(0.2, abs=0.02)
    assert (seen[:, 0] == whole[:, 0]).mean() == pytest.approx(0.8, abs=0.02)


def test_noise_has_its_deviation_and_every_reset_repeats_it():
    env = disturbed(action_noise=0.3)
    actions = np.zeros((4, 2, 2, 8, 8), np.float32)
    first, _ = play(env, actions)
    assert first.std() == pytest.approx(0.3, abs=0.02) and first.mean() == pytest.approx(0, abs=0.03)
    np.testing.assert_array_equal(play(env, actions)[0], first)


def test_blended_actions_are_disturbed_on_the_grid_that_they_were_decided_on():
    env = Disturbed(monitored(FakeEnv(num_envs=2, resolution=16, horizon=3)), Case("case", action_dropout=0.2), 0, 4)
    arrived, _ = play(env, np.full((4, 2, 2, 16, 16), 0.5, np.float32))
    cells = arrived.reshape(4, 2, 2, 4, 4, 4, 4).transpose(0, 1, 2, 3, 5, 4, 6).reshape(4, 2, 2, 4, 4, 16)
    assert (cells == cells[..., :1]).all() and (cells == 0).mean() == pytest.approx(0.2, abs=0.07)
    shaken = Disturbed(monitored(FakeEnv(num_envs=2, resolution=16, horizon=3)), Case("case", action_noise=0.3), 0, 4)
    plain = Disturbed(monitored(FakeEnv(num_envs=2, resolution=4, horizon=3)), Case("case", action_noise=0.3), 0)
    (fine, _), (coarse, _) = (play(e, np.zeros((4, 2, 2, r, r), np.float32)) for e, r in ((shaken, 16), (plain, 4)))
    np.testing.assert_allclose(fine, bicubic(torch.from_numpy(coarse), 16).numpy(), atol=1e-6)


def test_late_actions_stay_in_their_episode():
    actions = np.arange(1, 6, dtype=np.float32)[:, None, None, None, None] * np.ones((1, 2, 2, 8, 8), np.float32)
    arrived, _ = play(disturbed(latency=2), actions)  # an episode lasts three steps
    assert arrived[:, 0, 0, 0, 0].tolist() == [0, 0, 1, 0, 0]


@pytest.mark.parametrize("task", TASKS)
def test_constants_reach_the_physics_of_every_task(task):
    spec, config = make_spec(task), sac_preset(task)
    config = replace(config, particles=100, substeps=1)
    env = disturbed_env(config, 8, Case("soft", physics={"mu": 0.5, "yield_stress": 0.5, "gravity": 2.0}), None, 3, 2)
    env.seed(5)
    env.reset()
    physics = env.unwrapped.torch_env.env_state.physics
    assert physics["mu"].tolist() == [0.5 * spec.mu] * 2
    assert physics["yield_stress"].tolist() == [0.5 * spec.yield_stress] * 2
    assert physics["gravity"].tolist() == [[2 * value for value in spec.gravity]] * 2
    env = disturbed_env(config, 8, Case("ice", friction=0.25), None, 3, 2)
    floors = [item for item in env.unwrapped.torch_env.spec.obstacles if item.name == "floor"]
    assert [rule.friction for item in floors for rule in item.velocity_rules] == [0.25]
    others = [item for item in spec.obstacles if item.name != "floor"]
    assert [item for item in env.unwrapped.torch_env.spec.obstacles if item.name != "floor"] == others


def test_cases_that_change_nothing_in_a_task_are_left_out():
    cases = make_cases()
    names = {task: [case.name for case in cases if changes_something(case, make_spec(task))] for task in TASKS}
    assert "gravity x 0.8" in names["run"] and "gravity x 0.8" not in names["shapematch"]
    assert "floor friction sticky" in names["dig"] and "floor friction 0" not in names["dig"]
    assert "floor friction sticky" not in names["run"] and "floor friction 0" in names["run"]


def test_interval_is_student_s():
    returns = np.random.default_rng(0).normal(size=5)
    low, high = stats.t.interval(0.95, 4, returns.mean(), stats.sem(returns))
    assert Result("", 8, tuple(returns)).interval == pytest.approx((high - low) / 2, rel=1e-5)
    assert Result("", 8, (1.0,)).interval is None


@pytest.fixture
def folder(tmp_path):
    config = sac_preset("shapematch")
    config = replace(config, particles=1000, substeps=2)
    write_json(tmp_path / "config.json", to_json(config))
    torch.manual_seed(0)  # of a policy with a positive return, which ratios refer to
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(2)), config, 2, 0)
    return tmp_path


def test_command_writes_table_and_plot(folder, capsys):
    arguments = [str(folder), "--episodes", "1", "--device", "cpu"]
    assert robustness.main(arguments) == 0
    printed = capsys.readouterr().out
    rows = json.loads((folder / "robustness.json").read_text())
    assert [row["case"] for row in rows] == [
        case.name for case in make_cases() if changes_something(case, make_spec("shapematch"))
    ]
    assert rows[0]["ratio"] == 1
    for row in rows:
        assert row["mean"] == pytest.approx(np.mean(row["returns"]), abs=1e-2)
        assert row["ratio"] == pytest.approx(row["mean"] / rows[0]["mean"], abs=1e-4)
    assert len({tuple(row["returns"]) for row in rows}) > len(rows) / 2
    with open(folder / "robustness.csv", newline="") as file:
        assert [float(row["mean"]) for row in csv.DictReader(file)] == [row["mean"] for row in rows]
    table = (folder / "robustness.md").read_text()
    assert table in printed and all(f"| {row['case']} |" in table for row in rows)
    assert (folder / "robustness.png").read_bytes().startswith(b"\x89PNG")
    config, policies = open_run(folder, "cpu")
    again = robustness.report(config, policies["stage 2"], make_cases()[:3], 1)  # alone, with the same seed
    assert robustness.to_rows(again) == rows[:3]


def test_single_policy_with_other_particles_needs_a_folder_to_write_into(folder, tmp_path, capsys):
    single = ["--policy", str(folder / "policy.safetensors"), *"--episodes 1 --device cpu --particles 500".split()]
    assert robustness.main([*single, "--cases", "noise"]) == 2
    assert "out must be given with a single policy" in capsys.readouterr().err
    amounts = "--cases noise friction --action-noise 0.3 --friction 0.7".split()
    assert robustness.main([*single, *amounts, "--out", str(tmp_path / "new")]) == 0
    table = (tmp_path / "new" / "robustness.md").read_text()
    assert "particles 500" in table and table.count("\n| ") == 5 and "action noise 0.3" in table


def test_policy_of_a_run_with_more_robots_than_the_preset_has_steps_for(tmp_path):
    config = preset("run")
    there = replace(config, num_envs=1024)
    save_actor(tmp_path / "a.safetensors", build_actor(config.actor_spec(1)), there, 1, 0)
    config, policies = open_policy(str(tmp_path / "a.safetensors"), "cpu", None)
    assert list(policies) == ["a"] and config.num_envs != there.num_envs


def test_cases_are_chosen_by_words(folder):
    run, policy, cases = make_spec("run"), open_run(folder, "cpu")[1]["stage 2"], make_cases()
    chosen = robustness.choose(cases, ["dropout", "mu x 0.8", "friction"], run, policy)
    names = ["unperturbed", "action dropout 20%", "observation dropout 20%", "mu x 0.8"]
    assert [case.name for case in chosen] == names + [f"floor friction {value}" for value in (0, 0.5, "sticky")]
    assert robustness.choose(cases, [], run, policy) == cases
    ground = [replace(item, name="ground") if item.name == "floor" else item for item in run.obstacles]
    with pytest.raises(ConfigError, match="got 'friction'"):
        robustness.choose(cases, ["friction"], replace(run, obstacles=tuple(ground)), policy)
    with pytest.raises(ConfigError, match="got 'sticky'"):
        robustness.choose(cases, ["sticky"], run, policy)
    policy.uses_image = False
    with pytest.raises(ConfigError, match="got 'observation'"):
        robustness.choose(cases, ["observation"], run, policy)


def test_ratios_need_a_positive_return():
    rows = robustness.to_rows([Result("unperturbed", 8, (-2.0, -1.0)), Result("noise", 8, (-4.0, -3.0))])
    assert [row["ratio"] for row in rows] == [None, None]
    config = sac_preset("dig")
    assert "not positive" in robustness.make_table("run", config, rows).description
