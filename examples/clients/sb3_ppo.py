"""PPO of stable-baselines3 on RUN, whose robots are simulated as one batch."""

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import cfp
import dittogym

options = {"particles": 500, "substeps": 10}  # small, so that this takes seconds
batch = cfp.TorchVecEnv(dittogym.TorchEnv("run", num_envs=2, **options), max_episode_steps=16)
envs = VecMonitor(batch)  # without it stable-baselines3 logs no returns
model = PPO("CnnPolicy", envs, n_steps=16, batch_size=16, n_epochs=1, seed=0)  # images are uint8 (3, 64, 64)
model.learn(total_timesteps=64)
action, _ = model.predict(envs.reset(), deterministic=True)
print(f"{model.num_timesteps} steps, {len(model.ep_info_buffer)} returns, actions {action.shape}")
