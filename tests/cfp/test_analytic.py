"""The learner `CFPAnalytic`, on robots of a few hundred particles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from watching import learn

import cfp
import dittogym
from cfp import CFPAnalytic
from cfp.agent.actor import ActorSpec, build_actor
from cfp.analytic.learner import METRICS, ActionStep, ImageMemory, Regression
from cfp.analytic.window import WindowCollector, reward_warnings
from cfp.config import WindowConfig
from cfp.errors import NonFiniteError
from cfp.experiment.folder import policy_path
from cfp.policy import describe_run
from dittogym.rewards import Reward


def make(task="run", stages=1, **changes):
    options = {"resolutions": (4, 8)[:stages], "handover": (0.5,), "gate_bias": (-1.0,), "steps": 96, "warmup": 0}
    options |= {"action_step": (0.1,), "num_envs": 2, "particles": 300, "train_particles": 300, "substeps": 4}
    options |= {"device": "cpu", "window": 4, "minibatches": 4, "minibatch_size": 8, "windows_kept": 3}
    return replace(cfp.preset(task, "quick", "cfp-analytic"), **options | changes)


def update(learner, count=1):
    """Make some updates; returns what each records."""
    return learn(learner, count * learner.config.update_every)


def test_a_reward_without_gradient_is_noticed(own_task):
    config = make(reward="task")
    assert reward_warnings(config) == reward_warnings(replace(config, dtype="float64")) == []
    counts = own_task(lambda step: (step.now.com[:, 0] > step.start.com[:, 0]).float(), action=1e-4)
    assert "the reward of own has no gradient in the actions" in reward_warnings(replace(config, task=counts))[0]


def test_gradients_that_are_never_finite_end_the_training(own_task, tmp_path):
    task = own_task(
        lambda step: (step.now.com[:, 0] - step.now.com[:, 0].detach()).square().sqrt()
    )  # 0, derivative NaN
    learner = CFPAnalytic.create(replace(make(reward="task"), task=task), 1, tmp_path)
    with pytest.warns(UserWarning, match="most gradients of a window are not finite and were left out"):
        rows = update(learner, 9)
    assert rows[-1]["train/dropped"] == 9 * 4 * 2
    with pytest.raises(NonFiniteError, match="all gradients of 10 windows in a row"):
        update(learner)


def test_a_reward_that_is_not_finite_ends_the_training(own_task, tmp_path):
    task = own_task(lambda step: (step.start.com - step.now.com)[:, 1].abs().neg().sqrt())  # NaN once it has moved
    learner = CFPAnalytic.create(replace(make(reward="task"), task=task), 1, tmp_path)
    with pytest.raises(NonFiniteError, match="the reward function of the task returned NaN"):
        update(learner)


def parameters(module):
    return torch.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


@pytest.mark.slow
def test_training_shapes_the_robot(tmp_path):
    config = make("shapematch", resolutions=(8,), window=16, steps=448, max_episode_steps=48, num_layouts=2)
    config = replace(config, weight_average=0.9, minibatches=16, minibatch_size=16, windows_kept=4, substeps=None)
    rows = update(CFPAnalytic.create(config, 1, tmp_path), 14)
    assert set(rows[-1]) == set(METRICS)
    rewards = [row["train/true_reward"] for row in rows]
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 0.8  # 1.2 to 1.4 with three seeds


@pytest.mark.cuda
def test_trains_on_cuda_and_goes_on_on_the_cpu(tmp_path):
    config = make("shapematch")
    learner, there = (CFPAnalytic.create(replace(config, device=name), 1, tmp_path) for name in ("cuda", "cpu"))
    update(learner)
    there.load_state_dict(learner.state_dict())
    assert np.isfinite(update(there)[0]["train/reward"])


def test_an_update_remembers_each_image_with_an_action_that_earns_more(tmp_path):
    rewards_alone = {"reward": "task", "split_weight": 0.0, "integrity_weight": 0.0, "gamma": 1.0, "minibatches": 0}
    learner = CFPAnalytic.create(make(dtype="float64", **rewards_alone), 1, tmp_path)
    for weight in learner.critic.target.parameters():
        torch.nn.init.zeros_(weight)
    env, steps = learner.simulation, learner.config.window
    start = env.env_state
    update(learner)
    count = steps * learner.n_envs
    images, improved = learner.memory.images[:count], learner.memory.locations[:count]
    with torch.no_grad():
        outputs = learner.actor.outputs(images, deterministic=True)
    step = improved - outputs.location
    assert step.square().mean().sqrt().item() == pytest.approx(0.1, rel=1e-3)

    def earned(locations):
        env.env_state = start
        with torch.no_grad():
            actions = learner.actor.act(outputs.at(locations), deterministic=True).action.unflatten(0, (steps, -1))
            return sum(env.step(action, soft=True)[1] for action in actions)

    assert (earned(improved) > earned(outputs.location)).all()


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
    resumed, later = ActionStep(), 100 * gradients
    resumed.load_state_dict(step.state_dict())
    assert torch.equal(resumed(locations, later, 0.1), step(locations, later, 0.1))
    assert not torch.equal(ActionStep()(locations, later, 0.1), step(locations, later, 0.1))


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


def test_regression_reaches_locations_and_leaves_coarse_actor_and_deviation():
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((4, 8), (-1.0,), patch=16))
    actor.fix_std()
    images = torch.randint(0, 256, (6, 3, 64, 64), dtype=torch.uint8)
    targets = torch.randn_like(actor.outputs(images, deterministic=True).location)
    frozen = {name: value.clone() for name, value in actor.named_parameters() if not value.requires_grad}
    assert any(name.startswith("coarse") for name in frozen)
    regression = Regression(actor, 3e-3, 0.9, 1.0)
    losses, average = [], parameters(actor)
    for _ in range(150):
        losses.append(regression.update(images, targets, 3e-3)[0].item())
        average = 0.9 * average + 0.1 * parameters(actor)
    assert losses[-1] < 0.3 * losses[0]
    torch.testing.assert_close(parameters(regression.average), average, rtol=0, atol=1e-5)
    assert not torch.equal(average, parameters(actor))
    assert all(torch.equal(value, dict(actor.named_parameters())[name]) for name, value in frozen.items())


def test_rates_fall_along_a_line(tmp_path):
    learner = CFPAnalytic.create(make(), 1, tmp_path)
    config = learner.config
    learner.num_timesteps = config.steps // 2
    scalars = update(learner)[0]
    assert scalars["train/learning_rate"] == pytest.approx(0.55 * config.learning_rate)
    assert scalars["train/action_step"] == pytest.approx(0.7 * config.action_step[0])


def test_second_stage_learns_residual_and_gate_on_the_frozen_policy(tmp_path):
    first = CFPAnalytic.create(make(), 1, tmp_path)
    update(first, 2)
    first.save_policy(policy_path(tmp_path, 1), describe_run(first.config, "cfp", 1, 16))
    second = CFPAnalytic.create(make(stages=2), 2, tmp_path)
    coarse, gate = (second.actor.get_submodule(name) for name in ("coarse", "gate"))
    assert second.starts_trained and torch.equal(parameters(coarse), parameters(first.trained_actor))
    before = parameters(gate)
    update(second, 2)
    assert torch.equal(parameters(coarse), parameters(first.trained_actor))
    assert not torch.equal(before, parameters(gate))
    observation = np.zeros((3, 64, 64), np.uint8)
    for policy in (second, second.trained_policy):
        assert policy.predict(observation, deterministic=True)[0].shape == second.action_space.shape


def test_a_trained_policy_is_kept_until_the_critic_has_learned(tmp_path):
    learner = CFPAnalytic.create(make(warmup=2), 1, tmp_path)
    learner.starts_trained = True
    before, critic = parameters(learner.actor), parameters(learner.critic.network)
    update(learner, 2)
    assert torch.equal(parameters(learner.actor), before) and learner.action_step.norms == []  # no gradients
    assert not torch.equal(parameters(learner.critic.network), critic)
    update(learner)
    assert not torch.equal(parameters(learner.actor), before)


@pytest.mark.parametrize(("success", "ends", "paid", "value"), [(1, 1, 0.1, 1.0), (0, 1, 0.0, 0.0), (1, 0, 0.1, 7.0)])
def test_steps_with_success_pay_the_option_and_an_end_with_success_has_its_value(success, ends, paid, value):
    def solved(transition, spec):
        always = torch.ones_like(transition.now.com[:, 0], dtype=torch.bool)
        return Reward(terms={}, terminated=always & bool(ends), success=always & bool(success))

    spec = replace(dittogym.make_spec("run"), reward_fn=solved, weights={"alive": 0.0})
    env = dittogym.TorchEnv(spec, 2, particles=300, substeps=4)
    # times the scale 0.05, for 1 / (1 - gamma) = 10 steps
    config = WindowConfig(task="run", algo="shac", success_reward=2.0, window=1, gamma=0.9, max_episode_steps=10)
    collector = WindowCollector(env, lambda: torch.zeros(2, 1), config)
    rest = torch.zeros(2, *env.action_shape)
    window = collector.collect(lambda _: rest, lambda seen: seen[:, 0] + 7.0, lambda *_: True)
    assert window.rewards.tolist() == [[pytest.approx(paid, abs=1e-6)] * 2]
    assert window.next_values.tolist() == [[pytest.approx(value)] * 2]
