"""Rollouts as functions of the actions, against the environment."""

import pytest
import torch

from baselines.common.rollout import rollout, soft_step
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
    result = rollout(env.model, start, drive)
    steps = [env.step(action, soft=True) for action in drive]
    assert torch.equal(result.rewards, torch.stack([step[1] for step in steps]))
    assert torch.equal(result.true_rewards, torch.stack([step[-1]["true_reward"] for step in steps]))
    assert not result.ended.any() and torch.equal(result.state.particles.x, env.state.x)
    for name, value in env.env_state.task_state.items():
        assert torch.equal(result.state.task_state[name], value)


def test_checkpoints_do_not_change_the_gradient() -> None:
    env = small("kick")
    gradients = []
    for checkpointed in (True, False):
        drive = actions(env, 3).requires_grad_()
        result = rollout(env.model, env.env_state, drive, checkpointed=checkpointed)
        assert not result.true_rewards.requires_grad
        gradients.append(torch.autograd.grad(result.rewards.sum(), drive)[0])
    assert torch.equal(*gradients) and gradients[0].abs().amax((1, 2, 3, 4)).min() > 0


def test_nothing_is_earned_after_the_end() -> None:
    env = small("run", 2)

    def ends_soon_for_the_second(model, state, action):
        result = soft_step(model, state, action)
        return result._replace(terminated=torch.tensor([False, True]) & (result.state.steps == 2))

    result = rollout(env.model, env.env_state, actions(env, 4), ends_soon_for_the_second)
    assert result.ended.tolist() == [False, True]
    for earned in (result.rewards, result.true_rewards):
        assert (earned[:, 0] != 0).all()
        assert (earned[:, 1] != 0).tolist() == [True, True, False, False]
