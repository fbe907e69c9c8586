"""PPO of RLlib on RUN: its networks take floats with channels last, and an action in one row."""

import gymnasium
import numpy as np
import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env


def make(options):
    import dittogym  # noqa: F401 (registers the environments, in each process)

    env = gymnasium.make("dittogym/run-coarse-v0", **options)
    shape = env.action_space.shape
    images = gymnasium.spaces.Box(0, 1, (64, 64, 3), np.float32)
    env = gymnasium.wrappers.TransformObservation(
        env, lambda image: np.float32(np.moveaxis(image, 0, -1) / 255), images
    )
    row = gymnasium.spaces.Box(-1, 1, (int(np.prod(shape)),), np.float32)
    return gymnasium.wrappers.TransformAction(env, lambda action: action.reshape(shape), row)


register_env("run", make)
ray.init("local", num_cpus=1, include_dashboard=False)
options = {"particles": 500, "substeps": 10}  # small, so that this takes seconds
config = PPOConfig().environment("run", env_config=options)
config.env_runners(num_env_runners=0)  # simulates in this process
config.training(train_batch_size_per_learner=64, minibatch_size=32, num_epochs=1)
result = config.build_algo().train()
steps, loss = result["env_runners"]["num_env_steps_sampled"], result["learners"]["default_policy"]["policy_loss"]
print(f"{steps:.0f} steps, loss of the policy {loss:.3f}")
