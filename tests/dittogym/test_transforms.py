"""The pure step under the transforms of ``torch.func``, which an environment, as it keeps what it is given, refuses."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tiny import ALL, TASKS, actions, begun, set_particles, tiny
from torch import Tensor

from dittogym import core
from torchmpm import tree


def reward_of(task: str) -> tuple[Callable[[Tensor], Tensor], Tensor]:
    """Smooth reward of the first step of an episode as a function of its actions, and such actions (3, B, 2, R, R)."""
    env = begun(tiny(task, 2, backend="eager", substeps=2))
    start = env.state.x.clone()

    def reward(action: Tensor) -> Tensor:
        state, _ = core.reset(env.model, start)
        return core.step(env.model, state, action, soft=True).reward.sum()

    return reward, actions(env, 3)


@pytest.mark.parametrize("task", TASKS)
def test_transforms_of_the_pure_step_give_what_autograd_gives(task: str) -> None:
    reward, drive = reward_of(task)
    leaf = drive.clone().requires_grad_()
    values = torch.stack([reward(action) for action in leaf])
    (expected,) = torch.autograd.grad(values.sum(), leaf)
    assert expected.abs().max() > 0
    got, mapped = torch.func.grad(reward)(drive[0]), torch.func.vmap(torch.func.grad(reward))(drive)
    for ours, theirs in ((got, expected[0]), (mapped, expected), (torch.func.vmap(reward)(drive), values.detach())):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-12 * theirs.abs().max().item())


@pytest.mark.parametrize("task", TASKS)
def test_vmap_maps_over_states(task: str) -> None:
    """In tasks with and without an object."""
    env = begun(tiny(task, 2, backend="eager", substeps=2))
    alone = [tree.map(lambda tensor, i=i: tensor[i : i + 1], env.env_state) for i in range(2)]
    drive = actions(env, 1)[0][:, None]
    states = tree.map(lambda *tensors: torch.stack(tensors), *alone)
    found = torch.func.vmap(lambda state, action: core.step(env.model, state, action).reward)(states, drive)
    expected = [core.step(env.model, state, action).reward for state, action in zip(alone, drive, strict=True)]
    torch.testing.assert_close(found, torch.stack(expected), rtol=1e-9, atol=1e-12)


def test_an_environment_refuses_transforms_and_is_as_it_was() -> None:
    env, drive = tiny("run", 2), torch.zeros(2, 2, 8, 8)
    env.reset(seed=0)
    moment, positions = env.save(), env.state.x.clone()
    before = env.step(drive)[1]
    env.load(moment)
    with pytest.raises(RuntimeError, match=r"TorchEnv\.step"):
        torch.func.grad(lambda action: env.step(action)[1].sum())(drive)
    with pytest.raises(RuntimeError, match=r"TorchEnv\.reset"):
        torch.func.vmap(lambda x: env.reset(options={"positions": x}))(positions[None])
    with pytest.raises(RuntimeError, match=r"TorchEnv\.env_state"):
        torch.func.grad(lambda x: set_particles(env, x=x) or x.sum())(positions)
    assert torch.equal(env.step(drive)[1], before)


@pytest.mark.parametrize("conditions", [None, ALL])
@pytest.mark.parametrize("backend", ["eager", "native"])
@pytest.mark.parametrize("task", TASKS)
def test_gradients_from_a_state_that_was_made_in_inference_mode(task: str, backend: str, conditions: Any) -> None:
    """And with constants that were first made there, of actions of a size that no other test has."""
    results = []
    for inference in (True, False):
        env = tiny(task, 2, backend=backend, substeps=2, conditions=conditions, resolution=7)
        with torch.inference_mode(inference), torch.set_grad_enabled(False):
            env.reset(seed=0)
            env.step(actions(env, 1)[0])
        drive = actions(env, 1, seed=1)[0].requires_grad_()
        env.step(drive, soft=True)[1].sum().backward()
        results.append(drive.grad)
    assert results[0].abs().max() > 0 and torch.equal(*results)


def test_a_graph_is_neither_pickled_nor_copied_without_a_word() -> None:
    env = begun(tiny("run", 1))
    env.step(torch.zeros(1, 2, 8, 8, requires_grad=True))
    for copied in (copy.deepcopy, pickle.dumps):
        for thing, name in ((env, "TorchEnv"), (env.save(), "TorchEnv"), (env.state, "ParticleState")):
            with pytest.raises(RuntimeError, match=rf"{name} cannot be pickled .* call its detach\(\) first"):
                copied(thing)
    env.detach()
    assert not any(leaf.requires_grad for leaf in tree.leaves(pickle.loads(pickle.dumps(env)).env_state))


def test_the_reward_has_second_derivatives_at_rest() -> None:
    env = begun(tiny("run", backend="eager", particles=50, substeps=2))
    action = torch.zeros(1, *env.action_shape, dtype=env.dtype, requires_grad=True)
    (first,) = torch.autograd.grad(env.step(action)[1].sum(), action, create_graph=True)
    assert torch.autograd.grad(first.sum(), action)[0].isfinite().all()
