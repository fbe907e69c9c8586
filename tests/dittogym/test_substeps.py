"""The options ``dt`` and ``substeps``."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from tiny import TASKS, tiny

import dittogym


def test_a_control_step_keeps_its_duration_unless_both_are_given() -> None:
    for options, expected in (
        ({}, (1e-4, 100)),
        ({"dt": 2e-4}, (2e-4, 50)),
        ({"dt": 1e-4 / 3}, (1e-4 / 3, 300)),
        ({"substeps": 20}, (1e-4, 20)),
        ({"dt": 5e-5, "substeps": 20}, (5e-5, 20)),
    ):
        model = dittogym.TorchEnv("run", particles=100, **options).model
        assert (model.solver.dt, model.substeps) == expected


@pytest.mark.parametrize(
    ("dt", "message"),
    [
        (3e-4, r"dt must divide the control step of 0\.01 s if substeps is not given, got 0\.0003"),
        (0.02, "dt must divide"),
        (0.0, "dt must be positive, got 0.0"),
        (1e-320, "dt must divide"),
        (1e-300, "dt must divide .* got 1e-300; there may be at most 1000000 substeps"),
        ("short", "dt must be a number, got 'short'"),
    ],
)
def test_impossible_substeps_are_refused(dt: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dittogym.TorchEnv("run", particles=100, dt=dt)
    with pytest.raises(ValueError, match="substeps must be at most 1000000, got 1000001"):
        dittogym.TorchEnv("run", particles=100, substeps=1_000_001)


@pytest.mark.parametrize("task", TASKS)
def test_unstable_substeps_are_refused(task: str) -> None:
    limit = tiny(task).model.solver.stable_dt(dittogym.make_spec(task).max_actuation)
    assert tiny(task, dt=0.99 * limit).model.solver.dt == 0.99 * limit
    with pytest.raises(ValueError, match=rf"dt must be at most {limit} s .*, got {1.01 * limit}"):
        tiny(task, dt=1.01 * limit)


def test_damping_takes_the_same_share_of_the_velocity_in_the_same_time() -> None:
    spec = replace(dittogym.make_spec("run"), gravity=(0.0, 0.0))
    assert spec.damping < 1.0
    for dt in (5e-5, 1e-4, 2e-4):
        env = tiny(spec, dt=dt, substeps=None)
        env.reset(seed=0)
        env.state.v[..., 1] = 1.0  # away from the floor
        env.step(torch.zeros(1, *env.action_shape))
        assert float(env.state.v[..., 1].mean()) == pytest.approx(spec.damping**100, rel=1e-9)


def test_longer_substeps_end_near_the_same_place() -> None:
    ends = []
    for dt in (1e-4, 2e-4):
        env = tiny("kick", dt=dt, substeps=None)
        env.reset(seed=0)
        start = env.state.x
        for _ in range(5):
            env.step(0.5 * torch.ones(1, *env.action_shape))
        ends.append(env.state.x)
    moved = (ends[0] - start).abs().max()
    assert 1e-8 < float((ends[1] - ends[0]).abs().max()) < 0.2 * float(moved)


def test_every_interface_takes_the_option() -> None:
    options = {"particles": 100, "dt": 2e-4, "dtype": "float64"}
    name, action = "dittogym/run-coarse-v0", np.full((2, 8, 8), 0.5, np.float32)
    single = gymnasium.make(name, **options)
    batch = gymnasium.make_vec(name, num_envs=2, vectorization_mode="vector_entry_point", **options)
    env = dittogym.TorchEnv("run", 2, **options)
    for each in (single, batch, env):
        each.reset(seed=3)
    single.step(action)
    batch.step(np.stack([action] * 2))
    env.step(torch.as_tensor(np.stack([action] * 2)))
    assert torch.equal(batch.unwrapped.state.x, env.state.x)
    assert torch.equal(single.unwrapped.state.x[0], env.state.x[0])
