"""Cost of environment steps in RUN, of their gradients, and of training steps of both learners."""

import gymnasium
import numpy as np
import pytest
import torch

import dittogym
from cfp import registry


@pytest.mark.parametrize("gradient", [False, True], ids=["forward", "gradient"])
@pytest.mark.parametrize("particles", ["lite", "full"])
def test_step(benchmark, particles: str, gradient: bool) -> None:
    """A control step of one robot, and the gradient of its smooth reward in the action."""
    env = dittogym.TorchEnv("run", particles=particles)
    env.reset(seed=0)
    action = torch.zeros(1, *env.action_shape, requires_grad=gradient)

    def run() -> None:
        reward = env.step(action, soft=gradient)[1]
        if gradient:
            reward.sum().backward()
            env.detach()

    benchmark.pedantic(run, rounds=20, warmup_rounds=2)


@pytest.mark.parametrize("num_envs", [16, 64])
def test_make_vec(benchmark, num_envs: int) -> None:
    """A control step of some robots of 2,000 particles under Gymnasium's vector interface."""
    env = gymnasium.make_vec(
        "dittogym/run-coarse-v0", num_envs=num_envs, vectorization_mode="vector_entry_point", particles="lite"
    )
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    benchmark.pedantic(lambda: env.step(action), rounds=10, warmup_rounds=1)


@pytest.mark.parametrize(
    ("algo", "options"),
    [
        ("cfp-analytic", {}),
        ("cfp-sac", {"random_steps": [64], "update_start": 64, "critics_first": [0.0]}),
    ],
)
def test_training(benchmark, tmp_path, algo: str, options: dict) -> None:
    """256 environment steps of a training with the preset quick, with updates of all networks."""
    config = registry.configure({"algo": algo, "task": "run", "device": "cpu", **options})
    learner = registry.find(algo).create(config, 1, tmp_path)
    benchmark.pedantic(lambda: learner.learn(256, reset_num_timesteps=False), rounds=3, warmup_rounds=1)
    benchmark.extra_info["environment steps"] = 256
