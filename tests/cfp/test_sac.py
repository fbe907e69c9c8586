"""Soft actor-critic: the update rule against a hand-written float64 computation that shares no code with the networks,
what robots do and what is stored, and each option that makes learning cheaper or more stable.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from fakes import FakeEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.nn import functional as F

from cfp import CFP, CFPPolicy
from cfp.agent.actor import ActorSpec, Encoded, build_actor, upsample
from cfp.config import Hyperparameters
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError, NonFiniteError
from cfp.sac.learner import LONGEST_HOLD, METRICS, CellNoise, critic_target
from cfp.sac.policies import SmallCritics

ALPHA, RHO, GAMMA, LIMIT = 0.03, 0.7, 0.9, 0.05
SMALL = {"plain": ActorSpec((8,), encoder="small"), "residual": ActorSpec((4, 8), (-1.0,), patch=16, encoder="small")}


def make_model(spec, env=None, sac_options=None, **hyperparameters):
    env = env or FakeEnv(num_envs=2, resolution=spec.resolutions[-1])
    own = Hyperparameters(**{"buffer_size": 400, "batch_size": 8, **hyperparameters})
    model = CFP(
        CFPPolicy, monitored(env), own, seed=0, device="cpu", policy_kwargs={"spec": spec}, **(sac_options or {})
    )
    model.set_logger(Logger(None, []))
    return model


def make_batch(resolution, count=6):
    generator = torch.Generator().manual_seed(3)
    images = torch.randint(0, 256, (2, count, 3, 64, 64), dtype=torch.uint8, generator=generator)
    action = torch.rand(count, 2 * resolution**2, generator=generator) * 2 - 1
    done = torch.tensor([0.0, 1.0] * (count // 2))[:, None]
    reward = torch.randn(count, 1, generator=generator) * 3 + 2
    return ReplayBufferSamples(images[0], action, images[1], done, reward)


# The same networks once more, in float64, from the names of their weights.


def coordinates(count):
    line = (torch.arange(64, dtype=torch.float64) - 32) / 32
    return torch.stack(torch.meshgrid(line, line, indexing="ij")).expand(count, 2, 64, 64)


def encode(weights, prefix, *images):
    x = torch.cat([*images, coordinates(len(images[0]))], dim=1)
    for name, stride in (("first", 4), ("rest.1", 2), ("rest.3", 1)):
        x = F.elu(F.conv2d(x, weights[f"{prefix}.{name}.weight"], weights[f"{prefix}.{name}.bias"], stride=stride))
    return x


def encode_pair(weights, prefix, image, patch):
    if f"{prefix}.encoders.1.first.weight" not in weights:
        return encode(weights, f"{prefix}.encoders.0", image, patch)
    return torch.cat([encode(weights, f"{prefix}.encoders.{i}", each) for i, each in enumerate((image, patch))], dim=1)


def perceptron(weights, prefix, x):
    for layer in (1, 3, 5):
        x = F.linear(x, weights[f"{prefix}.{layer}.weight"], weights[f"{prefix}.{layer}.bias"])
        x = F.elu(x) if layer < 5 else x
    return x


STRIDES = {4: (), 8: (2, 1, 1), 16: (2, 2, 1)}


def decode(weights, prefix, latent, strides):
    if not strides:
        return perceptron(weights, prefix, latent.flatten(1)).view(-1, 2, 4, 4)
    for index, stride in enumerate(strides):
        layer = f"{prefix}.{2 * index}"
        x = F.elu(latent) if index else latent
        latent = F.conv_transpose2d(x, weights[f"{layer}.weight"], weights[f"{layer}.bias"], stride=stride, padding=1)
    return latent


def lift(action, size, aligned):
    return F.interpolate(action, size=(size, size), mode="bicubic", align_corners=aligned)


def squash(weights, prefix, latent, strides, noise):
    mean = decode(weights, f"{prefix}mean", latent, strides)
    std = torch.log1p(torch.exp(3 * decode(weights, f"{prefix}std", latent, strides) - 1)).clamp(0.1, 6)
    action = torch.tanh(mean + std * noise)
    density = -0.5 * noise**2 - torch.log(std * math.sqrt(2 * math.pi)) - torch.log(1 - action**2 + 1e-6)
    return action, density.sum((1, 2, 3))


def act(weights, image, noises: Iterator[torch.Tensor], spec):
    """Action, log-density and gate of a plain actor, or of an 8x8 -> 16x16 one, blended there or on the patch."""
    if len(spec.resolutions) == 1:
        latent = encode(weights, "encoder", image)
        return *squash(weights, "", latent, STRIDES[spec.resolutions[0]], next(noises)), None
    coarse_latent = encode(weights, "coarse.encoder", image)
    coarse = squash(weights, "coarse.", coarse_latent, (2, 1, 1), next(noises))[0].detach()
    size, aligned = spec.action_size, spec.interpolation == "aligned"
    coarse = lift(coarse, size, aligned)
    latent = encode_pair(weights, "encoder", image, lift(coarse, 64, aligned))
    action, density = squash(weights, "", latent, (2, 2, 1), next(noises))
    gate = spec.gate_scale / (1 + torch.exp(-decode(weights, "gate", latent, (2, 2, 1)) + 1.5))
    weight = lift(gate, size, aligned)
    return weight * lift(action, size, aligned) + (1 - weight) * coarse, density, gate


def q_values(weights, image, action, aligned):
    values = []
    for index in range(2):
        prefix = f"critics.{index}"
        x = encode_pair(weights, f"{prefix}.encoder", image, lift(action, 64, aligned))
        values.append(perceptron(weights, f"{prefix}.value", x.flatten(1)))
    return values


def doubles(module, grad):
    return {name: value.detach().double().requires_grad_(grad) for name, value in module.state_dict().items()}


KINDS = {
    "linear": ActorSpec((4,), interpolation="aligned"),
    "plain": ActorSpec((8,), interpolation="aligned"),
    "grid": ActorSpec((8, 16), (-1.5,), interpolation="aligned"),
    "patch": ActorSpec((8, 16), (-1.5,), patch=64),
    "split": ActorSpec((8, 16), (-1.5,), split=True, gate_scale=0.25, interpolation="aligned"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_one_update_equals_the_float64_computation(kind, monkeypatch):
    spec = KINDS[kind]
    residual, aligned = len(spec.resolutions) > 1, spec.interpolation == "aligned"
    resolution = spec.action_size
    env = FakeEnv(num_envs=2, resolution=resolution)
    model = make_model(spec, env, alpha=ALPHA, gate_penalty=RHO, gamma=GAMMA, tau=0.25)
    batch = make_batch(resolution)
    actor, critic, target = model.networks()
    with torch.no_grad():
        for parameter in target.parameters():
            parameter.mul_(0.9)  # so that target and critic differ
    sizes = spec.resolutions * 2
    generator = torch.Generator().manual_seed(5)
    noises = [torch.randn(6, 2, r, r, generator=generator, dtype=torch.float64) for r in sizes]
    queue = iter(noises)
    monkeypatch.setattr("cfp.sac.learner.MAX_GRAD_NORM", LIMIT)
    monkeypatch.setattr(torch, "randn_like", lambda mean: next(queue).to(mean))

    weights, values, targets = doubles(actor, True), doubles(critic, True), doubles(target, False)
    obs, next_obs = (image.double() / 255 * 2 - 1 for image in (batch.observations, batch.next_observations))
    mean, variance = 0.01 * batch.rewards.double().mean(), 0.99 + 0.01 * batch.rewards.double().var()
    reward = (batch.rewards.double() - mean) / (variance.sqrt() + 1e-8)
    source = iter(noises)
    action, density, _ = act(weights, next_obs, source, spec)
    smaller = torch.minimum(*q_values(targets, next_obs, action, aligned))
    wanted = (reward + (1 - batch.dones.double()) * GAMMA * (smaller - ALPHA * density[:, None])).detach()
    stored = batch.actions.double().view(-1, 2, resolution, resolution)
    critic_loss = sum(((value - wanted) ** 2).mean() for value in q_values(values, obs, stored, aligned))
    critic_gradients = dict(zip(values, torch.autograd.grad(critic_loss, list(values.values())), strict=True))

    scalars = model.update(batch)

    assert scalars["critic_loss"].item() == pytest.approx(critic_loss.item(), rel=1e-4)
    assert scalars["q_target"].item() == pytest.approx(wanted.mean().item(), rel=1e-4)
    assert scalars["reward_mean"].item() == pytest.approx(mean.item(), rel=1e-5)
    assert scalars["reward_std"].item() == pytest.approx(variance.sqrt().item(), rel=1e-5)
    compare_gradients(critic, critic_gradients)

    # The actor sees the critics after their step.
    action, density, gate = act(weights, obs, source, spec)
    smaller = torch.minimum(*q_values(doubles(critic, False), obs, action, aligned))
    actor_loss = (ALPHA * density[:, None] - smaller).mean()
    if residual:
        actor_loss = actor_loss + RHO * gate.flatten(1).norm(dim=1).mean() / 16
    own = {name: weights[name] for name, parameter in actor.named_parameters() if parameter.requires_grad}
    actor_gradients = dict(zip(own, torch.autograd.grad(actor_loss, list(own.values())), strict=True))
    assert scalars["actor_loss"].item() == pytest.approx(actor_loss.item(), rel=1e-4)
    assert scalars["entropy"].item() == pytest.approx(-density.mean().item(), rel=1e-4)
    compare_gradients(actor, actor_gradients)
    assert all(f"train/{name}" in METRICS for name in scalars)

    # Polyak: a quarter of the way to the critics after their step.
    for name, value in target.state_dict().items():
        moved = 0.75 * targets[name] + 0.25 * critic.state_dict()[name].double()
        torch.testing.assert_close(value.double(), moved, rtol=1e-5, atol=1e-7)


def compare_gradients(module, expected):
    """Gradients after clipping each tensor to LIMIT."""
    clipped = 0
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            continue
        norm = expected[name].norm()
        clipped += int(norm > LIMIT)
        wanted = expected[name] * min(1.0, LIMIT / (norm.item() + 1e-6))
        torch.testing.assert_close(parameter.grad.double(), wanted, rtol=2e-3, atol=1e-5 * LIMIT)
    assert clipped > 0  # the limit was felt


def test_random_phase_and_start_of_updates_are_two_settings():
    env = FakeEnv(num_envs=2, horizon=5)
    model = make_model(ActorSpec((8,)), env, random_steps=20, update_start=12)
    updates = {}
    train = model.train
    model.train = lambda gradient_steps, batch_size: (
        updates.setdefault(model.num_timesteps, model.replay_buffer.size() * 2),
        train(gradient_steps, batch_size),
    )
    with torch.no_grad():  # a policy that can be told from uniform noise
        model.networks()[0].mean[-1].bias.fill_(50.0)
    model.learn(32)
    spread = [float((action.abs() > 0.999).float().mean()) for action in env.actions]
    assert max(spread[:10]) < 0.1
    assert min(spread[10:]) > 0.9
    assert updates[14] == 14
    assert min(updates) == 14  # more than 12 are stored


@pytest.mark.parametrize(
    "spec",
    [
        ActorSpec((8, 16), (0.0,), patch=64),
        ActorSpec((4, 8, 16, 32), (0.0,) * 3, patch=64),
        ActorSpec((4, 8), (0.0,), patch=8, encoder="small"),
    ],
)
def test_batch_holds_the_actions_that_were_executed(spec):
    env = FakeEnv(num_envs=2, resolution=spec.patch)
    model = make_model(spec, env, random_steps=4, update_start=100)
    model.learn(12)
    executed = {tuple(action.flatten()[:9].tolist()): action for action in torch.stack(env.actions).flatten(0, 1)}
    drawn = model.replay_buffer.sample(12).actions
    keys = torch.tensor(list(executed))
    for action in drawn:
        nearest = (keys - action[:9]).abs().sum(1).argmin()
        torch.testing.assert_close(action, list(executed.values())[nearest].flatten(), rtol=0, atol=2e-6)
    assert len({tuple(action[:9].tolist()) for action in drawn}) == 12
    spread = [float(action.abs().max()) for action in env.actions]
    assert min(spread) > 0.1


@pytest.mark.parametrize("spec", [ActorSpec((8,)), ActorSpec((8, 16), (0.0,), patch=64)])
def test_actor_that_has_diverged_does_not_act(spec):
    model = make_model(spec, FakeEnv(num_envs=2, resolution=spec.action_size), random_steps=4, update_start=99)
    model.learn(4)
    taken = len(model.env.venv.torch_env.actions)
    with torch.no_grad():
        model.networks()[0].trainable_parameters()[-1].fill_(torch.nan)
    with pytest.raises(NonFiniteError, match="action of environment 0 is not finite at step 4"):
        model.learn(4, reset_num_timesteps=False)
    assert len(model.env.venv.torch_env.actions) == taken
    with pytest.raises(NonFiniteError, match="the policy has diverged"):  # such as in an evaluation
        model.env.step(model.predict(model.env.reset())[0])


def test_reward_that_is_not_finite_is_never_stored():
    model = make_model(ActorSpec((8,)), FakeEnv(num_envs=2, horizon=9, faults={3: "reward"}))
    with pytest.raises(NonFiniteError, match="returned NaN or an infinite number for near"):
        model.learn(20)
    assert model.replay_buffer.size() == 2
    assert np.isfinite(model.replay_buffer.rewards).all()


def test_gradient_that_is_not_finite_changes_no_weight():
    model = make_model(ActorSpec((8,)))
    _, critic, _ = model.networks()
    before = {name: value.clone() for name, value in critic.state_dict().items()}
    next(critic.parameters()).register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(NonFiniteError, match=r"critic loss \d.* or its gradient is not finite"):
        model.update(make_batch(8))
    assert all(torch.equal(value, before[name]) for name, value in critic.state_dict().items())


def test_options_of_stable_baselines3_are_not_given_twice():
    for option in ("learning_rate", "gamma", "target_update_interval", "action_noise", "replay_buffer_class"):
        with pytest.raises(TypeError, match=f"multiple values .*{option}"):
            make_model(ActorSpec((8,)), sac_options={option: 3})
    with pytest.raises(TypeError, match="n_steps must be one of the hyperparameters, got 3"):
        make_model(ActorSpec((8,)), sac_options={"n_steps": 3})
    for changes, named in (
        ({"noise_cells": 3}, "noise_cells"),
        ({"noise_cells": 16}, "noise_cells"),
        ({"alpha": -1.0}, "alpha"),
        ({"sac_options": {"use_sde": True}}, "use_sde"),
        ({"env": FakeEnv(num_envs=1, resolution=16)}, "action_space"),
    ):
        with pytest.raises((ConfigError, ValueError), match=f"{named} must"):
            make_model(ActorSpec((8,)), **changes)


def sums_ahead():
    """A learner with sums of three steps, and fifteen rows in a ring of ten."""
    env = FakeEnv(num_envs=3, resolution=4, horizon=4, end_above=0.203)
    options = {"n_steps": 3, "gamma": 0.5, "buffer_size": 30, "batch_size": 4, "update_start": 100}
    model = make_model(ActorSpec((4,)), env, random_steps=100, **options)
    model.learn(45)
    return model


def test_steps_ahead_are_summed_until_the_episode_or_the_memory_ends():
    model = sums_ahead()
    buffer, gamma = model.replay_buffer, 0.5
    assert buffer.full
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


def test_sums_end_where_another_learn_begins_with_a_reset():
    env, options = FakeEnv(num_envs=2, resolution=4, horizon=9), {"n_steps": 3, "gamma": 0.5, "update_start": 100}
    model = make_model(ActorSpec((4,)), env, random_steps=100, **options)
    model.learn(8)
    model.learn(8)  # which resets the environment
    buffer = model.replay_buffer
    buffer.rewards[4:] = 1e6  # of the episodes after the reset
    sums, last, discounts = buffer._look_ahead(np.arange(8))
    assert sums.max() < 10 and last.max() < 8
    assert discounts.tolist() == [0.125] * 4 + [0.25] * 2 + [0.5] * 2
    assert not (buffer.dones * (1 - buffer.timeouts)).any()  # what follows is valued


def test_sums_that_end_early_are_normalised_like_whole_ones(monkeypatch):
    model, seen = sums_ahead(), []
    model.replay_buffer.rewards[:] = 2.0
    model.reward_statistics.mean.fill_(2.0 * (1 + 0.5 + 0.25))

    def target(actor, critic, observation, rewards, *others):
        seen.append(rewards)
        return critic_target(actor, critic, observation, rewards, *others)

    monkeypatch.setattr("cfp.sac.learner.critic_target", target)
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
    assert longest == LONGEST_HOLD - 1


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


@pytest.mark.parametrize("spec", SMALL.values(), ids=SMALL)
def test_the_critics_alone_train_the_shared_encoder(spec):
    size = spec.action_size
    model = make_model(spec, FakeEnv(num_envs=2, resolution=size))
    actor, critic, _ = model.networks()
    encoder = list(actor.encoder.parameters())
    owners = [optimizer.param_groups[0]["params"] for optimizer in (actor.optimizer, critic.optimizer)]
    assert [any(each is encoder[0] for each in owned) for owned in owners] == [False, True]
    before = [parameter.clone() for parameter in encoder]
    model.update(make_batch(size))
    assert not any(map(torch.equal, before, encoder))
    coarse = [name for name, _ in actor.named_parameters() if name.startswith("coarse.")]
    assert bool(coarse) == (len(spec.resolutions) > 1)
    assert all(not actor.get_parameter(name).requires_grad for name in coarse)


def test_encoder_of_a_refined_policy_stays():
    model = make_model(SMALL["plain"], FakeEnv(num_envs=2, resolution=8))
    actor = model.networks()[0]
    model.trains_encoder = False
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    model.update(make_batch(8))
    same = {name: torch.equal(value, before[name]) for name, value in actor.state_dict().items()}
    assert all(same[name] for name in same if name.startswith("encoder."))
    assert not any(same[name] for name in same if name.startswith("mean."))


def test_average_of_weights_is_the_policy():
    model = make_model(SMALL["plain"], FakeEnv(num_envs=2, resolution=8), weight_average=0.9)
    expected = {name: value.clone() for name, value in model.networks()[0].state_dict().items()}
    for _ in range(3):
        model.update(make_batch(8))
        for name, value in model.networks()[0].state_dict().items():
            expected[name] = 0.9 * expected[name] + 0.1 * value
    averaged = model.trained_actor.state_dict()
    assert all(torch.allclose(averaged[name], value, atol=1e-7) for name, value in expected.items())
    assert not torch.equal(averaged["mean.0.weight"], model.networks()[0].state_dict()["mean.0.weight"])
    model.restart_average()
    assert torch.equal(model.trained_actor.state_dict()["mean.0.weight"], model.networks()[0].mean[0].weight)


@pytest.mark.parametrize("patch", [18, 32])
def test_small_critics_take_actions_composed_on_the_grid_of_the_stage(patch):
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


def test_larger_actions_are_averaged_over_the_cells_of_the_grid():
    critics, on_grid = SmallCritics(8), torch.randn(3, 2, 8, 8)
    encoded = critics.actions(on_grid)
    torch.testing.assert_close(critics.actions(F.interpolate(on_grid, size=64)), encoded)


def test_layers_of_small_critics_bound_the_values_of_inputs_never_seen():
    critics, image, features = SmallCritics(8), torch.zeros(3, 3, 32, 32), torch.randn(3, 16, 4, 4)
    actions = torch.randn(3, 2, 8, 8)
    large, larger = (critics(Encoded(image, scale * features), scale * actions) for scale in (1e3, 1e4))
    for one, other in zip(large, larger, strict=True):
        torch.testing.assert_close(one, other, rtol=0.1, atol=0.01)


def test_actor_starts_after_the_critics_and_rates_fall():
    options = {"update_start": 4, "batch_size": 4, "actor_start": 10, "final_rate": 0.1}
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
    assert rates[-1] == pytest.approx([3e-5, 3e-5], rel=1e-6)
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize(("taken", "goes_on"), [(8, False), (14, True)])
def test_actor_that_learns_goes_on_to_learn_in_a_prolonged_stage(taken, goes_on):
    options = {"update_start": 4, "batch_size": 4}
    model = make_model(ActorSpec((8,)), **options, actor_start=10)
    model.learn(taken)
    prolonged = make_model(ActorSpec((8,)), **options, actor_start=100)
    prolonged.load_state_dict(model.state_dict())
    prolonged.num_timesteps = taken
    weight = prolonged.networks()[0].mean[0].weight
    before = weight.clone()
    prolonged.learn(6, reset_num_timesteps=False)
    assert torch.equal(weight, before) != goes_on
