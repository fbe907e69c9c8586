"""TQC of sb3-contrib on RUN, from images."""

from sb3_contrib import TQC
from stable_baselines3.common.env_util import make_vec_env

import dittogym  # noqa: F401 (registers the environments)

options = {"particles": 500, "substeps": 10}  # small, so that this takes seconds
envs = make_vec_env("dittogym/run-coarse-v0", n_envs=2, seed=0, env_kwargs=options)
model = TQC("CnnPolicy", envs, buffer_size=100, learning_starts=8, batch_size=8, seed=0)
model.learn(total_timesteps=16)
action, _ = model.predict(envs.reset(), deterministic=True)
print(f"{model.num_timesteps} steps, {model._n_updates} updates, actions {action.shape}")
