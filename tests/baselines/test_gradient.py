"""Open-loop gradient descent, on robots of a few hundred particles."""

from dataclasses import replace

import pytest
import torch
from updates import EachUpdate

import dittogym
from baselines import Gradient, OpenLoop
from baselines.trajectory.optimise import Episode
from cfp.errors import ConfigError, NonFiniteError
from cfp.sections import EnvironmentConfig
from dittogym.rewards import Reward


def make(task="shapematch", **changes):
    environment = EnvironmentConfig(1, changes.pop("particles", 300), changes.pop("substeps", 4))
    defaults = {"environment": environment, "train_particles": 300, "grid": 4, "device": "cpu", "iterations": 12}
    return replace(Gradient.preset(task, "quick"), **defaults | changes)


def shorten(algorithm, horizon):
    algorithm.horizon = horizon
    algorithm.theta = algorithm.theta.detach()[:horizon].clone().requires_grad_()
    return algorithm


def test_only_the_first_stage_takes_longer_substeps():
    config = make("run", environment=EnvironmentConfig(1, 100), polish=1)
    assert [Gradient(config, stage).env.model.solver.dt for stage in (1, 2)] == [2e-4, 1e-4]
    assert Gradient(replace(config, train_dt=1e-4)).env.model.substeps == 100
    with pytest.raises(ConfigError, match="train_dt must be positive"):
        Gradient(replace(config, train_dt=0.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"train_dt": 3e-3}, "train_dt must divide an environment step of"),
        ({"window": -1}, "window must be at least 0, got -1"),
        ({"polish_learning_rate": 0.0}, "polish_learning_rate"),
        ({"blur": ()}, "blur"),
    ],
)
def test_impossible_options_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes).check()


def test_descent_improves_the_true_return():
    config = make(substeps=30, train_particles=500, learning_rate=0.2, blur=(1.0,), iterations=6)
    algorithm, returns = Gradient(config), []
    algorithm.learn(6 * 30, EachUpdate(lambda scalars: returns.append(scalars["train/return"])))
    assert len(returns) == 6 and algorithm.num_timesteps == 180
    assert returns[-1] > returns[0] + 40
    assert algorithm.policy.actions.abs().max() < 1


def test_rewards_with_steps_are_replaced_by_smooth_ones(request):
    def ahead(transition, spec):
        x = transition.robot_x[..., 0].mean(1)
        return Reward(terms={"ahead": transition.ops.heaviside(x - x.detach() - 1e-3, 1e-3)})

    def stepping():
        return replace(dittogym.make_spec("run"), name="stepping", reward_fn=ahead, weights={"ahead": 1.0})

    dittogym.register("stepping", stepping)
    request.addfinalizer(lambda: dittogym.TASKS.pop("stepping"))
    episode = shorten(Gradient(make("stepping", substeps=20)), 4).play(0.0)
    assert episode.gradient.abs().max() > 0 and episode.total == 0.0


def numerical(algorithm, index, width):
    """Central difference of the loss in one entry of theta."""
    losses = []
    for sign in (1, -1):
        algorithm.theta.data[index] += sign * width
        losses.append(algorithm.play(0.9)[0])
        algorithm.theta.data[index] -= sign * width
    return (losses[0] - losses[1]) / (2 * width)


@pytest.mark.parametrize("task", ["shapematch", "run"])
def test_gradient_is_that_of_the_loss(task):
    environment = EnvironmentConfig(1, 300, 4, dtype="float64")
    algorithm = shorten(Gradient(make(task, environment=environment, window=0)), 4)
    with torch.no_grad():
        algorithm.theta += 0.3
    algorithm.theta = algorithm.theta.detach().double().requires_grad_()
    gradient = algorithm.play(0.9).gradient
    index = (1, 0, 2, 2)
    assert gradient[index].item() == pytest.approx(numerical(algorithm, index, 1e-5), rel=1e-4)


def test_windows_cut_the_gradient_but_not_the_loss():
    whole = shorten(Gradient(make(window=0)), 6).play(0.9)
    halves = shorten(Gradient(make(window=3)), 6).play(0.9)
    assert halves.loss == pytest.approx(whole.loss, rel=1e-6)
    assert torch.allclose(halves.gradient[3:], whole.gradient[3:], rtol=1e-4, atol=1e-9)
    assert not torch.allclose(halves.gradient[:3], whole.gradient[:3], rtol=0.1, atol=1e-9)


def test_iterations_do_not_depend_on_those_before():
    environment = EnvironmentConfig(1, 300, 100)
    algorithm = shorten(Gradient(make("run", environment=environment, polish=1, polish_grid=4), 1), 4)
    with torch.no_grad():
        algorithm.theta += torch.linspace(0.0, 1.0, 4)
    first, state = algorithm.play(0.0), algorithm.env.env_state
    algorithm.env.env_state = replace(state, centre=state.centre + 0.1)  # as after a longer way
    second = algorithm.play(0.0)
    assert first.loss == second.loss and torch.equal(first.gradient, second.gradient)


def test_steps_after_the_end_of_an_episode_do_not_count(monkeypatch):
    algorithm = shorten(Gradient(make("run", window=2)), 6)
    step, calls = algorithm.env.step, []

    def end_at_third(action, soft):
        calls.append(action)
        observation, reward, terminated, truncated, info = step(action, soft=soft)
        return observation, reward, terminated | (len(calls) == 3), truncated, info

    monkeypatch.setattr(algorithm.env, "step", end_at_third)
    gradient = algorithm.play(0.0).gradient
    assert len(calls) == 3
    assert gradient[:3].abs().amax((1, 2, 3)).gt(0).all() and not gradient[3:].any()


