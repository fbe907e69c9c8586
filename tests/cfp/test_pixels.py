"""Missing pixels of an image, which policies fill before their networks see it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from policy_files import save_actor
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

import cfp
from cfp import CFP, ActorPolicy, ActorSpec, CFPAnalytic, CFPPolicy, Hyperparameters
from cfp.agent.actor import Actor, build_actor
from cfp.agent.pixels import fill_missing
from cfp.envs.vec_env import TorchVecEnv, monitored
from cfp.learner import CoarseToFine
from dittogym import TorchEnv

SPEC = ActorSpec((4,), encoder="small", fill_missing=True)
LOST = {"observation_dropout": 0.2}


def body():
    """An image (64, 64) of a rectangle whose values rise by 1 per column and by 2 per row, in empty space."""
    image = torch.zeros(64, 64, dtype=torch.uint8)
    rows, columns = torch.meshgrid(torch.arange(20), torch.arange(30), indexing="ij")
    image[10:30, 20:50] = (100 + 2 * rows + columns).to(torch.uint8)
    return image


def raw(count=2):
    """Images of robots that lack pixels."""
    return TorchEnv("run", count, 4, particles=2000, substeps=1, conditions=LOST).reset(seed=0)[0]


def test_a_lost_pixel_becomes_the_mean_of_those_around_it():
    image = body()
    lost = image.clone()
    lost[20, 30] = lost[10, 40] = 0  # within the body, where the mean is the value itself, and at its upper edge
    filled = fill_missing(lost)
    assert filled[20, 30] == image[20, 30]
    around = image[10:12, 39:42].sum() - image[10, 40]
    assert filled[10, 40] == torch.round(around / 5)
    lost[20, 30], lost[10, 40] = image[20, 30], image[10, 40]
    assert torch.equal(lost, image)


def test_a_pixel_with_too_few_around_it_stays_missing():
    image = body()
    image[15:20, 30:35] = 0
    filled = fill_missing(image)
    changed = (filled != image).nonzero().tolist()
    assert changed == [[row, column] for row in (15, 19) for column in (30, 34)], "corners have five around them"


def test_empty_space_and_complete_images_stay():
    full = torch.randint(1, 256, (3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    for image in (body(), torch.zeros(64, 64, dtype=torch.uint8), full):
        assert torch.equal(fill_missing(image), image)


@pytest.mark.parametrize("shape", [(6,), (2, 3), (2, 1, 3)])
def test_images_of_a_batch_are_filled_on_their_own(shape):
    images = raw().flatten(0, 1)
    given = images.clone()
    alone = torch.stack([fill_missing(image) for image in images])
    assert torch.equal(fill_missing(images.view(*shape, 64, 64)), alone.view(*shape, 64, 64))
    assert torch.equal(images, given) and not torch.equal(alone, given)


@pytest.fixture
def looks(monkeypatch):
    """What actors are given from now on."""
    found, outputs = [], Actor.outputs

    def look(actor, observation, *arguments, **options):
        found.append(observation)
        return outputs(actor, observation, *arguments, **options)

    monkeypatch.setattr(Actor, "outputs", look)
    return found


def test_all_ways_to_act_by_a_policy_fill_images_once():
    images, filling = raw(), ActorPolicy(SPEC)
    plain = ActorPolicy(replace(SPEC, fill_missing=False), actor=filling.actor)
    trained = CFPPolicy(filling.observation_space, filling.action_space, lambda _: 1e-3, SPEC)
    trained.actor.load_state_dict(filling.actor.state_dict())
    wanted = plain.predict(fill_missing(images).numpy(), deterministic=True)[0]
    ways = (
        filling.predict(images.numpy(), deterministic=True)[0],
        filling.predict_with_gate(images.numpy(), deterministic=True)[0],
        trained.predict(images.numpy(), deterministic=True)[0],
    )
    assert all(np.array_equal(action, wanted) for action in ways)
    assert torch.equal(filling(images, deterministic=True), plain(fill_missing(images), deterministic=True))
    assert not np.array_equal(plain.predict(images.numpy(), deterministic=True)[0], wanted)


def as_it_is(env):
    return env


def with_scaled_rewards(env):
    return VecNormalize(env, norm_obs=False)


@pytest.mark.parametrize(
    ("tensors", "noise_cells", "wrap"),
    [
        (False, 0, as_it_is),
        (False, 2, as_it_is),
        (True, 0, as_it_is),
        (True, 2, as_it_is),
        (False, 2, with_scaled_rewards),
    ],
)
def test_soft_actor_critic_acts_on_and_remembers_filled_images(tensors, noise_cells, wrap, looks, monkeypatch):
    """Each filled once: those of the environment, and the last ones of episodes; also when it goes on learning."""
    seen, last = [], {}

    def reset(env):
        seen.append(own_reset(env))
        return seen[-1]

    def step_wait(env):
        result = own_step(env)
        last.update({(len(seen), i): info["terminal_observation"] for i, info in enumerate(result[3]) if result[2][i]})
        seen.append(result[0])
        return result

    own_reset, own_step = TorchVecEnv.reset, TorchVecEnv.step_wait
    monkeypatch.setattr(TorchVecEnv, "reset", reset)
    monkeypatch.setattr(TorchVecEnv, "step_wait", step_wait)
    env = TorchEnv("run", 2, 4, particles=2000, substeps=1, conditions=LOST)
    own = Hyperparameters(buffer_size=40, batch_size=8, update_start=1_000, random_steps=0, noise_cells=noise_cells)
    env = wrap(monitored(env, 4, tensors))
    model = CFP(CFPPolicy, env, own, seed=0, device="cpu", policy_kwargs={"spec": SPEC})
    model.set_logger(Logger(None, []))
    for _ in range(2):
        model.learn(6, reset_num_timesteps=False)
    images = torch.stack([torch.as_tensor(each) for each in seen])
    after = images[1:].clone()
    for (step, index), image in last.items():
        after[step - 1, index] = torch.as_tensor(image)
    stored = (torch.as_tensor(getattr(model.replay_buffer, f"{which}observations")[:6]) for which in ("", "next_"))
    now, following = (each.view(6, 2, 3, 64, 64) for each in stored)
    assert len(last) >= 3 and not torch.equal(fill_missing(images), images)
    assert torch.equal(now, fill_missing(images[:-1])) and torch.equal(following, fill_missing(after))
    assert torch.equal(torch.stack(looks), now)


def test_learning_by_gradients_acts_on_and_remembers_filled_images(tmp_path, looks, monkeypatch):
    raw_images, observation = [], TorchEnv.observation
    monkeypatch.setattr(TorchEnv, "observation", lambda env: raw_images.append(observation(env)) or raw_images[-1])
    config = replace(cfp.preset("run"), resolutions=(4,), handover=(), action_step=(0.1,), vary=1.0, device="cpu")
    config = replace(config, train_particles=2000, substeps=1, window=3, minibatches=0, num_envs=2)
    learner = CFPAnalytic.create(config, 1, tmp_path)
    learner.set_logger(Logger(None, []))
    looks.clear()
    raw_images.clear()
    learner.learn(6, reset_num_timesteps=False)
    acted, images = torch.stack(looks), torch.stack(raw_images)
    assert torch.equal(acted, fill_missing(images)) and not torch.equal(acted, images)
    assert torch.equal(learner.memory.sample(64, learner.generator)[0].unique(dim=0), acted.flatten(0, 1).unique(dim=0))


def test_a_policy_that_did_not_fill_can_be_refined_by_one_that_does(tmp_path):
    config = replace(cfp.preset("run"), start_from=str(tmp_path / "policy.safetensors"), refine=True)
    old = replace(config, fill_missing=False)
    save_actor(tmp_path / "policy.safetensors", build_actor(old.actor_spec(2)), old, 2, 0)
    for own in (config, old):
        folder = tmp_path / str(own.fill_missing)
        folder.mkdir()
        assert CoarseToFine.begin(own, folder)[0] == 2
