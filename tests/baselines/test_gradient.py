"""Open-loop gradient descent, on robots of a few hundred particles."""

import dataclasses
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from watching import learn

import dittogym
from baselines import Gradient, OpenLoop
from baselines.trajectory import Iteration, Objective, gaussian_matrix
from cfp.errors import NonFiniteError
from dittogym import TorchEnv, make_spec
from dittogym.rewards import Reward


def make(task="shapematch", **changes):
    defaults = {"particles": 300, "substeps": 4, "train_particles": 300, "grid": 4, "device": "cpu", "iterations": 12}
    return replace(Gradient.preset(task, "quick"), **defaults | {"train_dt": None} | changes)


def shorten(learner, horizon):
    learner.horizon = horizon
    learner.theta = learner.theta.detach()[:horizon].clone().requires_grad_()
    return learner


def test_only_polish_takes_place_where_the_result_is_evaluated():
    config = make("run", substeps=None, particles=200, train_particles=100, train_dt=2e-4, polish=1)
    first, polish = (Gradient(config, stage).env for stage in (1, 2))
    assert (first.model.solver.dt, polish.model.solver.dt) == (2e-4, 1e-4)
    assert (first.num_particles, polish.num_particles) == (100, 200)


def test_descent_improves_the_true_return():
    learner = Gradient(make(substeps=30, train_particles=500, learning_rate=0.2, blur=(1.0,), iterations=6))
    returns = [row["train/return"] for row in learn(learner, 6 * 30)]
    assert len(returns) == 6 and learner.num_timesteps == 180
    assert returns[-1] > returns[0] + 40 and learner.trained_policy.actions.abs().max() < 1


@pytest.mark.parametrize("task", ["shapematch", "run"])
def test_gradient_is_that_of_the_loss(task):
    learner = shorten(Gradient(make(task, dtype="float64", window=0)), 4)
    learner.theta = (learner.theta.detach() + 0.3).double().requires_grad_()
    gradient, index, losses = learner.play(0.9).gradient, (1, 0, 2, 2), []
    for sign in (1, -2, 1):
        learner.theta.data[index] += sign * 1e-5
        losses.append(learner.play(0.9).loss)
    assert gradient[index].item() == pytest.approx((losses[0] - losses[1]) / 2e-5, rel=1e-4)


@pytest.mark.parametrize("task", dittogym.TASKS)
def test_every_task_has_a_gradient_that_does_not_depend_on_what_was_played_before(task):
    learner = shorten(Gradient(make(task, substeps=20, particles=100, train_particles=100)), 3)
    first = learner.play(0.0)
    learner.env.env_state = replace(learner.env.env_state, centre=learner.env.env_state.centre + 0.1)
    second = learner.play(0.0)
    assert first.gradient.isfinite().all() and first.gradient.any() and math.isfinite(first.loss)
    assert first.loss == second.loss and torch.equal(first.gradient, second.gradient)


def test_windows_cut_the_gradient_but_not_the_loss():
    whole, halves = (shorten(Gradient(make(window=window)), 6).play(0.9) for window in (0, 3))
    assert halves.loss == pytest.approx(whole.loss, rel=1e-6)
    assert torch.allclose(halves.gradient[3:], whole.gradient[3:], rtol=1e-4, atol=1e-9)
    assert not torch.allclose(halves.gradient[:3], whole.gradient[:3], rtol=0.1, atol=1e-9)


def test_rewards_with_steps_are_replaced_by_smooth_ones(own_task):
    def ahead(step):
        x = step.robot_x[..., 0].mean(1)
        return step.ops.heaviside(x - x.detach() - 1e-3, 1e-3)

    episode = shorten(Gradient(make(own_task(ahead), substeps=20)), 4).play(0.0)
    assert episode.gradient.abs().max() > 0 and episode.total == 0.0


def test_steps_after_the_end_of_an_episode_do_not_count(monkeypatch):
    """Even if the robot breaks there, while the other goes on."""
    learner = shorten(Gradient(make("run", window=2, num_envs=2)), 6)
    step, calls = learner.env.step, []

    def end(action, soft):
        calls.append(action)
        observation, reward, terminated, truncated, info = step(action, soft=soft)
        first, last = torch.tensor([True, False]), len(calls) == 4
        broken = first & (len(calls) > 2)
        info = {**info, "finite": ~broken}
        return observation, torch.where(broken, torch.nan, reward), terminated | first | last, truncated, info

    monkeypatch.setattr(learner.env, "step", end)
    loss, size, total, gradient = learner.play(0.0)
    assert len(calls) == 4 and size >= (1 - 1e-6) * abs(loss) > 0 and total == pytest.approx(-6 * loss, rel=0.01)
    assert gradient.isfinite().all() and gradient[:4].abs().amax((1, 2, 3)).gt(0).all() and not gradient[4:].any()