def test_robot_whose_episode_is_over_may_break(monkeypatch):
    algorithm = shorten(Gradient(make("run", window=2, environment=EnvironmentConfig(2, 300, 4))), 4)
    step, calls = algorithm.env.step, []

    def first_breaks_after_its_end(action, soft):
        calls.append(action)
        observation, reward, terminated, truncated, info = step(action, soft=soft)
        first = torch.tensor([True, False])
        broken = first & (len(calls) > 2)
        info = {**info, "finite": ~broken}
        return observation, torch.where(broken, torch.nan, reward), terminated | first, truncated, info

    monkeypatch.setattr(algorithm.env, "step", first_breaks_after_its_end)
    loss, size, total, gradient = algorithm.play(0.0)
    assert (
        len(calls) == 4 and size >= abs(loss) > 0 and total == pytest.approx(-4 * loss, rel=0.01)
    )  # of smooth rewards
    assert gradient.isfinite().all() and gradient.abs().amax((1, 2, 3)).gt(0).all()


def test_unusual_gradients_are_clipped():
    algorithm = Gradient(make())
    gradient = torch.ones(30, 2, 4, 4)
    clipped, share = algorithm._clip(gradient)
    assert torch.equal(clipped, gradient) and share == 0
    spiky = gradient.clone()
    spiky[7] *= 100
    clipped, share = algorithm._clip(spiky)
    assert torch.allclose(clipped[7], 3 * gradient[7]) and torch.equal(clipped[8], gradient[8])
    assert share == pytest.approx(1 / 30)


@pytest.mark.parametrize("loss", [float("nan"), float("inf"), 1e3])
def test_iteration_that_breaks_the_robot_is_undone(monkeypatch, loss):
    algorithm = Gradient(make(substeps=1, blur=(1.0,)))
    algorithm.learn(30)
    good = algorithm.play
    fail = lambda progress: Episode(loss, loss, 0.0, torch.zeros_like(algorithm.theta))  # noqa: E731
    monkeypatch.setattr(algorithm, "play", fail)
    scalars = algorithm.update()
    assert not algorithm.theta.any() and scalars["train/failed"] == 1  # back to the start, the best so far
    monkeypatch.setattr(algorithm, "play", good)
    algorithm.num_timesteps = 30  # the same place in the schedule
    assert algorithm.update()["train/learning_rate"] == pytest.approx(0.7 * scalars["train/learning_rate"])
    assert algorithm.theta.any() and algorithm.failed_in_a_row == 0
    monkeypatch.setattr(algorithm, "play", fail)
    with pytest.raises(NonFiniteError, match="10 iterations in a row"):
        algorithm.learn(30 * 20)


@pytest.mark.parametrize(
    ("sequence", "size"), [([-3.0, -3.05, -2.8, -3.1, -2.6], 3.1), ([0.2, -0.01, 0.25, -0.02, 0.35], 3.1)]
)
def test_better_losses_below_zero_are_kept(monkeypatch, sequence, size):
    algorithm, losses = Gradient(make("run", substeps=1)), iter(sequence)
    found = lambda progress: Episode(next(losses), size, 0.0, torch.ones_like(algorithm.theta))  # noqa: E731
    monkeypatch.setattr(algorithm, "play", found)
    assert [algorithm.update()["train/failed"] for _ in range(4)] == [0, 0, 0, 0]
    resumed = Gradient(algorithm.config)
    resumed.load_state_dict(algorithm.state_dict())
    monkeypatch.setattr(resumed, "play", found)
    assert resumed.update()["train/failed"] == 1 and resumed.best_loss == min(sequence)


def test_schedule_of_a_stage_that_gets_the_steps_of_an_earlier_one_does_not_rise_again(monkeypatch):
    algorithm = Gradient(make(polish=2, polish_grid=4, substeps=1), 2)
    found = Episode(1.0, 1.0, 0.0, torch.ones_like(algorithm.theta))
    monkeypatch.setattr(algorithm, "play", lambda progress: found)
    rates = []
    algorithm.learn(4 * 30, EachUpdate(lambda scalars: rates.append(scalars["train/learning_rate"])))
    assert rates == pytest.approx([0.05, 0.0275, 0.005, 0.005])


def test_polish_starts_from_the_actions_of_the_first_stage():
    actions = 0.5 * torch.rand(30, 2, 4, 4, generator=torch.Generator().manual_seed(0)) - 0.25
    algorithm = Gradient(make(polish=1, polish_grid=4, particles=200), 2, OpenLoop(actions))
    assert torch.allclose(algorithm.policy.actions, actions, atol=1e-6)
    assert algorithm.env.num_particles == 200
    finer = Gradient(make(polish=1, polish_grid=8, particles=200), 2, OpenLoop(actions)).policy.actions
    assert finer.shape == (30, 2, 8, 8)
    assert torch.allclose(finer.mean((2, 3)), actions.mean((2, 3)), atol=0.05)


def test_only_polish_takes_place_where_the_result_is_evaluated():
    environment = EnvironmentConfig(1, 300, 4, action_layout="grid")
    first, polish = (
        Gradient(make("run", environment=environment, train_particles=200, polish=1), stage) for stage in (1, 2)
    )
    assert (first.env.num_particles, polish.env.num_particles) == (200, 300)
    assert first.env.action_layout == polish.env.action_layout == "grid"


@pytest.mark.parametrize("task", dittogym.TASKS)
def test_every_task_has_a_gradient(task):
    algorithm = shorten(Gradient(make(task, substeps=20, particles=100, train_particles=100)), 3)
    loss, _, _, gradient = algorithm.play(0.0)
    assert gradient.isfinite().all() and gradient.abs().sum() > 0 and loss == loss
