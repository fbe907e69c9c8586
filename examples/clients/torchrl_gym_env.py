"""TorchRL's GymEnv: specs, and a rollout as one TensorDict."""

from torchrl.envs import GymEnv
from torchrl.envs.utils import check_env_specs

import dittogym  # noqa: F401 (registers the environments)

env = GymEnv("dittogym/run-coarse-v0", particles=500, substeps=10)  # small, so that this takes seconds
check_env_specs(env, seed=0)
rollout = env.rollout(5)
images, actions = rollout["observation"], rollout["action"]
print(f"{len(rollout)} steps, images {tuple(images.shape)}, actions {tuple(actions.shape)}")
