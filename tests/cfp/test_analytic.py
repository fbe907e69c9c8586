"""The learner `analytic`, on robots of a few hundred particles."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import cfp
import dittogym
from cfp.agent.actor import ActorSpec, build_actor
from cfp.analytic.action_step import ActionStep
from cfp.analytic.config import WindowConfig
from cfp.analytic.learner import METRICS, AnalyticLearner
from cfp.analytic.regression import ImageMemory, Regression
from cfp.analytic.reward import RewardConfig
from cfp.analytic.window import WindowCollector, reward_warnings
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.folder import policy_path
from cfp.policy import describe_run
from cfp.sections import EnvironmentConfig
from dittogym.rewards import Reward


def make(task="run", stages=1, **changes):
    environment = EnvironmentConfig(changes.pop("num_envs", 2), 300, changes.pop("substeps", 4))
    grids = (4, 8)[:stages]
    defaults = {"resolutions": grids, "handover": (48,)[: stages - 1], "gate_bias": (-1.0,)[: stages - 1], "steps": 96}
    defaults |= {"action_step": (0.1, 0.1)[:stages], "environment": environment, "train_particles": 300}
    defaults |= {"device": "cpu", "window": 4, "minibatches": 4, "minibatch_size": 8, "windows_kept": 3, "warmup": 0}
    return replace(cfp.preset(task, "quick", "analytic"), **defaults | changes)


def counting(transition, spec):
    return Reward({"far": (transition.now.com[:, 0] > transition.start.com[:, 0]).float()})


def test_a_reward_without_gradient_is_noticed(monkeypatch):
    spec = replace(dittogym.make_spec("run"), name="count", reward_fn=counting, weights={"far": 1.0, "action": 1e-4})
    monkeypatch.setitem(dittogym.TASKS, "count", lambda: spec)
    config = make(reward=RewardConfig("task"))
    assert reward_warnings(config) == []
    assert reward_warnings(replace(config, environment=replace(config.environment, dtype="float64"))) == []
    assert "the reward of count has no gradient in the actions" in reward_warnings(replace(config, task="count"))[0]


def without_derivative(transition, spec):
    x = transition.now.com[:, 0]
    return Reward({"far": (x - x.detach()).square().sqrt()})  # 0, and its derivative is NaN


def test_gradients_that_are_never_finite_end_the_training(monkeypatch):
    spec = replace(dittogym.make_spec("run"), name="nan", reward_fn=without_derivative, weights={"far": 1.0})
    monkeypatch.setitem(dittogym.TASKS, "nan", lambda: spec)
    config = replace(make(reward=RewardConfig("task")), task="nan")
    learner = AnalyticLearner(config, 1, build_actor(config.actor_spec(1)))
    for _ in range(9):
        with pytest.warns(UserWarning, match="most gradients of a window are not finite"):
            learner.update()
    with pytest.raises(NonFiniteError, match="all gradients of 10 windows in a row are NaN, infinite or 0; a term of"):
        learner.update()


def test_can_train_with_longer_substeps_than_it_is_evaluated_with():
    config = make(train_dt=2e-4)
    for changed, expected in ((config, (2e-4, 2)), (replace(config, train_dt=None), (1e-4, 4))):
        model = AnalyticLearner(changed, 1, build_actor(changed.actor_spec(1))).env.model
        assert (model.solver.dt, model.substeps) == expected


def parameters(module):
    return torch.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


def test_quick_learns_by_gradients_and_paper_from_rewards():
    assert cfp.preset("run").learner == "analytic" and cfp.preset("run", "paper").learner == "sac"
    assert cfp.preset("run", "quick", "sac").learner == "sac"
    with pytest.raises(ConfigError, match="preset must be quick for learner analytic, got 'paper'"):
        cfp.preset("run", "paper", "analytic")
    with pytest.raises(ConfigError, match="learner must be analytic or sac, got 'ppo'"):
        cfp.preset("run", "quick", "ppo")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"window": 0}, "window must be at least 1, got 0"),
        ({"action_step": (0.0,)}, "action_step must be positive, got 0"),
        ({"action_step": (0.1, 0.1)}, "action_step must have 1 values"),
        ({"weight_average": 1.0}, "weight_average must be at least 0 and less than 1, got 1.0"),
        ({"refine": True}, "refine requires start_from"),
        ({"learner": "sac"}, "learner must be analytic for algo cfp, got sac"),
    ],
)
def test_impossible_options_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes).check()


def test_training_shapes_the_robot(tmp_path):
    config = make("shapematch", resolutions=(8,), window=16, steps=448, max_episode_steps=48, num_layouts=2)
    config = replace(config, weight_average=0.9, minibatches=16, minibatch_size=16, windows_kept=4)
    config = replace(config, environment=EnvironmentConfig(2, 300), train_particles=300)
    learner, rewards = AnalyticLearner.create(config, 1, tmp_path), []
    while learner.num_timesteps < config.steps:
        scalars = learner.update()
        rewards.append(scalars["train/true_reward"])
    assert set(scalars) == set(METRICS)
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 0.8  # 1.2 to 1.4 with three seeds


@pytest.mark.cuda
def test_trains_on_cuda_and_goes_on_on_the_cpu(tmp_path):
    config = make("shapematch", device="cuda")
    learner = AnalyticLearner.create(config, 1, tmp_path)
    learner.update()
    there = AnalyticLearner.create(replace(config, device="cpu"), 1, tmp_path)
    there.load_state_dict(learner.state_dict())
    assert np.isfinite(there.update()["train/reward"])


def test_step_has_the_given_size_and_goes_down_the_gradient():
    torch.manual_seed(0)
    step, locations, gradients = ActionStep(), torch.zeros(4, 3, 2, 4, 4), torch.randn(4, 3, 2, 4, 4)
    change = step(locations, gradients, 0.1)
    assert change.square().mean().sqrt().item() == pytest.approx(0.1, rel=1e-5)
    assert torch.allclose(change / gradients, (change / gradients)[0, 0, 0, 0, 0].expand_as(change), atol=1e-5)
    assert (change * gradients).sum() < 0
    assert step(torch.full_like(locations, 2.5), -gradients.abs(), 0.1).max() == 2.5
    assert torch.equal(ActionStep()(locations, torch.zeros_like(gradients), 0.1), locations)


def test_outlying_gradient_does_not_drown_the_others():
    torch.manual_seed(0)
    step, locations, gradients = ActionStep(), torch.zeros(4, 3, 2, 4, 4), torch.randn(4, 3, 2, 4, 4)
    gradients[1, 2] *= 1e30  # its square overflows in single precision
    change = step(locations, gradients, 0.1)
    norms = change.flatten(2).norm(dim=2)
    assert step.limited == 1 and change.isfinite().all()
    assert 2.5 < norms[1, 2] / norms.median() < 3.5
    assert norms.min() > 0.2 * norms.median()


def test_memory_keeps_the_latest_pairs_and_survives_a_checkpoint():
    image, location = torch.zeros(3, 64, 64, dtype=torch.uint8), torch.zeros(2, 4, 4)
    memory, copy = ImageMemory(6, (image, location)), ImageMemory(6, (image, location))
    for value in range(5):
        memory.add((image + value).expand(2, -1, -1, -1), (location + value).expand(2, -1, -1, -1))
    copy.load_state_dict(memory.state_dict())
    for each in (memory, copy):
        images, locations = each.sample(200, torch.Generator().manual_seed(0))
        assert set(images.unique().tolist()) == {2, 3, 4}
        assert torch.equal(images[:, 0, 0, 0].float(), locations[:, 0, 0, 0])


@pytest.mark.parametrize("grids", [(4,), (4, 8)])
def test_regression_reaches_locations_and_leaves_coarse_actor_and_deviation(grids):
    torch.manual_seed(0)
    actor = build_actor(ActorSpec(grids, (-1.0,) * (len(grids) - 1), patch=16))
    actor.fix_std()
    images = torch.randint(0, 256, (6, 3, 64, 64), dtype=torch.uint8)
    targets = torch.randn_like(actor.outputs(images, deterministic=True).location)
    frozen = {name: value.clone() for name, value in actor.named_parameters() if not value.requires_grad}
    assert any(name.startswith("coarse") for name in frozen) == (len(grids) > 1)
    regression = Regression(actor, 3e-3, 0.9, 1.0)
    losses, average = [], parameters(actor)
    for update in range(150):
        losses.append(regression.update(images, targets, 3e-3).item())
        average = parameters(actor) if update == 0 else 0.9 * average + 0.1 * parameters(actor)
    assert losses[-1] < 0.3 * losses[0]
    torch.testing.assert_close(parameters(regression.average.module), average, rtol=0, atol=1e-5)
    assert not torch.equal(average, parameters(actor))
    assert all(torch.equal(value, dict(actor.named_parameters())[name]) for name, value in frozen.items())
    std = actor.act(actor.outputs(images)).log_prob
    assert std.isfinite().all()


def test_rates_fall_along_a_line(tmp_path):
    learner = AnalyticLearner.create(make(), 1, tmp_path)
    config = learner.config
    learner.num_timesteps = config.steps // 2
    scalars = learner.update()
    assert scalars["train/learning_rate"] == pytest.approx(0.55 * config.learning_rate)
    assert scalars["train/action_step"] == pytest.approx(0.7 * config.action_step[0])


def test_second_stage_learns_residual_and_gate_on_the_frozen_policy(tmp_path):
    first = AnalyticLearner.create(make(), 1, tmp_path)
    first.learn(16)
    first.save_policy(policy_path(tmp_path, 1), describe_run(first.config, "cfp", 1, 16))
    second = AnalyticLearner.create(make(stages=2), 2, tmp_path)
    coarse, gate = (second.actor.get_submodule(name) for name in ("coarse", "gate"))
    assert second.starts_trained and torch.equal(parameters(coarse), parameters(first.trained_actor))
    before = parameters(gate)
    second.learn(16)
    assert torch.equal(parameters(coarse), parameters(first.trained_actor))
    assert not torch.equal(before, parameters(gate))
    observation = np.zeros((3, 64, 64), np.uint8)
    action, _ = second.policy.predict(observation, deterministic=True)
    assert action.shape == (2, second.policy.resolution, second.policy.resolution)


def test_gradients_of_a_window_are_those_of_its_return(tmp_path):
    """The step on the actions, were it small, increases the return of the same window."""
    config = make(substeps=100, gamma=1.0, num_envs=1)
    learner = AnalyticLearner.create(config, 1, tmp_path)
    env, collector = learner.env, learner.collector
    start = env.save()
    leaf = torch.randn(4, 1, *env.action_shape, generator=torch.Generator().manual_seed(0)).requires_grad_()

    def window_return(actions):
        env.load(start)
        steps = iter(actions)
        return collector.collect(lambda _: next(steps).tanh(), learner.critic).rewards.sum()

    before = window_return(leaf)
    (gradient,) = torch.autograd.grad(-before, leaf)
    improved = learner.action_step(leaf.detach(), gradient, 0.1)
    after = window_return(improved)
    expected = -(gradient * (improved - leaf)).sum()
    assert (after - before).item() == pytest.approx(expected.item(), rel=0.2) and after > before


def test_a_trained_policy_is_kept_until_the_critic_has_learned():
    config = make(warmup=2)
    learner = AnalyticLearner(config, 1, build_actor(config.actor_spec(1)))
    learner.starts_trained = True
    before, critic = parameters(learner.actor), parameters(learner.critic.network)
    for _ in range(2):
        learner.update()
    assert torch.equal(parameters(learner.actor), before) and learner.action_step.norms == []  # no gradients
    assert not torch.equal(parameters(learner.critic.network), critic)
    learner.update()
    assert not torch.equal(parameters(learner.actor), before)


@pytest.mark.parametrize(("success", "expected"), [(True, 1.0), (False, 0.0)])
def test_an_episode_that_ends_in_success_has_the_value_of_the_option(success, expected):
    def ends_at_once(transition, spec):
        over = torch.ones_like(transition.now.com[:, 0], dtype=torch.bool)
        return Reward(terms={}, terminated=over, success=over & success)

    spec = replace(dittogym.make_spec("run"), reward_fn=ends_at_once, weights={"alive": 1.0})
    env = dittogym.TorchEnv(spec, 2, particles=300, substeps=4)
    reward = RewardConfig(success_reward=2.0)  # times the scale 0.05, for 1 / (1 - gamma) = 10 steps
    config = WindowConfig(task="run", reward=reward, window=1, gamma=0.9, max_episode_steps=10)
    collector = WindowCollector(env, lambda: torch.zeros(2, 1), config)
    window = collector.collect(lambda _: torch.zeros(2, *env.action_shape), lambda seen: seen[:, 0] + 7.0)
    assert window.next_values.tolist() == [[pytest.approx(expected)] * 2]


def test_gradients_that_are_not_finite_are_left_out_with_a_warning():
    def rooted(transition, spec):
        risen = transition.now.com[:, 1] - transition.start.com[:, 1]
        return Reward(terms={"risen": (risen * (risen > 0)).sqrt()})

    spec = replace(dittogym.make_spec("run"), reward_fn=rooted, weights={"risen": 1.0})
    env = dittogym.TorchEnv(spec, 2, particles=300, substeps=4)
    collector = WindowCollector(env, lambda: torch.zeros(2, 1), WindowConfig(task="run", window=2))
    action = torch.zeros(2, *env.action_shape, requires_grad=True)
    window = collector.collect(lambda _: action, lambda seen: seen[:, 0])
    window.rewards.sum().backward()
    with pytest.warns(UserWarning, match="most gradients of a window are not finite and were left out"):
        assert collector.scalars(window)["train/dropped"] == 4
    assert not action.grad.any()
