"""Rollouts as functions of the actions, against the environment."""

import pytest
import torch

from baselines.rollout import repeat, rewards, to_dtype, true_reward
from dittogym import TorchEnv


def small(task: str, num_envs: int = 1) -> TorchEnv:
    env = TorchEnv(task, num_envs, particles=150, substeps=10, dtype="float64")
    env.reset(seed=0)
    return env


def actions(env: TorchEnv, steps: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(steps, env.num_envs, *env.action_shape, generator=generator, dtype=env.dtype) - 1


@pytest.mark.parametrize("task", ["catch", "run", "shapematch"])
def test_rewards_are_those_of_the_environment(task: str) -> None:
    env = small(task, 2)
    start, drive = env.env_state, actions(env, 3)
    state, earned, over = rewards(env.model, start, drive)
    wanted = torch.stack([env.step(action)[1] for action in drive])
    assert torch.equal(earned, wanted) and not over.any()
    assert torch.equal(state.particles.x, env.state.x)
    for name, value in env.env_state.memory.items():
        assert torch.equal(state.memory[name], value)


def test_checkpoints_do_not_change_the_gradient() -> None:
    env = small("kick")
    gradients = []
    for checkpointed in (True, False):
        drive = actions(env, 3).requires_grad_()
        _, earned, _ = rewards(env.model, env.env_state, drive, checkpointed=checkpointed)
        gradients.append(torch.autograd.grad(earned.sum(), drive)[0])
    assert torch.equal(*gradients) and gradients[0].abs().amax((1, 2, 3, 4)).min() > 0


def test_nothing_is_earned_after_the_end() -> None:
    env = small("run", 2)

    def ends_at_once_for_the_second(model, state, field):
        state, earned, _ = true_reward(model, state, field)
        return state, earned, torch.tensor([False, True]) & (state.steps == 2)

    _, earned, over = rewards(env.model, env.env_state, actions(env, 4), ends_at_once_for_the_second)
    assert over.tolist() == [False, True]
    assert (earned[:, 0] != 0).all()
    assert (earned[:, 1] != 0).tolist() == [True, True, False, False]


def test_copies_and_precision() -> None:
    env = small("catch")
    copies = to_dtype(repeat(env.env_state, 3), torch.float32)
    assert copies.particles.x.shape == (3, env.num_particles, 2) and copies.particles.x.dtype == torch.float32
    assert copies.steps.dtype == torch.int64 and copies.memory["object_com"].shape == (3, 2)
    _, earned, _ = rewards(env.model, copies, actions(env, 1).expand(1, 3, 2, 8, 8).float())
    assert earned.dtype == torch.float32 and (earned == earned[:, :1]).all()
