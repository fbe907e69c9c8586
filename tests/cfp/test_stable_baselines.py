"""stable-baselines3's callbacks, evaluation, saving and loading: with its own algorithms, and with both learners."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import ReplayBufferSamples

import cfp
from cfp import CFP, CFPAnalytic, Hyperparameters, ImageFeatures
from cfp.agent.actor import normalise_image
from cfp.envs.vec_env import monitored
from dittogym import TorchEnv

FEATURES = {"features_extractor_class": ImageFeatures, "features_extractor_kwargs": {"width": 8}, "net_arch": [16]}
CONFIG = replace(
    cfp.preset("shapematch", "quick", "cfp-analytic"),
    **{"particles": 100, "train_particles": 100, "substeps": 1, "num_envs": 2, "resolutions": (8,), "steps": 64},
    **{"window": 4, "minibatches": 2, "minibatch_size": 4, "windows_kept": 2, "max_episode_steps": 6, "device": "cpu"},
)


def make_env(num_envs=2):
    env = TorchEnv("shapematch", num_envs, 8, particles=100, substeps=1, backend="eager")
    return monitored(env, max_episode_steps=6)


def make(algorithm):
    if algorithm is CFPAnalytic:
        return CFPAnalytic("NetworksPolicy", make_env(), CONFIG, device="cpu")
    if algorithm is CFP:
        own = Hyperparameters(buffer_size=40, batch_size=4, update_start=6, random_steps=4, weight_average=0.9)
        return CFP("CFPPolicy", make_env(), own, seed=0, device="cpu")
    own = {SAC: {"learning_starts": 4, "buffer_size": 20}, PPO: {"n_steps": 4, "n_epochs": 1}}[algorithm]
    return algorithm("CnnPolicy", make_env(), policy_kwargs=dict(FEATURES), seed=0, device="cpu", batch_size=4, **own)


@pytest.mark.parametrize("algorithm", [CFP, CFPAnalytic, SAC, PPO])
def test_algorithm_learns_with_callbacks_and_is_evaluated(algorithm, tmp_path):
    model = make(algorithm)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    evaluation = EvalCallback(make_env(), n_eval_episodes=2, eval_freq=4, best_model_save_path=str(tmp_path), verbose=0)
    model.learn(16, callback=[evaluation, CheckpointCallback(4, str(tmp_path))])
    assert model.num_timesteps == 16
    encoders = [name for name in before if "encoder.first.weight" in name and "target" not in name]
    assert encoders and all(not torch.equal(model.policy.state_dict()[name], before[name]) for name in encoders)
    assert (tmp_path / "best_model.zip").exists() and (tmp_path / "rl_model_8_steps.zip").exists()
    assert np.isfinite(evaluate_policy(model, make_env(), 2)[0]) and np.isfinite(evaluation.last_mean_reward)
    again = algorithm.load(tmp_path / "rl_model_16_steps.zip", make_env(), device="cpu")
    assert evaluate_policy(again, make_env(), 2, return_episode_rewards=True)[1] == [3, 6]  # the first ones are shorter


class Steps(BaseCallback):
    """Keeps what it sees at each control step, and stops after ``last`` environment steps."""

    def __init__(self, last):
        super().__init__()
        self.last, self.steps, self.ends, self.began, self.ended = last, [], [], 0, 0

    def _on_training_start(self):
        self.total = self.locals["total_timesteps"]  # as stable-baselines3's progress bar does

    def _on_rollout_start(self):
        self.began += 1

    def _on_rollout_end(self):
        self.ended += 1

    def _on_step(self):
        dones, infos = self.locals["dones"], self.locals["infos"]
        assert [bool(done) for done in dones] == ["episode" in info for info in infos]
        self.steps.append(self.num_timesteps)
        self.ends += [(self.n_calls, info["episode"]["l"]) for info in infos if "episode" in info]
        return self.num_timesteps < self.last


@pytest.mark.parametrize("algorithm", [CFP, CFPAnalytic])
def test_callbacks_are_called_once_for_each_step_of_all_robots_and_may_stop(algorithm):
    model, seen = make(algorithm), Steps(last=22)
    model.learn(64, seen)
    assert seen.steps == list(range(2, 23, 2)) and model.num_timesteps == 22
    assert seen.ends == [(3, 3), (6, 6), (9, 6)]
    assert seen.began >= seen.ended >= 2 and seen.total == 64
    more = Steps(last=64)
    model.learn(8, more, reset_num_timesteps=False)
    assert model.num_timesteps >= 30 and more.total == 30
    model.learn(64, StopTrainingOnMaxEpisodes(3))
    assert model.num_timesteps == 36  # it stops after three episodes of each robot


def test_gradients_need_an_environment_in_torch():
    env = gymnasium.make("dittogym/shapematch-coarse-v0", resolution=8, particles=100, substeps=1)
    with pytest.raises(TypeError, match=r"env must be a TorchVecEnv, got <.*DummyVecEnv"):
        CFPAnalytic("NetworksPolicy", env, CONFIG, device="cpu")


def test_learners_by_gradients_need_their_options():
    with pytest.raises(TypeError, match=r"config must be .* got None"):
        CFPAnalytic("NetworksPolicy", make_env(), device="cpu")


@pytest.mark.parametrize("algorithm", [CFP, CFPAnalytic])
@pytest.mark.parametrize("with_env", [True, False])
def test_saved_model_acts_the_same_and_learns_on(algorithm, with_env, tmp_path):
    model = make(algorithm)
    model.learn(16)
    model.save(tmp_path / "model.zip")
    again = algorithm.load(tmp_path / "model.zip", make_env() if with_env else None, device="cpu")
    images = np.random.default_rng(0).integers(0, 256, (2, 3, 64, 64), dtype=np.uint8)
    for observation in (images, images[0]):
        action, _ = model.predict(observation, deterministic=True)
        assert action.shape == (*observation.shape[:-3], 2, 8, 8)
        assert np.array_equal(again.predict(observation, deterministic=True)[0], action)
    averaged = again.trained_actor.state_dict()
    assert all(torch.equal(averaged[name], value) for name, value in model.trained_actor.state_dict().items())
    assert all(torch.equal(again.policy.state_dict()[name], value) for name, value in model.policy.state_dict().items())
    if algorithm is CFP:
        assert torch.equal(again.reward_statistics.mean, model.reward_statistics.mean)
    if not with_env:
        again.set_env(make_env())
    again.learn(16, reset_num_timesteps=False)
    assert again.num_timesteps == 32


@pytest.mark.parametrize("algorithm", [CFP, CFPAnalytic])
def test_average_of_a_loaded_model_goes_on_from_the_weights_that_it_had(algorithm, tmp_path):
    model = make(algorithm)
    model.learn(16)
    model.save(tmp_path / "model.zip")
    models = model, algorithm.load(tmp_path / "model.zip", make_env(), device="cpu")
    images = torch.randint(0, 256, (4, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    for each in models:
        if algorithm is CFP:
            torch.manual_seed(0)
            transitions = torch.zeros(4, 128), images, torch.zeros(4, 1), torch.arange(4.0)[:, None]
            each.update(ReplayBufferSamples(images, *transitions))
        else:
            each.regression.update(images, torch.zeros(4, 2, 8, 8), 1e-3)
    averages = [each.trained_actor.state_dict() for each in models]
    assert all(torch.equal(averages[1][name], value) for name, value in averages[0].items())


def test_predict_acts_by_the_networks_in_training_and_leaves_them_as_they_are():
    model = make(CFPAnalytic)
    images = np.random.default_rng(0).integers(0, 256, (2, 3, 64, 64), dtype=np.uint8)
    kept, trained = model.trained_policy, len(model.actor.trainable_parameters())
    before = model.predict(images, deterministic=True)[0]
    assert np.array_equal(kept.predict(images, deterministic=True)[0], before)
    model.learn(16)
    after = model.predict(images, deterministic=True)[0]
    assert not np.array_equal(after, before) and np.array_equal(model.predict(images, deterministic=True)[0], after)
    assert np.array_equal(kept.predict(images, deterministic=True)[0], before)
    assert len(model.actor.trainable_parameters()) == trained > 0


def test_networks_refuse_to_act_on_what_predict_has_not_prepared():
    """Images with missing pixels, for instance."""
    with pytest.raises(NotImplementedError, match="call predict of the algorithm"):
        make(CFPAnalytic).policy.predict(np.zeros((3, 64, 64), np.uint8))


@pytest.mark.parametrize(("taken", "over"), [((32,), 64), ((32, 64), 96)])
def test_rates_fall_over_the_stage_or_over_the_steps_that_are_taken_if_they_are_more(taken, over):
    model = make(CFPAnalytic)
    for steps in taken:
        model.learn(steps, reset_num_timesteps=False)
    last = sum(taken) - CONFIG.update_every
    assert model.progress == last / over


def test_features_are_those_of_the_encoder():
    box = spaces.Box(0, 255, (3, 64, 64), np.uint8)
    extractor = ImageFeatures(box, 32)
    image = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    features = extractor(image.float() / 255)
    assert features.shape == (2, extractor.features_dim) == (2, 512)
    torch.testing.assert_close(features, extractor.encoder(normalise_image(image)).flatten(1))
    with pytest.raises(ValueError, match=r"must have shape \(3, 64, 64\), got \(3, 32, 32\)"):
        ImageFeatures(spaces.Box(0, 255, (3, 32, 32), np.uint8))
