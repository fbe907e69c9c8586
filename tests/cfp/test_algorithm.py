"""The update rule, against a hand-written float64 computation that shares no code with the networks."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from fakes import FakeEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.nn import functional as F

from cfp.agent.actor import ActorSpec
from cfp.agent.hyperparameters import Hyperparameters
from cfp.agent.policies import CFPPolicy
from cfp.agent.sac import CFP, METRICS
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError, NonFiniteError

ALPHA, RHO, GAMMA, LIMIT = 0.03, 0.7, 0.9, 0.05


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


def encode(weights, prefix, image):
    x = torch.cat([image, coordinates(len(image))], dim=1)
    for name, stride in (("first", 4), ("rest.1", 2), ("rest.3", 1)):
        x = F.elu(F.conv2d(x, weights[f"{prefix}.{name}.weight"], weights[f"{prefix}.{name}.bias"], stride=stride))
    return x


def decode(weights, prefix, latent, strides):
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


def act(weights, image, noises: Iterator[torch.Tensor], kind):
    """Action, log-density and gate of an 8x8 actor, or of an 8x8 -> 16x16 one, blended there or on the patch."""
    if kind == "plain":
        return *squash(weights, "", encode(weights, "encoder", image), (2, 1, 1), next(noises)), None
    coarse_latent = encode(weights, "coarse.encoder", image)
    coarse = squash(weights, "coarse.", coarse_latent, (2, 1, 1), next(noises))[0].detach()
    size, aligned = (16, True) if kind == "grid" else (64, False)
    coarse = lift(coarse, size, aligned)
    latent = encode(weights, "encoder.encoders.0", torch.cat([image, lift(coarse, 64, aligned)], dim=1))
    action, density = squash(weights, "", latent, (2, 2, 1), next(noises))
    gate = 1 / (1 + torch.exp(-decode(weights, "gate", latent, (2, 2, 1)) + 1.5))
    weight = lift(gate, size, aligned)
    return weight * lift(action, size, aligned) + (1 - weight) * coarse, density, gate


def q_values(weights, image, action, aligned):
    values = []
    for index in range(2):
        prefix = f"critics.{index}"
        x = encode(
            weights, f"{prefix}.encoder.encoders.0", torch.cat([image, lift(action, 64, aligned)], dim=1)
        ).flatten(1)
        for layer in (1, 3, 5):
            x = F.linear(x, weights[f"{prefix}.value.{layer}.weight"], weights[f"{prefix}.value.{layer}.bias"])
            x = F.elu(x) if layer < 5 else x
        values.append(x)
    return values


def doubles(module, grad):
    return {name: value.detach().double().requires_grad_(grad) for name, value in module.state_dict().items()}


KINDS = {
    "plain": ActorSpec((8,), interpolation="aligned"),
    "grid": ActorSpec((8, 16), (-1.5,), interpolation="aligned"),
    "patch": ActorSpec((8, 16), (-1.5,), patch=64),
}


@pytest.mark.parametrize("kind", KINDS)
def test_one_update_equals_the_float64_computation(kind, monkeypatch):
    spec, residual, aligned = KINDS[kind], kind != "plain", kind != "patch"
    resolution = spec.action_size
    env = FakeEnv(num_envs=2, resolution=resolution)
    model = make_model(spec, env, alpha=ALPHA, gate_penalty=RHO, gamma=GAMMA, max_grad_norm=LIMIT, tau=0.25)
    batch = make_batch(resolution)
    actor, critic, target = model.networks()
    with torch.no_grad():
        for parameter in target.parameters():
            parameter.mul_(0.9)  # so that target and critic differ
    sizes = [8, 16] * 2 if residual else [8, 8]
    generator = torch.Generator().manual_seed(5)
    noises = [torch.randn(6, 2, r, r, generator=generator, dtype=torch.float64) for r in sizes]
    queue = iter(noises)
    monkeypatch.setattr(torch.Tensor, "normal_", lambda noise, generator=None: noise.copy_(next(queue)))

    weights, values, targets = doubles(actor, True), doubles(critic, True), doubles(target, False)
    obs, next_obs = (image.double() / 255 * 2 - 1 for image in (batch.observations, batch.next_observations))
    mean, variance = 0.01 * batch.rewards.double().mean(), 0.99 + 0.01 * batch.rewards.double().var()
    reward = (batch.rewards.double() - mean) / (variance.sqrt() + 1e-8)
    source = iter(noises)
    action, density, _ = act(weights, next_obs, source, kind)
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
    action, density, gate = act(weights, obs, source, kind)
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


def test_stage_two_starts_with_uniform_fine_actions():
    env = FakeEnv(num_envs=2, resolution=16)
    model = make_model(ActorSpec((8, 16), (-100.0,)), env, random_steps=4)
    model.learn(4)
    actions = torch.stack(env.actions)
    assert actions.abs().max() <= 1
    assert actions.std() == pytest.approx(1 / math.sqrt(3), rel=0.05)
    neighbours = (actions[..., :-1] * actions[..., 1:]).mean()
    assert abs(neighbours) < 0.05  # no upsampled coarse action in them


@pytest.mark.parametrize("resolutions", [(8, 16), (4, 8, 16, 32)])
def test_batch_holds_the_actions_that_were_executed(resolutions):
    env = FakeEnv(num_envs=2, resolution=64)
    biases = (0.0,) * (len(resolutions) - 1)
    model = make_model(ActorSpec(resolutions, biases, patch=64), env, random_steps=4, update_start=100)
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


@pytest.mark.parametrize("resolutions", [(8,), (8, 16)])
def test_actor_that_has_diverged_does_not_act(resolutions):
    spec = ActorSpec(resolutions, (0.0,) * (len(resolutions) - 1), patch=64 if len(resolutions) > 1 else None)
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
    with pytest.raises(NonFiniteError, match="reward of environment 0 is not finite at step 6"):
        model.learn(20)
    assert model.replay_buffer.size() == 2
    assert np.isfinite(model.replay_buffer.rewards).all()


def test_loss_that_is_not_finite_changes_no_weight():
    model = make_model(ActorSpec((8,)))
    _, critic, _ = model.networks()
    before = {name: value.clone() for name, value in critic.state_dict().items()}
    batch = make_batch(8)
    with pytest.raises(NonFiniteError, match="critic loss nan or its gradient is not finite"):
        model.update(batch._replace(rewards=batch.rewards * float("nan")))
    assert all(torch.equal(value, before[name]) for name, value in critic.state_dict().items())


def test_gradient_that_is_not_finite_changes_no_weight():
    model = make_model(ActorSpec((8,)))
    _, critic, _ = model.networks()
    before = {name: value.clone() for name, value in critic.state_dict().items()}
    next(critic.parameters()).register_hook(lambda gradient: gradient * float("inf"))
    with pytest.raises(NonFiniteError, match=r"critic loss \d.* or its gradient is not finite"):
        model.update(make_batch(8))
    assert all(torch.equal(value, before[name]) for name, value in critic.state_dict().items())


def test_time_limit_bootstraps_and_termination_does_not():
    model = make_model(ActorSpec((8,)), FakeEnv(num_envs=2, horizon=3, end_above=0.05), random_steps=100)
    model.learn(6)
    buffer = model.replay_buffer
    ended = buffer.dones * (1 - buffer.timeouts)
    assert buffer.dones[:3, 0].tolist() == [0, 0, 1]
    assert not ended[:3, 0].any()
    assert ended[0, 1] == 1
    # The stored next observation is the episode's last, not the next one's first.
    assert buffer.next_observations[2, 0, 1].max() == 3


def test_saved_archive_of_the_base_library_keeps_everything(tmp_path):
    model = make_model(ActorSpec((8,)), update_start=4, weight_average=0.9)
    model.learn(12)
    model.save(tmp_path / "model.zip")
    again = CFP.load(tmp_path / "model.zip", device="cpu")
    averaged = again.trained_actor.state_dict()
    assert all(torch.equal(averaged[name], value) for name, value in model.trained_actor.state_dict().items())
    assert torch.equal(again.reward_statistics.mean, model.reward_statistics.mean)
    for name, value in model.policy.state_dict().items():
        assert torch.equal(again.policy.state_dict()[name], value)


def test_hyperparameters_are_checked_and_not_given_twice():
    with pytest.raises(TypeError, match="CFP takes gamma, learning_rate from hyperparameters"):
        make_model(ActorSpec((8,)), sac_options={"learning_rate": 1e-3, "gamma": 0.9})
    with pytest.raises(ConfigError, match="noise_cells must be one of"):
        make_model(ActorSpec((8,)), noise_cells=3)
    with pytest.raises(ConfigError, match="noise_cells must be at most 8, the action grid, got 16"):
        make_model(ActorSpec((8,)), noise_cells=16)
    model = make_model(ActorSpec((8,)), sac_options={"replay_buffer_kwargs": {"seed": 3}}, n_steps=3)
    assert model.replay_buffer.n_steps == 3


def test_wrong_action_grid_is_refused():
    with pytest.raises(ValueError, match="action_space must have shape"):
        make_model(ActorSpec((16,)), FakeEnv(num_envs=1, resolution=8))
    with pytest.raises(ValueError, match="use_sde"):
        make_model(ActorSpec((8,)), sac_options={"use_sde": True})


@pytest.mark.parametrize("option", ["target_update_interval", "target_entropy", "action_noise", "replay_buffer_class"])
def test_options_of_sac_that_are_not_used_are_refused(option):
    with pytest.raises(TypeError, match=f"CFP does not use {option}"):
        CFP("CFPPolicy", FakeEnv(num_envs=1, resolution=8), **{option: 3})


def test_hyperparameters_of_a_stage_are_checked():
    with pytest.raises(ConfigError, match="alpha must be at least 0, got -1"):
        CFP("CFPPolicy", FakeEnv(num_envs=1), Hyperparameters(alpha=-1.0))
