"""Evaluations."""

import numpy as np
import pytest
import torch
from fakes import FakeEnv

from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError
from cfp.evaluate import Selection
from cfp.evaluation.evaluate import evaluate
from cfp.train import PROGRAM


class LinearPolicy:
    """Actions are a linear function of the pixels; torch sums them in parts, one for each thread."""

    def __init__(self):
        torch.manual_seed(0)
        self.weights, self.actions = torch.randn(3 * 64 * 64, 2 * 8 * 8), []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        pixels = torch.as_tensor(observation).flatten(1).float() / 255
        self.actions.append((pixels @ self.weights).tanh().view(-1, 2, 8, 8).numpy())
        return self.actions[-1], state


@pytest.mark.parametrize("threads", [2, 3, 4])
def test_evaluation_does_not_depend_on_the_number_of_threads(threads):
    policies = LinearPolicy(), LinearPolicy()
    for policy, count in zip(policies, (1, threads), strict=True):
        torch.set_num_threads(count)
        evaluate("", policy, monitored(FakeEnv(num_envs=16)), 16, deterministic=True, seed=0)
        assert torch.get_num_threads() == count
    for one, other in zip(*(policy.actions for policy in policies), strict=True):
        assert np.array_equal(one, other)


def test_a_policy_can_be_evaluated_with_other_substeps():
    config, _ = Selection(policy="run", dt=2e-4).open(PROGRAM)
    assert (config.environment.dt, config.environment.substeps) == (2e-4, 50)
    with pytest.raises(ConfigError, match="dt must divide"):
        Selection(policy="run", dt=3e-4).open(PROGRAM)
