"""Activation checkpointing over environment steps: memory of one step at a time, the same gradient."""

import torch
from torch.utils.checkpoint import checkpoint

import dittogym

env = dittogym.TorchEnv("run", particles=500, substeps=10)  # small, so that this takes seconds
env.reset(seed=0)
start = env.env_state
actions = torch.zeros(4, 1, *env.action_shape, requires_grad=True)


def reward_sum(recompute):
    state, total = start, torch.zeros(1)
    for action in actions:
        if recompute:
            state, reward = checkpoint(step, state, action, use_reentrant=False)
        else:
            state, reward = step(state, action)
        total = total + reward
    return total.sum()


def step(state, action):
    result = dittogym.core.step(env.model, state, action, soft=True)
    return result.state, result.reward


plain, recomputed = (torch.autograd.grad(reward_sum(recompute), actions)[0] for recompute in (False, True))
assert torch.equal(plain, recomputed)
print(f"gradients {tuple(plain.shape)} are equal, norm {plain.norm():.3g}")
