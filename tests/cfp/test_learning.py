"""Soft actor-critic learns: a task without physics that takes seconds, with the networks and options of `quick`."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from cfp import CFP, CFPPolicy
from cfp.presets import sac_preset


class BrightSide(gymnasium.Env):
    """The muscles of the bright half of the image must contract, and those of the dark half extend.

    The reward is 1 minus the mean distance to these actions: 0 for zero actions and for random ones, 1 at most.
    """

    observation_space = gymnasium.spaces.Box(0, 255, (3, 64, 64), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (2, 4, 4), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe(), {}

    def step(self, action):
        wanted = np.where(np.arange(4) // 2 == self.bright, 1.0, -1.0)
        self.steps += 1
        return self._observe(), float(1 - np.abs(action - wanted).mean()), False, self.steps == 50, {}

    def _observe(self):
        self.bright = self.np_random.integers(2)
        image = np.zeros((3, 64, 64), np.uint8)
        image[:, :, 32 * self.bright : 32 * self.bright + 32] = 255
        return image


def mean_reward(policy, env, steps=20):
    observation, rewards = env.reset(), []
    for _ in range(steps):
        observation, reward, _, _ = env.step(policy.predict(observation, deterministic=True)[0])
        rewards.append(reward.mean())
    return np.mean(rewards)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_reward_rises_within_a_few_hundred_updates(seed):
    config = sac_preset("run", "quick")
    # Fewer steps with more and smaller updates, so that the test takes seconds.
    options = {"random_steps": 64, "update_start": 64, "actor_start": 64, "batch_size": 32, "gradient_steps": 16}
    options["n_steps"] = 1  # actions change no later reward here, which would only be noise in the targets
    env = DummyVecEnv([BrightSide] * 16)
    env.seed(seed)
    hyperparameters = replace(config.hyperparameters(1), **options)
    networks = {"spec": config.actor_spec(1)}
    model = CFP(CFPPolicy, env, hyperparameters, policy_kwargs=networks, seed=seed, device="cpu")
    before = mean_reward(model, env)
    model.learn(336)
    assert abs(before) < 0.3
    assert mean_reward(model, env) > 0.6
