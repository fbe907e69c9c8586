"""Short-horizon actor-critic, on robots of a few hundred particles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from policy_files import save_actor
from updates import EachUpdate

import baselines
from baselines import Shac, StatePolicy
from baselines.registry import configure
from baselines.shac import train as shac_train
from baselines.shac.train import METRICS
from cfp.agent.actor import ActorSpec, build_actor
from cfp.analytic import window as analytic_window
from cfp.analytic.reward import RewardConfig
from cfp.analytic.window import Window, short_horizon_loss, td_lambda_targets
from cfp.envs.make import make_env
from cfp.errors import CheckpointError, ConfigError, NonFiniteError
from cfp.evaluation.returns import attached, evaluate, make_trial
from cfp.evaluation.video import record_policy
from cfp.policy import describe_run
from cfp.sections import EnvironmentConfig
from dittogym import TorchEnv


def make(task="run", **changes):
    environment = EnvironmentConfig(changes.pop("num_envs", 2), 300, changes.pop("substeps", 4))
    defaults = {"environment": environment, "train_particles": 300, "device": "cpu", "window": 4, "critic_updates": 2}
    return replace(Shac.preset(task, "quick"), **defaults | changes)


def parameters(algorithm):
    return torch.nn.utils.parameters_to_vector(algorithm.actor.parameters()).detach().clone()


def test_trains_with_longer_substeps_and_is_evaluated_with_the_tasks_own():
    config = make(environment=EnvironmentConfig(2, 100), train_particles=100)
    algorithm = Shac(config)
    assert algorithm.env.model.solver.dt == 2e-4 and algorithm.env.model.substeps == 50
    assert make_env(config, 8, 1).venv.torch_env.model.solver.dt == 1e-4
    with pytest.raises(ConfigError, match=r"dt must be at most .*, got 0\.0002"):
        Shac(replace(config, task="dig", train_dt=2e-4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": 0}, "window must be at least 1, got 0"),
        ({"gamma": 1.5}, "gamma must be between 0 and 1, got 1.5"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"reward": RewardConfig(split_margin=-0.5)}, "split_margin must be at least 0, got -0.5"),
    ],
)
def test_impossible_options_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes).check()


def test_training_makes_the_robot_run():
    config = make(
        substeps=100, window=16, steps=480, max_episode_steps=32, learning_rate=1e-2, noise=0.0, train_particles=500
    )
    algorithm, rows = Shac(config), []
    before = speed(algorithm)
    algorithm.learn(config.steps, EachUpdate(rows.append))
    assert len(rows) == 15 and algorithm.num_timesteps == 480
    assert set(rows[0]) == set(METRICS)
    early, late = (np.mean([row["train/reward"] for row in part]) for part in (rows[:5], rows[-5:]))
    assert late > early + 0.8
    assert speed(algorithm) > before + 0.02


@torch.no_grad()
def speed(algorithm, steps=32):
    """Mean velocity to the right, m/s, of the policy without noise on a layout of its own."""
    env = TorchEnv("run", 1, particles=500)
    env.reset(seed=99)
    policy, start = algorithm.policy.attached(env), env.env_state.centre[0, 0].item()
    for _ in range(steps):
        action, _ = policy.predict(np.zeros((1, 3, 64, 64), np.uint8), deterministic=True)
        env.step(torch.as_tensor(action))
    return (env.env_state.centre[0, 0].item() - start) / (steps * 0.01)


@pytest.mark.parametrize("sees", ["state", "image"])
def test_gradient_of_the_window_is_that_of_the_loss(sees):
    environment = EnvironmentConfig(2, 300, 4, dtype="float64")
    algorithm = Shac(make(environment=environment, sees=sees, noise=0.0))
    algorithm.actor.double(), algorithm.critic.target.double()
    env = algorithm.env
    inputs = {"state": lambda: algorithm.features(env), "image": lambda: env.soft_observation() * (2.0 / 255.0) - 1.0}
    algorithm.collector.observe = inputs[sees]
    weight = [p for p in algorithm.actor.parameters() if p.requires_grad][-1]
    start = algorithm.env.save()

    def loss():
        algorithm.env.load(start)
        return short_horizon_loss(collect(algorithm), algorithm.config.gamma)

    (gradient,) = torch.autograd.grad(loss(), weight)
    index = tuple(int(i) for i in np.unravel_index(int(gradient.abs().argmax()), gradient.shape))
    losses = []
    for sign in (1, -2, 1):
        weight.data[index] += sign * 1e-4
        losses.append(loss().item())
    assert gradient[index].item() == pytest.approx((losses[0] - losses[1]) / 2e-4, rel=1e-3)


def collect(algorithm):
    return algorithm.collector.collect(algorithm.act, algorithm.critic)


@pytest.mark.parametrize("sees", ["state", "image"])
def test_resumed_training_is_the_same_to_the_last_bit(sees):
    config = make(sees=sees, max_episode_steps=6)
    whole, first, second = Shac(config), Shac(config), Shac(config)
    whole.learn(48)
    first.learn(24)
    second.load_state_dict(first.state_dict())
    second.num_timesteps = first.num_timesteps
    rows = []
    second.learn(24, EachUpdate(rows.append))
    assert torch.equal(parameters(whole), parameters(second))
    assert torch.equal(whole.env.state.x, second.env.state.x)
    assert rows[-1]["train/episodes"] == whole.collector.episodes.counts["episodes"] > 0


def test_simulation_that_is_not_finite_is_reset_and_counted(monkeypatch):
    algorithm = Shac(make(num_envs=3))
    algorithm.learn(12)
    env, calls, step = algorithm.env, [], algorithm.env.step

    def spoil_the_second(action, *, soft):
        calls.append(action)
        if len(calls) == 2:
            v = env.state.v.clone()
            v[1, 5] = float("nan")
            env.env_state = replace(env.env_state, particles=replace(env.state, v=v))
        return step(action, soft=soft)

    monkeypatch.setattr(env, "step", spoil_the_second)
    before, rows = parameters(algorithm), []
    algorithm.learn(12, EachUpdate(rows.append))
    assert rows[0]["train/nonfinite"] == rows[0]["train/terminated"] == 1 and rows[0]["train/skipped"] == 0
    assert rows[0]["train/dropped"] == 0  # the environment keeps its neighbours' gradients clean
    assert env.state.x.isfinite().all()
    after = parameters(algorithm)
    assert after.isfinite().all() and not torch.equal(before, after)


def test_gradients_of_single_actions_that_are_not_finite_are_left_out_and_counted(monkeypatch):
    algorithm = Shac(make(num_envs=3))
    step = algorithm.env.step

    def slope_without_end(action, *, soft):
        same = action.clone()
        same[1] += (0.0 * action[1].sum()).sqrt()
        return step(same, soft=soft)

    monkeypatch.setattr(algorithm.env, "step", slope_without_end)
    before, rows = parameters(algorithm), []
    algorithm.learn(12, EachUpdate(rows.append))
    assert rows[0]["train/dropped"] == 4 and rows[0]["train/skipped"] == 0
    after = parameters(algorithm)
    assert after.isfinite().all() and not torch.equal(before, after)


def test_updates_without_a_finite_gradient_end_the_training(monkeypatch):
    algorithm = Shac(make())
    before, rows = parameters(algorithm), []
    weight = next(algorithm.actor.parameters())
    monkeypatch.setattr(shac_train, "short_horizon_loss", lambda window, gamma: weight.sum() * float("nan"))
    with pytest.raises(NonFiniteError, match="10 updates in a row"):
        algorithm.learn(8 * 20, EachUpdate(rows.append))
    assert rows[-1]["train/skipped"] == 9 and torch.equal(before, parameters(algorithm))


def test_actor_that_has_diverged_does_not_act():
    algorithm = Shac(make())
    with torch.no_grad():
        next(algorithm.actor.parameters()).fill_(torch.nan)
    with pytest.raises(NonFiniteError, match="the actor's actions became NaN"):
        algorithm.learn(8)


def test_episodes_are_cut_at_staggered_ages_and_change_layouts():
    algorithm = Shac(make(max_episode_steps=8, num_layouts=3))
    first = algorithm.env.state.x[0].clone()
    assert algorithm.collector.episodes.limit.tolist() == [4, 8]
    collect(algorithm)
    assert algorithm.collector.episodes.counts["episodes"] == 1 and algorithm.collector.episodes.limit.tolist() == [
        8,
        8,
    ]
    assert algorithm.env.env_state.steps.tolist() == [0, 4]
    assert not torch.equal(algorithm.env.state.x[0], first)


def test_no_more_layouts_are_trained_on_than_there_shall_be():
    algorithm = Shac(make(num_envs=3, num_layouts=2))
    x = algorithm.env.state.x
    assert torch.equal(x[0], x[2]) and not torch.equal(x[0], x[1])


def test_restart_of_a_neighbour_leaves_the_particles_that_were_close(monkeypatch):
    algorithm, seen, reward = (
        Shac(make(max_episode_steps=8, window=6, substeps=20)),
        [],
        analytic_window.training_reward,
    )

    def watch(*given):
        seen.append(given[-1])
        return reward(*given)

    monkeypatch.setattr(analytic_window, "training_reward", watch)
    collect(algorithm)
    assert algorithm.env.env_state.steps.tolist() == [2, 6]  # the first robot began anew after four steps
    for first, last in zip(*((pairs.neighbours, pairs.distance) for pairs in (seen[0], seen[-1])), strict=True):
        assert torch.equal(first[1], last[1]) and not torch.equal(first[0], last[0])


def test_return_is_that_of_all_episodes_since_the_last_row():
    algorithm, rows = Shac(make(max_episode_steps=4)), []  # a window is as long as an episode
    algorithm.learn(8, EachUpdate(rows.append))
    first = list(algorithm.collector.episodes.recent_returns)
    again = Shac(algorithm.config)
    again.load_state_dict(algorithm.state_dict())
    for each in (algorithm, again):
        each.learn(8, EachUpdate(rows.append))
        ended = each.collector.episodes.recent_returns
        assert len(ended) > len(first) > 0 and ended[: len(first)] == first
        assert rows[-1]["rollout/return"] == np.mean(ended)
    algorithm.row()
    algorithm.learn(8, EachUpdate(rows.append))
    assert len(algorithm.collector.episodes.recent_returns) < len(ended)


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


@pytest.mark.parametrize("sees", ["state", "image"])
def test_policy_goes_through_its_file(sees, tmp_path):
    algorithm = Shac(make("shapematch", sees=sees, grid=8))
    algorithm.learn(8)
    path = tmp_path / "policy.safetensors"
    algorithm.save_policy(path, describe_run(algorithm.config, "shac", 1, 8))
    policy = baselines.load(path)
    assert policy.description["sees"] == sees and policy.resolution == 8
    env = make_env(algorithm.config, 8, 2)
    images = env.reset()
    actions = [attached(each, env).predict(images, deterministic=True)[0] for each in (algorithm.policy, policy)]
    assert np.array_equal(*actions) and np.abs(actions[0]).max() > 0
    options = {"deterministic": False, "seed": 3}
    results = evaluate([make_trial(algorithm.config, "", each, 2, **options) for each in (algorithm.policy, policy)])
    assert results[0] == results[1]
    assert len(record_policy(algorithm.config, policy).shots) == 31


def test_actor_on_the_image_begins_with_a_policy_of_any_algorithm(tmp_path):
    config = make(sees="image")
    actor, path = build_actor(ActorSpec((config.resolution(1),))), tmp_path / "policy.safetensors"
    trained = configure({"algo": "coarse", "task": "run", "network": {"encoder": "paper"}})
    origins = replace(trained, environment=config.environment, resolutions=(config.resolution(1),))
    save_actor(path, actor, origins, 1, 5)
    warm = replace(config, start_from=str(path))
    Shac.initialize(warm, tmp_path)
    path.unlink()  # the run has its own copy
    algorithm = Shac.create(warm, 1, tmp_path)
    assert algorithm.starts_trained and not Shac.create(config, 1, tmp_path).starts_trained
    for name, value in actor.state_dict().items():
        if not name.startswith("std."):
            assert torch.equal(algorithm.actor.actor.state_dict()[name], value), name
    images = torch.randint(0, 256, (40, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    torch.manual_seed(0)
    spread = torch.stack([algorithm.policy(images).atanh() for _ in range(30)]).std(0).mean()
    assert spread == pytest.approx(0.105, rel=0.05)  # not that of the policy, which nothing would change any more
    with pytest.raises(ConfigError, match=r"start_from.*kick"):
        Shac.initialize(replace(warm, task="kick", start_from="run"), tmp_path)
    with pytest.raises(ConfigError, match=r"start_from.*sees"):
        replace(warm, sees="state").check()


def test_policy_of_the_state_says_what_it_needs(tmp_path):
    algorithm = Shac(make())
    with pytest.raises(ValueError, match="got 'kick'"):
        algorithm.policy.attached(TorchEnv("kick", 1, particles=100))
    path = tmp_path / "policy.safetensors"
    algorithm.save_policy(path, describe_run(algorithm.config, "shac", 1, 0))
    path.write_bytes(path.read_bytes().replace(b"inputs", b"outputs"[:6]))
    with pytest.raises(CheckpointError):
        StatePolicy.load(path)
