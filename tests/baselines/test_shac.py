"""Short-horizon actor-critic, on robots of a few hundred particles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from watching import learn

import baselines
import baselines.shac
from baselines import Shac, StatePolicy
from baselines.shac import METRICS, StateActor
from cfp.analytic.critic import StateFeatures
from cfp.analytic.window import Window, short_horizon_loss, td_lambda_targets
from cfp.envs.make import make_env, make_torch_env
from cfp.errors import CheckpointError, NonFiniteError
from cfp.evaluation.returns import evaluate, make_trial
from cfp.policy import describe_run
from dittogym import Env, TorchEnv
from dittogym.render.recording import attached


def options(task="run", **changes):
    defaults = {"num_envs": 2, "particles": 300, "substeps": 4, "train_dt": None, "train_particles": 300}
    defaults |= {"device": "cpu", "window": 4, "critic_updates": 2}
    return replace(Shac.preset(task, "quick"), **defaults | changes)


def make(task="run", **changes):
    config = options(task, **changes)
    return Shac("NetworksPolicy", make_env(config.for_training(), config.resolution(1)), config, device="cpu")


def parameters(learner):
    return torch.nn.utils.parameters_to_vector(learner.actor.parameters()).detach().clone()


@pytest.mark.slow
def test_training_makes_the_robot_run():
    learner = make(
        substeps=100, window=16, steps=480, max_episode_steps=32, learning_rate=1e-2, noise=0.0, train_particles=500
    )
    before, rows = speed(learner), learn(learner, 480)
    assert len(rows) == 15 and learner.num_timesteps == 480 and set(rows[0]) >= set(METRICS)
    early, late = (np.mean([row["train/reward"] for row in part]) for part in (rows[:5], rows[-5:]))
    assert late > early + 0.8 and speed(learner) > before + 0.02


@torch.no_grad()
def speed(learner, steps=32):
    """Mean velocity to the right, m/s, of the policy without noise on a layout of its own."""
    env = TorchEnv("run", 1, particles=500)
    env.reset(seed=99)
    policy, start = learner.trained_policy.attached(env), env.env_state.centre[0, 0].item()
    for _ in range(steps):
        env.step(torch.as_tensor(policy.predict(np.zeros((1, 3, 64, 64), np.uint8), deterministic=True)[0]))
    return (env.env_state.centre[0, 0].item() - start) / (steps * 0.01)


def test_gradient_of_the_window_is_that_of_the_loss():
    learner = make(dtype="float64", noise=0.0)
    learner.actor.double(), learner.critic.target.double()
    env = learner.simulation
    learner.collector.observe = lambda: learner.features(env)
    weight, start = [*learner.actor.parameters()][-1], env.save()

    def loss():
        env.load(start)
        window = learner.collector.collect(learner.act, learner.critic, lambda done, infos: True)
        return short_horizon_loss(window, learner.config.gamma)

    (gradient,) = torch.autograd.grad(loss(), weight)
    index = tuple(int(i) for i in np.unravel_index(int(gradient.abs().argmax()), gradient.shape))
    losses = []
    for sign in (1, -2, 1):
        weight.data[index] += sign * 1e-4
        losses.append(loss().item())
    assert gradient[index].item() == pytest.approx((losses[0] - losses[1]) / 2e-4, rel=1e-3)


def test_simulation_that_is_not_finite_is_reset_and_counted(monkeypatch):
    learner, calls = make(num_envs=3), []
    env, step = learner.simulation, learner.simulation.step

    def spoil_the_second(action, *, soft):
        calls.append(action)
        if len(calls) == 2:
            v = env.state.v.clone()
            v[1, 5] = float("nan")
            env.env_state = replace(env.env_state, particles=replace(env.state, v=v))
        return step(action, soft=soft)

    monkeypatch.setattr(env, "step", spoil_the_second)
    before, row = parameters(learner), learn(learner, 12)[0]
    assert row["train/nonfinite"] == row["train/terminated"] == 1 and row["train/skipped"] == row["train/dropped"] == 0
    after = parameters(learner)
    assert env.state.x.isfinite().all() and after.isfinite().all() and not torch.equal(before, after)


def test_updates_without_a_finite_gradient_end_the_training(monkeypatch):
    learner = make()
    before, weight = parameters(learner), next(learner.actor.parameters())
    monkeypatch.setattr(baselines.shac, "short_horizon_loss", lambda window, gamma: weight.sum() * float("nan"))
    with pytest.raises(NonFiniteError, match="10 updates in a row"):
        learn(learner, 8 * 20)
    assert learner.skipped == 10 and torch.equal(before, parameters(learner))


def test_actor_that_has_diverged_does_not_act():
    learner = make()
    with torch.no_grad():
        next(learner.actor.parameters()).fill_(torch.nan)
    with pytest.raises(NonFiniteError, match="the policy has diverged"):
        learn(learner, 8)


def test_episodes_are_cut_at_staggered_ages_and_change_layouts():
    learner = make(max_episode_steps=8, num_layouts=3)
    env, episodes, first = learner.simulation, learner.collector.episodes, learner.simulation.state.x[0].clone()
    assert episodes.limit.tolist() == [4, 8]
    learn(learner, 8)
    assert episodes.counts["episodes"] == 1 and episodes.limit.tolist() == [8, 8]
    assert env.env_state.steps.tolist() == [0, 4] and not torch.equal(env.state.x[0], first)
    x = make(num_envs=3, num_layouts=2).simulation.state.x
    assert torch.equal(x[0], x[2]) and not torch.equal(x[0], x[1])


def window(done=(False, False, False)):
    """Three steps of one simulation, rewards 1, 2, 3 and values 4, 8, 16 after them."""
    rewards, values = (torch.tensor(numbers)[:, None] for numbers in ([1.0, 2.0, 3.0], [4.0, 8.0, 16.0]))
    return Window(torch.zeros(3, 1), rewards, values, torch.tensor(done)[:, None], 0.0)


def test_actor_loss_is_the_discounted_return_with_the_value_of_the_end():
    assert short_horizon_loss(window(), 0.5).item() == pytest.approx(-(1 + 0.5 * 2 + 0.25 * 3 + 0.125 * 16) / 3)
    cut = short_horizon_loss(window((False, True, False)), 0.5)
    assert cut.item() == pytest.approx(-(1 + 0.5 * 2 + 0.25 * 8 + 3 + 0.5 * 16) / 3)


def test_targets_are_those_of_td_lambda():
    last = 3 + 0.5 * 16
    middle = 2 + 0.5 * (0.75 * 8 + 0.25 * last)
    targets = td_lambda_targets(window(), 0.5, 0.25)
    assert targets.flatten().tolist() == pytest.approx([1 + 0.5 * (0.75 * 4 + 0.25 * middle), middle, last])
    assert td_lambda_targets(window((False, True, False)), 0.5, 0.25)[1].item() == 2 + 0.5 * 8


def test_policy_goes_through_its_file(tmp_path):
    learner, path = make("shapematch", grid=8), tmp_path / "policy.safetensors"
    learn(learner, 8)
    learner.save_policy(path, describe_run(learner.config, "shac", 1, 8))
    policies = learner.trained_policy, baselines.load(path)
    assert policies[1].description["kind"] == "shac" and policies[1].resolution == 8
    env = make_torch_env(learner.config, 8, 2)
    images = env.reset()[0].numpy()
    actions = [attached(each, env).predict(images, deterministic=True)[0] for each in policies]
    assert np.array_equal(*actions) and np.abs(actions[0]).max() > 0
    trials = [make_trial(learner.config, "", each, 2, deterministic=False, seed=3) for each in policies]
    results = evaluate(trials, 30)
    assert results[0] == results[1]


def test_algorithm_acts_on_the_state_of_its_own_simulation(tmp_path):
    learner = make("shapematch", grid=8, num_envs=2)
    images = learner.simulation.observation().numpy()
    wanted = learner.trained_policy.attached(learner.simulation).predict(images, deterministic=True)[0]
    assert np.array_equal(learner.predict(images, deterministic=True)[0], wanted)
    learner.save(tmp_path / "model.zip")
    with pytest.raises(RuntimeError, match=r"call attached\(env\) first"):
        Shac.load(tmp_path / "model.zip").predict(images)


@pytest.mark.parametrize("left_out", ["deformation", "clock"])
def test_files_of_policies_that_observe_less_load(tmp_path, left_out):
    """Options for which there was no use once trained such policies."""
    config, features = options(), StateFeatures(**{left_out: False})
    StatePolicy(StateActor(features.size(0), 8), features, 0.1, describe_run(config, "shac", 1, 0)).save(
        tmp_path / "policy.safetensors"
    )
    env = make_torch_env(config, 8, 2)
    images = env.reset()[0].numpy()
    assert baselines.load(tmp_path).attached(env).predict(images)[0].shape == (2, 2, 8, 8)


def test_policy_of_the_state_says_what_it_needs(tmp_path):
    learner, path = make(), tmp_path / "policy.safetensors"
    with pytest.raises(ValueError, match="got 'kick'"):
        learner.trained_policy.attached(TorchEnv("kick", 1, particles=100))
    with pytest.raises(TypeError, match="env must be of type TorchEnv, got"):
        learner.trained_policy.attached(Env("run", particles=100))
    learner.save_policy(path, describe_run(learner.config, "shac", 1, 0))
    path.write_bytes(path.read_bytes().replace(b"inputs", b"output"))
    with pytest.raises(CheckpointError):
        StatePolicy.load(path)
