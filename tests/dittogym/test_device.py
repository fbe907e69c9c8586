"""Steps and resets that stay on the device: where they would wait for a GPU, and how much they launch."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from device_operators import DeviceOperators
from stable_baselines3.common.vec_env import VecEnv
from tiny import ALL, SMALL, TASKS, actions, assert_same_bits, begun, make_vec, tiny

from cfp.envs.vec_env import TorchVecEnv
from dittogym import TorchEnv, copies, core

#: A reset of some elements copies to the host what the mask is, unless that lies there, and nothing else.
MASK = {"torch.cpu": 1, "torch.numpy": 1}


def on_a_gpu(env: TorchEnv) -> TorchEnv:
    """The environment with the check of actions that it has on a GPU, after steps that leave its constants there."""
    env._nonfinite_action = torch.zeros((), dtype=env.dtype)
    return env


@pytest.mark.parametrize(
    "function",
    [
        lambda x: float(x.sum()),
        lambda x: bool((x > 0).any()),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: torch.equal(x, x),
        lambda x: x.unique(),
        lambda x: x.masked_select(x > 0),
        lambda x: x.cpu(),
        lambda x: x.tolist(),
        lambda x: x.new_tensor([1.0]),
        lambda x: torch.as_tensor(np.ones(2), device=x.device),
        lambda x: torch.tensor([1.0], device=x.device),
        lambda x: x.repeat_interleave(torch.ones_like(x).long()),
        lambda x: x.clone().index_put_((x > 0,), x[0]),
    ],
)
def test_what_would_wait_is_noticed(function: Callable[[torch.Tensor], object]) -> None:
    with DeviceOperators() as seen:
        function(torch.arange(4.0))
    assert seen.waits


def test_what_would_not_wait_is_only_counted() -> None:
    x, index = torch.arange(4.0), torch.tensor([0, 2])
    with DeviceOperators() as seen:
        torch.where(x > 0, x[index].sum(), 1.0)[:2].view(1, 2)
        torch.zeros(3, device=x.device)
        torch.tensor([1.0], device="cpu")
    assert not seen.waits and sum(seen.launches.values()) == 6


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


def test_interfaces_of_arrays_wait_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the numbers of a step, apart from images, which are copied on their own."""
    copied: list[tuple[str, ...]] = []
    plain = copies.to_host

    def to_host(tensors: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
        found = plain(tensors)
        if tensors:
            copied.append(tuple(tensors))
            assert_same_bits(copies.unpack(copies.pack(tensors).numpy(), tensors), found)
        return found

    monkeypatch.setattr("dittogym.env.to_host", to_host)
    single, batch = gymnasium.make("dittogym/run-coarse-v0", **SMALL), make_vec("run", 2)
    vec: VecEnv = TorchVecEnv(tiny("kick", 2), max_episode_steps=2, stagger=True)
    single.reset(seed=0), batch.reset(seed=0), vec.reset()
    for env in (single, batch):
        copied.clear()
        env.step(np.zeros(env.action_space.shape, np.float32))
        assert len(copied) == 2 and copied[1] == ("",)  # numbers, then images
    copied.clear()
    vec.step(np.zeros((2, *vec.action_space.shape), np.float32))  # the first episode ends after a step
    assert len(copied) == 3 and copied[1] == copied[2] == ("",)


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
