"""The planner as an algorithm."""

import json
from dataclasses import replace

import pytest
import torch
from updates import EachUpdate

from baselines import MPC, GradientPlannerConfig, OpenLoop, train
from baselines.planning.mpc import MPCConfig
from cfp.envs.make import make_torch_env
from cfp.sections import EnvironmentConfig
from cfp.tables import read_table

OPTIONS = "--algo mpc --task shapematch --particles 60 --substeps 1 --grid 4 --horizon 2 --commit 2 --iterations 1"
COMMON = [*OPTIONS.split(), "--no-video", "--device", "cpu"]
ENVIRONMENT = EnvironmentConfig(num_envs=1, particles=100, substeps=2)
CONFIG = MPCConfig(
    task="kick",
    device="cpu",
    grid=4,
    environment=ENVIRONMENT,
    planner=GradientPlannerConfig(horizon=3, commit=2, iterations=1),
)


def test_record_repeats_the_episode(tmp_path) -> None:
    assert train.main([*COMMON, "--log-every", "1", "--out", str(tmp_path)]) == 0
    planned = [float(row["train/return"]) for row in read_table(tmp_path / "progress.csv")]
    evaluated = [float(row["mean"]) for row in read_table(tmp_path / "evaluations.csv")]
    assert len(planned) == 30 and evaluated[-1] == pytest.approx(planned[-1], abs=1e-3)
    rows = {row["policy"].strip(): row for row in json.loads((tmp_path / "results.json").read_text())}
    assert rows["own layout"]["mean"] == pytest.approx(evaluated[-1], abs=1e-3)
    record = OpenLoop.load(tmp_path)
    assert len(record.actions) == 30  # whatever the evaluations of its parts were
    assert record.resolution == 4 and record.description["layout"] == 0


def test_record_repeats_the_episode_exactly_in_double_precision() -> None:
    config = replace(CONFIG, environment=replace(ENVIRONMENT, dtype="float64"))
    model = MPC(config)
    model.learn(4)
    env, memory = make_torch_env(config, 4, 1), None
    seen, _ = env.reset(seed=0)
    for _ in range(4):
        action, memory = model.policy.predict(seen.numpy(), memory)
        env.step(torch.as_tensor(action))
    assert torch.equal(env.state.x, model.env.state.x)


def test_options_that_only_the_model_can_refuse_leave_the_folder_free(tmp_path, capsys) -> None:
    arguments = [*COMMON, "--out", str(tmp_path)]
    assert train.main([*arguments, "--train-particles", "61"]) == 2
    assert "train_particles of a body must be at most 60, got 61" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())
    assert train.main([*arguments, "--train-particles", "60"]) == 0


def test_learning_stops_with_the_episode() -> None:
    mpc = MPC(CONFIG)
    seen = []

    def behind_the_limit(scalars) -> None:
        seen.append(scalars)
        if len(seen) == 3:
            mpc.env.state.x[..., 0] -= 1.0

    mpc.learn(10, EachUpdate(behind_the_limit))
    assert mpc.finished and mpc.num_timesteps == 4 == len(mpc.actions) == len(seen)
    assert seen[-1]["train/return"] == mpc.total_reward and seen[-1]["train/plans"] == 4
    mpc.learn(5, EachUpdate(behind_the_limit))
    assert len(seen) == 4


def test_layout_of_the_reference_is_kept() -> None:
    for environment, layout in (
        (ENVIRONMENT, "image"),
        (replace(ENVIRONMENT, action_layout="grid"), "grid"),
        (replace(ENVIRONMENT, parity="reference"), "grid"),
        (replace(ENVIRONMENT, parity="reference", action_layout="image"), "image"),
    ):
        assert MPC(replace(CONFIG, environment=environment)).planner.env.action_layout == layout
