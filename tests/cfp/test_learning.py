"""Soft actor-critic with the options of the preset ``quick`` learns a small task, whatever the seed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fakes import FakeEnv
from stable_baselines3.common.logger import Logger

from cfp.agent.policies import CFPPolicy
from cfp.agent.sac import CFP
from cfp.agent.spec import ActorSpec
from cfp.envs.vec_env import monitored
from cfp.presets import sac_preset

STEPS = 6
"""Of an episode: the height starts between -0.4 and 0.3, and is to be brought to 0.5 and held there."""


def make_env():
    return monitored(FakeEnv(num_envs=8, resolution=4, horizon=STEPS, start=-0.4, push=0.2))


def mean_return(model):
    """Of one episode of each robot, without noise."""
    env = make_env()
    observation, total = env.reset(), np.zeros(8)
    for _ in range(STEPS):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, _, _ = env.step(action)
        total += reward
    return total.mean()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_quick_learns_a_small_task(seed):
    quick = sac_preset("run")
    small = {"batch_size": 32, "buffer_size": 4_000, "update_start": 160, "gradient_steps": 4}
    # The height moves by the mean of all entries, over which noise of more cells would average out.
    hyperparameters = replace(quick.hyperparameters(1), **small, gamma=0.8, alpha=1e-3, noise_cells=1)
    spec = ActorSpec((4,), encoder=quick.network.encoder, initial_std=quick.network.initial_std)
    model = CFP(CFPPolicy, make_env(), hyperparameters, seed=seed, device="cpu", policy_kwargs={"spec": spec})
    model.set_logger(Logger(None, []))
    torch.manual_seed(seed)
    before = mean_return(model)
    model.learn(8 * 100)
    after = mean_return(model)
    print(before, after)
    assert before < 3.5
    assert after > 4.0
