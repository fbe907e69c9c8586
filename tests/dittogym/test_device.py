"""Steps and resets that stay on the device: where they would wait for a GPU, and how much they launch."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from device_operators import DeviceOperators
from tiny import ALL, TASKS, actions, assert_same_bits, begun, tiny

from dittogym import TorchEnv, copies, core

#: A reset of some elements copies to the host what the mask is, unless that lies there, and nothing else.
MASK = {"torch.cpu": 1, "torch.numpy": 1}


def on_a_gpu(env: TorchEnv) -> TorchEnv:
    """The environment with the check of actions that it has on a GPU, after steps that leave its constants there."""
    env._nonfinite_action = torch.zeros((), dtype=env.dtype)
    return env


@pytest.mark.parametrize("conditions", [None, ALL])
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_a_step_waits_for_nothing(task: str, soft: bool, conditions: Any) -> None:
    env = begun(on_a_gpu(tiny(task, 3, conditions=conditions)))
    action = actions(env, 1)[0].requires_grad_(soft)
    env.step(action, soft=soft)
    with DeviceOperators() as seen:
        env.step(action, soft=soft)
    assert not seen.waits


@pytest.mark.parametrize("conditions", [None, ALL])
@pytest.mark.parametrize("physics", [None, {"mu": [500.0, 600.0, 700.0], "gravity": (0.0, -5.0)}])
@pytest.mark.parametrize("task", ["run", "shapematch", "grow", "catch"])
def test_a_reset_waits_for_its_mask_alone(task: str, physics: dict[str, Any] | None, conditions: Any) -> None:
    env = on_a_gpu(tiny(task, 3, conditions=conditions))
    env.reset(seed=0, options={"physics": physics})
    host = np.array([True, False, True])
    env.step(actions(env, 1)[0])
    saved = env.save()
    for mask, waits in ((torch.from_numpy(host), MASK), (host, {})):
        env.reset(options={"reset_mask": mask})
        with DeviceOperators() as seen:
            env.reset(options={"reset_mask": mask})
        assert seen.waits == Counter(waits) + Counter(_local_scalar_dense=1)  # whether an action was not finite
        with DeviceOperators() as seen:
            env.load(saved, mask)
        assert seen.waits == waits


def test_an_action_that_is_not_finite_is_noticed_at_the_next_reset() -> None:
    env = begun(on_a_gpu(tiny("run", 3)))
    action = actions(env, 1)[0]
    action[1, 0, 2, 3] = math.nan
    _, reward, terminated, _, info = env.step(action)
    assert terminated.tolist() == [False, True, False] == (~info["finite"]).tolist()
    assert reward[1] == core.FAILURE_REWARD and torch.isfinite(reward).all()
    before = env.env_state
    with pytest.raises(ValueError, match="action must be finite"):
        env.reset(options={"reset_mask": terminated})
    assert env.env_state is before
    env.reset(options={"reset_mask": terminated})
    assert env.step(actions(env, 1)[0])[4]["finite"].all()


def test_large_actions_are_finite() -> None:
    env = begun(on_a_gpu(tiny("run", 2)))
    env.step(torch.full((2, *env.action_shape), torch.finfo(env.dtype).max, dtype=env.dtype))
    env.reset()


def test_packed_numbers_are_the_same() -> None:
    given = {
        "flag": torch.tensor([True, False, True]),
        "image": torch.arange(6, dtype=torch.uint8).view(3, 2),
        "number": torch.tensor([0.1, -0.0, math.nan], dtype=torch.float64),
        "nothing": torch.zeros(0, 2),
        "count": torch.tensor([2**40, -1, 0]),
        "column": torch.rand(3, 4)[:, 1],
    }
    found = copies.unpack(copies.pack(given).numpy(), given)
    assert_same_bits(found, given)
    assert all(array.flags.writeable and array.flags.aligned for array in found.values())
