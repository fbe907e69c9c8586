"""The options ``dt`` and ``substeps``."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny import TASKS, begun, tiny

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


@pytest.mark.parametrize("task", TASKS)
def test_unstable_substeps_are_refused(task: str) -> None:
    """With full muscles a task's own are stable, by a third in DIG and by more than twice elsewhere."""
    limit = tiny(task).model.solver.stable_dt(dittogym.make_spec(task).max_actuation)
    assert limit > (1.3 if task == "dig" else 2.5) * 1e-4
    assert tiny(task, dt=0.99 * limit).model.solver.dt == 0.99 * limit
    with pytest.raises(ValueError, match=rf"dt must be at most {limit} s"):
        tiny(task, dt=1.01 * limit)


def test_damping_takes_the_same_share_of_the_velocity_in_the_same_time() -> None:
    spec = replace(dittogym.make_spec("run"), gravity=(0.0, 0.0))
    assert spec.damping < 1.0
    for dt in (5e-5, 1e-4, 2e-4):
        env = begun(tiny(spec, dt=dt, substeps=None))
        env.state.v[..., 1] = 1.0  # away from the floor
        env.step(torch.zeros(1, *env.action_shape))
        assert float(env.state.v[..., 1].mean()) == pytest.approx(spec.damping**100, rel=1e-9)


def test_longer_substeps_end_near_the_same_place() -> None:
    ends = []
    for dt in (1e-4, 2e-4):
        env = begun(tiny("kick", dt=dt, substeps=None))
        start = env.state.x
        for _ in range(5):
            env.step(0.5 * torch.ones(1, *env.action_shape))
        ends.append(env.state.x)
    moved = (ends[0] - start).abs().max()
    assert 1e-8 < float((ends[1] - ends[0]).abs().max()) < 0.2 * float(moved)
