"""PPO of stable-baselines3 on RUN: any Gymnasium client takes the environments by their id."""

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import dittogym  # noqa: F401 (registers the environments)

options = {"particles": 500, "substeps": 10}  # small, so that this takes seconds; leave them out for the real task
envs = make_vec_env("dittogym/run-coarse-v0", n_envs=2, seed=0, env_kwargs=options)
model = PPO("CnnPolicy", envs, n_steps=16, batch_size=16, n_epochs=1, seed=0)  # images are uint8 (3, 64, 64)
model.learn(total_timesteps=64)
action, _ = model.predict(envs.reset(), deterministic=True)
print(f"{model.num_timesteps} steps, actions {action.shape} from {action.min():.1f} to {action.max():.1f}")
