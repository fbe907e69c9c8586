"""stable-baselines3's own algorithms, callbacks and evaluation on the environments as they are."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy

from cfp import ImageFeatures
from cfp.agent.actor import normalise_image
from cfp.envs.vec_env import monitored
from dittogym import TorchEnv

OPTIONS = {
    SAC: {"learning_starts": 4, "batch_size": 4, "buffer_size": 20},
    PPO: {"n_steps": 4, "batch_size": 4, "n_epochs": 1},
}


def make_env(num_envs=2):
    return monitored(TorchEnv("shapematch", num_envs, 8, particles=100, substeps=1, backend="eager"))


@pytest.mark.parametrize("algorithm", OPTIONS)
def test_algorithm_learns_with_callbacks_and_is_evaluated(algorithm, tmp_path):
    kwargs = {"features_extractor_class": ImageFeatures, "features_extractor_kwargs": {"width": 8}, "net_arch": [16]}
    model = algorithm("CnnPolicy", make_env(), policy_kwargs=kwargs, seed=0, device="cpu", **OPTIONS[algorithm])
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    evaluation = EvalCallback(make_env(), n_eval_episodes=2, eval_freq=4, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(16, callback=[evaluation, CheckpointCallback(4, str(tmp_path))])
    assert model.num_timesteps == 16
    encoders = [name for name in before if "encoder.first.weight" in name and "target" not in name]
    assert encoders and all(not torch.equal(model.policy.state_dict()[name], before[name]) for name in encoders)
    assert (tmp_path / "best_model.zip").exists() and (tmp_path / "rl_model_8_steps.zip").exists()
    mean, _ = evaluate_policy(model, make_env(), 2)
    assert np.isfinite(mean) and np.isfinite(evaluation.last_mean_reward)
    again = algorithm.load(tmp_path / "rl_model_16_steps.zip", make_env(), device="cpu")
    assert evaluate_policy(again, make_env(), 2, return_episode_rewards=True)[1] == [30, 30]


def test_features_are_those_of_the_encoder():
    box = spaces.Box(0, 255, (3, 64, 64), np.uint8)
    extractor = ImageFeatures(box, 32)
    image = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    features = extractor(image.float() / 255)
    assert features.shape == (2, extractor.features_dim) == (2, 512)
    torch.testing.assert_close(features, extractor.encoder(normalise_image(image)).flatten(1))
    with pytest.raises(ValueError, match=r"must have shape \(3, 64, 64\), got \(3, 32, 32\)"):
        ImageFeatures(spaces.Box(0, 255, (3, 32, 32), np.uint8))
