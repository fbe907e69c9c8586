"""The options that make soft actor-critic cheaper and more stable, each on its own."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fakes import FakeEnv
from policy_files import save_actor
from test_algorithm import make_batch, make_model
from torch.nn import functional as F

from cfp.agent.actor import ActorSpec, Encoded, build_actor, halved, normalise_image, upsample
from cfp.agent.critics import SmallCritics
from cfp.agent.exploration import LONGEST, CellNoise
from cfp.agent.losses import critic_target
from cfp.agent.replay import ReplayRing
from cfp.config import to_json
from cfp.errors import ConfigError
from cfp.policy import load
from cfp.presets import analytic_preset, from_json, sac_preset

LEAN = {"plain": ActorSpec((8,), encoder="small"), "residual": ActorSpec((4, 8), (-1.0,), patch=16, encoder="small")}


def test_steps_ahead_are_summed_until_the_episode_or_the_memory_ends():
    env, gamma = FakeEnv(num_envs=3, resolution=4, horizon=4, end_above=0.203), 0.5
    options = {"n_steps": 3, "gamma": gamma, "buffer_size": 30, "batch_size": 4, "update_start": 100}
    model = make_model(ActorSpec((4,)), env, random_steps=100, **options)
    model.learn(45)  # fifteen rows in a ring of ten
    buffer = model.replay_buffer
    assert isinstance(buffer, ReplayRing) and buffer.full
    batch = buffer.sample(30)
    seen = {}
    for row, element in np.ndindex(buffer.buffer_size, 3):
        total, factor, last = 0.0, 1.0, row
        for ahead in range(3):
            last = (row + ahead) % buffer.buffer_size
            total, factor = total + factor * buffer.rewards[last, element], factor * gamma
            if buffer.dones[last, element] or (last + 1) % buffer.buffer_size == buffer.pos:
                break
        ended = buffer.dones[last, element] * (1 - buffer.timeouts[last, element])
        key = tuple(buffer.actions[row, element].flatten()[:4].tolist())
        seen[key] = total, factor, ended, buffer.next_observations[last, element]
    assert len({values[1] for values in seen.values()}) == 3 and {values[2] for values in seen.values()} == {0, 1}
    for index in range(30):
        total, factor, ended, following = seen[tuple(batch.actions[index].flatten()[:4].tolist())]
        assert batch.rewards[index].item() == pytest.approx(total, rel=1e-5)
        assert (batch.discounts[index].item(), batch.dones[index].item()) == (factor, ended)
        assert np.array_equal(batch.next_observations[index].numpy(), following)


def test_sums_that_end_early_are_normalised_like_whole_ones(monkeypatch):
    env, seen = FakeEnv(num_envs=3, resolution=4, horizon=4, end_above=0.203), []
    options = {"n_steps": 3, "gamma": 0.5, "buffer_size": 30, "batch_size": 4, "update_start": 100}
    model = make_model(ActorSpec((4,)), env, random_steps=100, **options)
    model.learn(45)
    model.replay_buffer.rewards[:] = 2.0
    model.reward_statistics.mean.fill_(2.0 * (1 + 0.5 + 0.25))

    def target(actor, critic, observation, rewards, *others):
        seen.append(rewards)
        return critic_target(actor, critic, observation, rewards, *others)

    monkeypatch.setattr("cfp.agent.sac.critic_target", target)
    batch = model.replay_buffer.sample(30)
    model.update(batch)
    assert len(batch.rewards.unique()) == len(batch.discounts.unique()) == 3
    assert seen[0].abs().max() < 1e-5  # all of them are as large as the mean


def test_noise_is_equal_in_cells_held_for_steps_and_larger_from_robot_to_robot():
    noise = CellNoise(4, 8, 2, (0.1, 0.8), seed=0)
    steps = torch.stack([noise() for _ in range(3000)])
    blocks = steps.unflatten(4, (2, 4)).unflatten(3, (2, 4))
    assert torch.equal(blocks, blocks[..., :1, :, :1].expand_as(blocks))
    for robot, scale in enumerate((0.1, 0.2, 0.4, 0.8)):
        assert steps[:, robot].std().item() == pytest.approx(scale, rel=0.1)
    same = (steps[1:] == steps[:-1]).flatten(2).all(2)
    assert 0.5 < same.float().mean() < 0.8  # zeta: one step in most cases, but many steps are within long spells
    longest = max(len(spell) for row in same.T.tolist() for spell in "".join("01"[held] for held in row).split("0"))
    assert longest == LONGEST - 1
    state, following = noise.state_dict(), None
    other = CellNoise(4, 8, 2, (0.1, 0.8), seed=1)
    other.load_state_dict(state)
    for _ in range(20):
        following = noise()
        assert torch.equal(other(), following)


def test_robots_explore_with_the_noise_of_cells():
    env = FakeEnv(num_envs=8, resolution=8)
    options = {"update_start": 100, "random_steps": 0, "noise_cells": 2, "noise_scale": (0.01, 2.0)}
    model = make_model(ActorSpec((8,)), env, **options)
    model.networks()[0].fix_std()
    model.learn(80)
    actions = torch.stack(env.actions)
    spread = actions.std((0, 2, 3, 4))
    assert spread[-1] > 5 * spread[0]
    inside = actions[:, -1, :, :4, :4]
    assert inside.flatten(2).std(2).mean() < 0.2 * spread[-1]


@pytest.mark.parametrize("spec", LEAN.values(), ids=LEAN)
def test_the_critics_alone_train_the_shared_encoder(spec):
    size = spec.action_size
    model = make_model(spec, FakeEnv(num_envs=2, resolution=size))
    actor, critic, _ = model.networks()
    encoder = list(actor.encoder.parameters())
    owners = [optimizer.param_groups[0]["params"] for optimizer in (actor.optimizer, critic.optimizer)]
    assert [any(each is encoder[0] for each in owned) for owned in owners] == [False, True]
    before = [parameter.clone() for parameter in encoder]
    batch = make_batch(size)
    with torch.no_grad():
        obs = model.policy.encode(batch.observations)
    model._update_actor(obs)
    assert all(map(torch.equal, before, encoder))
    model.update(batch)
    assert not any(map(torch.equal, before, encoder))
    coarse = [name for name, _ in actor.named_parameters() if name.startswith("coarse.")]
    assert bool(coarse) == (len(spec.resolutions) > 1)
    assert all(not actor.get_parameter(name).requires_grad for name in coarse)


def test_encoder_of_a_refined_policy_stays():
    model = make_model(LEAN["plain"], FakeEnv(num_envs=2, resolution=8))
    actor = model.networks()[0]
    model.origin = build_actor(LEAN["plain"])
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    model.update(make_batch(8))
    same = {name: torch.equal(value, before[name]) for name, value in actor.state_dict().items()}
    assert all(same[name] for name in same if name.startswith("encoder."))
    assert not any(same[name] for name in same if name.startswith("mean."))


def test_average_of_weights_is_the_policy():
    model = make_model(LEAN["plain"], FakeEnv(num_envs=2, resolution=8), weight_average=0.9)
    expected = {name: value.clone() for name, value in model.networks()[0].state_dict().items()}
    for update in range(3):
        model.update(make_batch(8))
        for name, value in model.networks()[0].state_dict().items():
            expected[name] = value.clone() if update == 0 else 0.9 * expected[name] + 0.1 * value
    averaged = model.trained_actor.state_dict()
    assert all(torch.allclose(averaged[name], value, atol=1e-7) for name, value in expected.items())
    assert not torch.equal(averaged["mean.0.weight"], model.networks()[0].state_dict()["mean.0.weight"])
    model.restart_average()
    assert torch.equal(model.trained_actor.state_dict()["mean.0.weight"], model.networks()[0].mean[0].weight)


def test_halved_images_are_means_of_four_pixels():
    image = make_batch(8).observations
    expected = F.avg_pool2d(normalise_image(image), 2)
    torch.testing.assert_close(halved(image), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(halved(normalise_image(image)), expected, rtol=0, atol=1e-6)
    assert halved(expected) is expected


def test_lean_policy_is_saved_and_loaded(tmp_path):
    config = sac_preset("run", "quick")
    spec = config.actor_spec(2)
    assert spec.encoder == "small"
    actor, images = build_actor(spec), make_batch(8).observations
    save_actor(tmp_path / "policy.safetensors", actor, config, 2, 5)
    loaded = load(tmp_path)
    assert loaded.spec == spec
    assert torch.equal(loaded(images, deterministic=True), actor(images, deterministic=True))
    full = build_actor(replace(spec, encoder="paper"))
    count = [sum(parameter.numel() for parameter in network.parameters()) for network in (actor, full)]
    assert count[0] < 0.8 * count[1]


@pytest.mark.parametrize("patch", [18, 32])
def test_lean_critics_take_actions_composed_on_the_grid_of_the_stage(patch):
    spec = ActorSpec((4, 8), (0.0,), patch=patch, encoder="small")
    actor, images = build_actor(spec), make_batch(8).observations
    executed, learned = (sample(images, deterministic=True) for sample in (actor.sample, actor.sample_for_critic))
    assert (executed.action.shape[2:], learned.action.shape[2:]) == ((patch, patch), (8, 8))
    for one, other in zip(executed.parts, learned.parts, strict=True):
        torch.testing.assert_close(one, other)
    coarse, residual, gate = learned.parts
    torch.testing.assert_close(learned.action, gate * residual + (1 - gate) * upsample(coarse, 8, "half_pixel"))
    full = build_actor(replace(spec, encoder="paper"))
    assert full.sample_for_critic(images).action.shape[2:] == (patch, patch)


@pytest.mark.parametrize("patch", [8, 18])
def test_batches_hold_actions_as_the_critics_take_them(patch):
    spec = ActorSpec((4, 8), (0.0,), patch=patch, encoder="small")
    model = make_model(spec, FakeEnv(num_envs=2, resolution=patch), update_start=4, batch_size=4)
    model.learn(24)
    batch = model.replay_buffer.sample(4)
    assert batch.actions.shape == (4, 2 * 8 * 8)
    actor, critic, _ = model.networks()
    obs = model.policy.encode(batch.observations)
    assert [values.shape for values in critic(obs, batch.actions)] == [(4, 1)] * 2
    sampled = actor.sample_for_critic(obs).action
    assert [values.shape for values in critic(obs, sampled)] == [(4, 1)] * 2


def test_larger_actions_are_averaged_over_the_cells_of_the_grid():
    critics, on_grid = SmallCritics(8), torch.randn(3, 2, 8, 8)
    encoded = critics.actions(on_grid)
    torch.testing.assert_close(critics.actions(F.interpolate(on_grid, size=64)), encoded)
    observation = Encoded(torch.zeros(3, 3, 32, 32), torch.randn(3, 16, 4, 4))
    assert [values.shape for values in critics(observation, torch.randn(3, 2, 18, 18))] == [(3, 1)] * 2


def test_layers_of_lean_critics_bound_the_values_of_inputs_never_seen():
    critics, image, features = SmallCritics(8), torch.zeros(3, 3, 32, 32), torch.randn(3, 16, 4, 4)
    actions = torch.randn(3, 2, 8, 8)
    large, larger = (critics(Encoded(image, scale * features), scale * actions) for scale in (1e3, 1e4))
    for one, other in zip(large, larger, strict=True):
        torch.testing.assert_close(one, other, rtol=0.1, atol=0.01)


def test_actor_starts_after_the_critics_and_rates_fall():
    options = {"update_start": 4, "batch_size": 4, "actor_start": 10, "final_rate": 0.1, "actor_rate": 1e-4}
    model = make_model(ActorSpec((8,)), **options)
    actor, critic, _ = model.networks()
    moved, rates = [], []
    update = model.update

    def watch(batch):
        before = actor.mean[0].weight.clone()
        scalars = update(batch)
        moved.append((model.num_timesteps, not torch.equal(before, actor.mean[0].weight)))
        rates.append([each.optimizer.param_groups[0]["lr"] for each in (actor, critic)])
        return scalars

    model.update = watch
    model.learn(24)
    assert moved == [(steps, steps >= 10) for steps in range(6, 25, 2)]
    assert rates[-1] == pytest.approx([1e-5, 3e-5], rel=1e-6)
    assert rates == sorted(rates, reverse=True)


def test_options_out_of_range_are_refused():
    for changes, message in (
        ({"noise_cells": 3}, "noise_cells must be one of"),
        ({"n_steps": 0}, "n_steps must be at least 1, got 0"),
        ({"gamma": 1.0}, "gamma must be below 1 with several n_steps"),
        ({"noise_scale": (0.0, 1.0)}, "noise_scale must be positive"),
    ):
        config = sac_preset("run", "quick")
        with pytest.raises(ConfigError, match=message):
            replace(config, learning=replace(config.learning, **changes)).check()


def test_a_policy_with_the_papers_networks_goes_on_with_smaller_batches_and_without_noise_of_cells():
    quick, started = sac_preset("run"), from_json({"task": "run", "learner": "sac", "start_from": "run"})
    assert (quick.network.encoder, started.network.encoder) == ("small", "paper")
    assert (quick.resolutions, started.resolutions) == ((4, 8), (8, 16))
    usual = {"n_steps": 1, "weight_average": 0.0}
    assert started.learning == replace(quick.learning, batch_size=64, noise_cells=0, **usual)
    assert (quick.max_episode_steps, started.max_episode_steps) == (200, None)
    asked = {"task": "run", "learner": "sac", "start_from": "run", "learning": {"noise_cells": 2, "gradient_steps": 8}}
    assert (from_json(asked).learning.noise_cells, from_json(asked).learning.gradient_steps) == (2, 8)
    assert from_json({"task": "run", "learner": "sac", "start_from": "run", "network": {"encoder": "paper"}}) == started
    gated = from_json({"task": "run", "learner": "sac", "start_from": "run", "network": {"gate_scale": 0.5}})
    assert gated == replace(started, network=replace(started.network, gate_scale=0.5))
    complete = to_json(started) | {"start_from": "moved-away"}  # as a run's config.json holds it
    assert from_json(complete) == replace(started, start_from="moved-away")


def test_paper_options_stay_with_a_policy_to_start_from():
    started = from_json({"task": "run", "preset": "paper", "start_from": "run"})
    assert started == replace(sac_preset("run", "paper"), start_from="run")


def test_a_policy_of_two_stages_is_refined_by_the_other_learner_with_its_own_gate(tmp_path):
    config = analytic_preset("run")
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(2)), config, 2, 0)
    refined = from_json({"task": "run", "learner": "sac", "start_from": str(tmp_path), "refine": True})
    assert refined.actor_spec(2) == config.actor_spec(2)