@pytest.mark.parametrize("loss", [math.nan, 1e3])
def test_iteration_that_breaks_the_robot_is_undone(monkeypatch, loss):
    learner = Gradient(make(substeps=1, blur=(1.0,)))
    learn(learner, 30)
    good = learner.play
    fail = lambda progress: Iteration(loss, loss, 0.0, torch.zeros_like(learner.theta))  # noqa: E731
    monkeypatch.setattr(learner, "play", fail)
    scalars = learner.update()
    assert not learner.theta.any() and scalars["train/failed"] == 1  # back to the start, the best so far
    monkeypatch.setattr(learner, "play", good)
    learner.num_timesteps = 30  # the same place in the schedule
    assert learner.update()["train/learning_rate"] == pytest.approx(0.7 * scalars["train/learning_rate"])
    assert learner.theta.any() and learner.failed_in_a_row == 0
    monkeypatch.setattr(learner, "play", fail)
    with pytest.raises(NonFiniteError, match="10 iterations in a row"):
        learn(learner, 30 * 20)


@pytest.mark.parametrize("sequence", [[-3.0, -3.05, -2.8, -3.1, -2.6], [0.2, -0.01, 0.25, -0.02, 0.35]])
def test_better_losses_below_zero_are_kept(monkeypatch, sequence):
    learner, losses = Gradient(make("run", substeps=1)), iter(sequence)
    found = lambda progress: Iteration(next(losses), 3.1, 0.0, torch.ones_like(learner.theta))  # noqa: E731
    monkeypatch.setattr(learner, "play", found)
    assert [learner.update()["train/failed"] for _ in range(4)] == [0, 0, 0, 0]
    assert learner.update()["train/failed"] == 1 and learner.best_loss == min(sequence)


def test_learning_rate_falls_along_a_cosine_and_stays_there(monkeypatch):
    learner = Gradient(make(polish=2, polish_grid=4, substeps=1), 2)
    found = Iteration(1.0, 1.0, 0.0, torch.ones_like(learner.theta))
    monkeypatch.setattr(learner, "play", lambda progress: found)
    rates = [row["train/learning_rate"] for row in learn(learner, 4 * 30)]
    assert rates == pytest.approx([0.05, 0.0275, 0.005, 0.005])


def test_polish_starts_from_the_actions_of_the_first_stage():
    actions = 0.5 * torch.rand(30, 2, 4, 4, generator=torch.Generator().manual_seed(0)) - 0.25
    same, finer = (
        Gradient(make(polish=1, polish_grid=grid), 2, OpenLoop(actions)).trained_policy.actions for grid in (4, 8)
    )
    assert torch.allclose(same, actions, atol=1e-6)
    assert finer.shape == (30, 2, 8, 8) and torch.allclose(finer.mean((2, 3)), actions.mean((2, 3)), atol=0.05)


# The objective --------------------------------------------------------------------------------------------------------


def small(task, **options):
    env = TorchEnv(task, resolution=8, **{"particles": 300, "substeps": 1, **options})
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("sigma", [0.0, 1.0, 3.5])
def test_blur_is_a_gaussian_with_empty_surroundings(sigma):
    picture = np.random.default_rng(0).random((64, 64))
    matrix = gaussian_matrix(sigma, 64)
    ours = (matrix @ torch.from_numpy(picture) @ matrix.T).numpy()
    theirs = cv2.GaussianBlur(picture, (63, 63), sigma, borderType=cv2.BORDER_CONSTANT) if sigma else picture
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_loss_counts_the_pixels_that_differ():
    """Without blur it is the task's own measure: 0.1 for each of 4096 pixels, up to the soft edge."""
    env = small("shapematch", particles="lite")
    with torch.no_grad():
        reward = env.step(torch.zeros(1, 2, 8, 8))[4]["reward_terms"]["mismatch"]
    loss = Objective(env, (0.0,))(env, reward, 0.0)
    assert 409.6 * loss.item() == pytest.approx(-reward.item(), rel=0.15)


def test_blurs_follow_one_another():
    env = small("shapematch")
    both, reward = Objective(env, (4.0, 0.0)), torch.zeros(1)
    for progress, blur in ((0.0, 4.0), (0.49, 4.0), (0.5, 0.0), (1.0, 0.0)):
        assert both(env, reward, progress) == Objective(env, (blur,))(env, reward, 0.0)


def test_tasks_with_another_reward_minimise_its_negative():
    """Also one that is derived from SHAPE MATCH."""

    def drift(transition, spec):
        return Reward({"drift": transition.now.com[:, 0]})

    own = dataclasses.replace(make_spec("shapematch"), name="drift", reward_fn=drift, weights={"drift": 1.0})
    for task in ("run", own):
        env = small(task)
        assert Objective(env, (0.0,))(env, torch.tensor([2.5]), 0.5).tolist() == [-2.5]
