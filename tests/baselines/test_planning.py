"""Planners on tiny robots, and on rewards whose best plan is known; planned episodes; rollouts as functions."""

from dataclasses import replace

import pytest
import torch
from watching import learn

from baselines import CEMPlanner, CEMPlannerConfig, GradientPlanner, GradientPlannerConfig
from baselines.common.rollout import rollout, soft_step
from baselines.planning.gradient import clip_steps
from baselines.planning.mpc import MPC, MPCConfig, Surrogate
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError, NonFiniteError
from dittogym import TASKS, TorchEnv, core


def small(task="run", num_envs=1, **options):
    env = TorchEnv(task, num_envs, **{"particles": 200, "substeps": 20, "resolution": 4, **options})
    env.reset(seed=0)
    return env


def by_gradients(**options):
    return GradientPlannerConfig(**{"horizon": 3, "commit": 2, "iterations": 2, "noise": 0.0, **options})


def by_samples(**options):
    return CEMPlannerConfig(**{"horizon": 3, "commit": 2, "iterations": 2, "candidates": 8, "elites": 3, **options})


def drive(env, planner, steps):
    total = torch.zeros(env.num_envs)
    for _ in range(steps):
        action = planner.act() if planner else torch.zeros(env.num_envs, *env.action_shape)
        with torch.no_grad():
            total += env.step(action)[1]
    return total


# Rollouts -------------------------------------------------------------------------------------------------------------


def random_actions(env, steps):
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(steps, env.num_envs, *env.action_shape, generator=generator, dtype=env.dtype) - 1


@pytest.mark.parametrize("task", ["catch", "run", "shapematch"])
def test_rollout_earns_the_rewards_of_the_environment(task):
    env = small(task, 2, dtype="float64")
    start, actions = env.env_state, random_actions(env, 3)
    result = rollout(env.model, start, actions)
    steps = [env.step(action, soft=True) for action in actions]
    assert torch.equal(result.rewards, torch.stack([step[1] for step in steps]))
    assert torch.equal(result.true_rewards, torch.stack([step[-1]["true_reward"] for step in steps]))
    assert not result.ended.any() and torch.equal(result.state.particles.x, env.state.x)


def test_nothing_is_earned_after_the_end():
    def ends_soon_for_the_second(model, state, action):
        result = soft_step(model, state, action)
        return result._replace(terminated=torch.tensor([False, True]) & (result.state.steps == 2))

    env = small("run", 2)
    result = rollout(env.model, env.env_state, random_actions(env, 4), ends_soon_for_the_second)
    assert result.ended.tolist() == [False, True]
    for earned in (result.rewards, result.true_rewards):
        assert (earned != 0).tolist() == [[True, True], [True, True], [True, False], [True, False]]


# Planners -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["kick", "grow"])
def test_plan_by_gradients_beats_rest(task):
    env = small(task, substeps=60)
    planned = drive(env, GradientPlanner(env, GradientPlannerConfig(horizon=8, commit=4, iterations=4)), 12)
    assert float(planned) > float(drive(small(task, substeps=60), None, 12)) + 0.5


def test_plan_by_samples_beats_rest():
    env = small("obstacle", substeps=100)
    planner = CEMPlanner(env, CEMPlannerConfig(horizon=16, commit=16, iterations=4, candidates=24, noise_grid=2))
    assert float(drive(env, planner, 16)) > float(drive(small("obstacle", substeps=100), None, 16)) + 5.0
    assert planner.num_plans == 4 * 24 and planner.num_failed == 0


def test_simulations_of_a_batch_are_planned_apart():
    pair = small("kick", 2)
    together = GradientPlanner(pair, by_gradients())
    drive(pair, together, 4)
    for i in range(2):
        alone = small("kick")
        alone.reset(seed=i)
        drive(alone, GradientPlanner(alone, by_gradients()), 4)
        assert torch.allclose(pair.state.x[i], alone.state.x[0], atol=1e-5)
    assert not torch.allclose(pair.state.x[0], pair.state.x[1], atol=1e-4)
    assert together.num_plans == 2 * 2 * 3 and together.num_failed == 0


@torch.no_grad()  # a planner differentiates also where the caller does not
def test_planning_leaves_the_environment_alone_and_repeats_by_seed():
    plans = []
    for seed in (0, 0, 1):
        env = small()
        before = env.state
        plans.append(GradientPlanner(env, by_gradients(noise=0.1), seed=seed).plan())
        assert env.state is before
    assert torch.equal(plans[0], plans[1]) and not torch.equal(plans[0], plans[2])
    assert plans[0].abs().max() <= 1.0


def test_plan_goes_on_from_the_last():
    planner = GradientPlanner(small(), by_gradients(horizon=4, commit=1, learning_rate=1e-9, noise=0.5))
    first = planner.plan()
    planner.act()
    second = planner.plan()
    assert torch.allclose(second[:3], first[1:], atol=1e-6) and second[3].abs().max() > 0
    planner.reset()
    assert not torch.allclose(planner.plan()[:2], second[1:3], atol=1e-3)


@pytest.mark.parametrize(("layout", "place"), [("image", (0, 0)), ("grid", (0, 3))])
def test_action_layout_is_the_environments(layout, place):
    def upper_left(model, state, action):
        result = soft_step(model, state, action)
        value = result.actuation[:, 0, :8, -8:].mean((1, 2))  # small x, large y
        return result._replace(reward=value, true_reward=value.detach())

    config = by_gradients(horizon=1, commit=1, iterations=1)
    plan = GradientPlanner(small(action_layout=layout), config, step=upper_left).plan()[0, 0, 0]
    assert float(plan[place]) == pytest.approx(0.6, rel=1e-3) and plan[3, 0] == plan[3, 3] == 0


@pytest.mark.parametrize(("termination_steps", "charged"), [(5.0, 5), (1000.0, 28)])
def test_early_end_is_charged_at_the_mean_reward_of_a_step(termination_steps, charged):
    def ends(model, state, action):
        result = soft_step(model, state, action)
        reward = torch.full_like(result.reward, 1.5)
        return result._replace(reward=reward, true_reward=reward, terminated=result.state.steps == 2)

    env = small("shapematch", substeps=1)
    config = by_gradients(horizon=2, commit=1, termination_steps=termination_steps, split_weight=0.0)
    smooth, value = GradientPlanner(env, config, step=ends)._returns(
        env.env_state, torch.zeros(2, 1, *env.action_shape)
    )
    assert env.spec.horizon == 30 and float(smooth) == 3.0
    assert float(value) == pytest.approx(3.0 - 1.5 * charged)


def test_plans_that_are_not_finite_are_counted_and_not_carried_out(monkeypatch):
    env, calls = small("run", 2), []
    planner = GradientPlanner(env, by_gradients(horizon=2, commit=1, learning_rate=0.01))
    returns = planner._returns

    def breaks(start, plan):
        smooth, value = returns(start, plan)
        calls.append(plan.detach().clone())
        spoilt = torch.tensor([0.0, torch.nan if len(calls) > 1 else 0.0])
        return smooth + spoilt, value + spoilt

    monkeypatch.setattr(planner, "_returns", breaks)
    plan = planner.plan()
    assert planner.num_failed == 2 and planner.num_plans == 6
    assert torch.equal(plan[:, 1], calls[0][:, 1])  # the only one whose value was finite
    assert torch.equal(calls[2][:, 1], calls[0][:, 1])  # the search went on from there
    assert plan.isfinite().all() and not torch.equal(calls[2][:, 0], calls[0][:, 0])


def test_a_search_without_any_finite_gradient_warns(monkeypatch):
    planner = GradientPlanner(small(), by_gradients())
    returns = planner._returns

    def without_derivative(start, plan):
        smooth, value = returns(start, plan)
        return smooth + (smooth - smooth.detach()).square().sqrt(), value

    monkeypatch.setattr(planner, "_returns", without_derivative)
    with pytest.warns(UserWarning, match="no gradient of a plan was finite"):
        planner.plan()


def test_spread_near_the_limit_costs():
    env = small("run")
    plan, spread = torch.zeros(1, 1, *env.action_shape), float(env.env_state.start.radius_of_gyration)
    for stretch in (1.0, 0.094 / spread):
        env.state.x[:] = 0.3 + stretch * (env.state.x - env.state.x.mean(1))
        free, charged = (
            torch.stack(GradientPlanner(env, by_gradients(split_weight=weight))._returns(env.env_state, plan))
            for weight in (0.0, 300.0)
        )
        cost = 300.0 * max(0.0, stretch * spread / 0.1 - 0.8) ** 2
        assert (free - charged).flatten().tolist() == pytest.approx([cost, cost], rel=0.05, abs=1e-6)


def test_clipping_limits_steps_to_medians():
    gradient = torch.zeros(8, 2, 2, 1, 1)
    gradient[:5, 0, 0, 0, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0])  # steps after the end do not count
    clipped = clip_steps(gradient, 3.0)
    assert clipped[:5, 0, 0, 0, 0].tolist() == pytest.approx([1.0, 2.0, 3.0, 4.0, 9.0])
    assert (clipped[:, 1] == 0).all()


def wanted(target):
    """Reward a step for how close the muscles' field is to a pattern of every simulation (B, 1, 1, 1), or all."""

    def step(model, state, action):
        result = core.step(model, state, action)
        pattern = target.repeat_interleave(len(action) // len(target), 0)
        value = -(result.actuation / 45.0 - pattern).square().mean((1, 2, 3))
        return result._replace(reward=value, true_reward=value)

    return step


def test_samples_find_what_every_simulation_wants():
    target = torch.tensor([0.6, -0.4]).view(2, 1, 1, 1)
    config = by_samples(horizon=2, commit=1, iterations=12, candidates=40, elites=6, noise_grid=1, noise=0.0)
    plan = CEMPlanner(small("run", 2, substeps=1), config, step=wanted(target)).plan()
    assert plan.shape == (2, 2, 2, 4, 4) and plan.abs().max() <= 1.0
    assert (plan.mean((0, 2, 3, 4)) - target.flatten()).abs().max() < 0.1
    with pytest.raises(ConfigError, match="noise_grid must be at most 4"):
        CEMPlanner(small("run", substeps=1), by_samples(noise_grid=5))


def test_distribution_moves_to_the_elites_that_are_finite():
    planner = CEMPlanner(small("run", substeps=1), by_samples(momentum=0.25))
    elites = torch.tensor([-0.2, 0.6, 0.9]).view(1, 1, 3, 1, 1, 1).expand(3, 1, 3, 2, 4, 4)
    mean, std = torch.full((3, 1, 2, 4, 4), 0.4), torch.full((3, 1, 2, 4, 4), 0.8)
    mean, std = planner._refit(mean, std, elites, torch.tensor([[True, True, False]]))
    torch.testing.assert_close(mean, torch.full_like(mean, 0.25 * 0.4 + 0.75 * 0.2))
    torch.testing.assert_close(std, torch.full_like(std, 0.25 * 0.8 + 0.75 * 0.4))


@pytest.mark.parametrize("best", [0.25, 0.0])
def test_what_is_kept_of_a_plan_and_rest_are_tried(best):
    config = by_samples(noise=0.3, initial_std=5.0, iterations=1)
    planner = CEMPlanner(small("run", substeps=1), config, step=wanted(torch.full((1, 1, 1, 1), best)))
    if best:
        planner._plan, planner._step = torch.full_like(planner._plan, best), 0
    assert (planner.plan() == best).all()


def test_samples_that_are_not_finite_are_counted_and_no_elites(monkeypatch):
    planner = CEMPlanner(small("run", 2), by_samples(candidates=4))
    returns = planner._returns

    def breaks(start, plan):
        smooth, value = returns(start, plan)
        return smooth, value + torch.tensor([0.0, torch.nan, torch.nan, 0.0, *[torch.inf] * 4])  # all of the second

    monkeypatch.setattr(planner, "_returns", breaks)
    plan = planner.plan()
    assert planner.num_failed == 2 * 6 and planner.num_plans == 2 * 8
    assert plan.isfinite().all() and plan[:, 0].abs().max() > 0 and (plan[:, 1] == 0).all()


# Planned episodes -----------------------------------------------------------------------------------------------------

PLANNED = MPCConfig(
    task="kick", device="cpu", grid=4, num_envs=1, particles=100, substeps=2, horizon=3, commit=2, iterations=1
)


def test_record_repeats_the_episode():
    config = replace(PLANNED, dtype="float64")
    mpc = MPC(config)
    learn(mpc, 4)
    env, memory = make_torch_env(config, 4, 1), None
    images, _ = env.reset(seed=0)
    for _ in range(4):
        action, memory = mpc.trained_policy.predict(images.numpy(), memory)
        env.step(torch.as_tensor(action))
    assert torch.equal(env.state.x, mpc.env.state.x)


def test_a_reward_that_is_not_finite_ends_the_planning(own_task):
    task = own_task(lambda step: (step.start.com - step.now.com)[:, 1].abs().neg().sqrt())  # NaN once it has moved
    expected = pytest.raises(NonFiniteError, match="the reward function of the task returned NaN")
    with pytest.warns(UserWarning, match="no gradient of a plan was finite"), expected:
        MPC(replace(PLANNED, task=task)).update()


def test_learning_stops_with_the_episode():
    mpc = MPC(PLANNED)
    learn(mpc, 3)
    mpc.env.state.x[..., 0] -= 1.0  # behind the limit
    rows = learn(mpc, 10)
    assert mpc.finished and mpc.num_timesteps == 4 == len(mpc.actions)
    assert rows[-1]["train/return"] == mpc.total_reward and rows[-1]["train/plans"] == 4
    assert learn(mpc, 5) == []


# Planning in a cheaper simulation -------------------------------------------------------------------------------------


def pair(task, particles, seed=0):
    env = TorchEnv(task, num_envs=2, particles=particles, substeps=10)
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("task", TASKS)
def test_surrogate_stands_for_the_same_robot(task):
    large, cheap = pair(task, 900), pair(task, 150)
    surrogate = Surrogate(large, cheap)
    for _ in range(3):
        large.step(0.5 * torch.ones(2, *large.action_shape))
    surrogate.sync(large.env_state)
    robot, body = (env.state.x[:, : env.model.num_robot_particles] for env in (cheap, large))
    torch.testing.assert_close(robot.mean(1), body.mean(1), atol=4e-3, rtol=0)
    torch.testing.assert_close(robot.std(1), body.std(1), atol=4e-3, rtol=0)
    one, other = (env.step(torch.zeros(2, *large.action_shape))[1] for env in (cheap, large))
    assert torch.equal(cheap.env_state.steps, large.env_state.steps)
    if task != "shapematch":  # so few particles leave holes in a silhouette
        torch.testing.assert_close(one, other, atol=0.5, rtol=0.05)


def test_each_particle_stands_for_another_of_its_body():
    large, cheap = pair("kick", 400), pair("kick", 300, seed=5)
    chosen = Surrogate(large, cheap).indices
    count, few = large.model.num_robot_particles, cheap.model.num_robot_particles
    assert all(len(set(row.tolist())) == len(row) for row in chosen)
    assert bool((chosen[:, :few] < count).all() and (chosen[:, few:] >= count).all())


def test_surrogate_takes_over_constants_and_memory_but_for_numbers_of_particles():
    large, cheap = pair("grow", 400), pair("grow", 100)
    surrogate, tip = Surrogate(large, cheap), cheap.env_state.task_state["tip"]
    own = torch.linspace(300.0, 600.0, large.num_particles).expand(2, -1)
    large.reset(seed=0, options={"physics": {"mu": own, "gravity": torch.tensor([0.0, -5.0])}})
    phase = torch.tensor([3, 4])
    surrogate.sync(replace(large.env_state, task_state={**large.env_state.task_state, "phase": phase}))
    physics, memory = cheap.env_state.physics, cheap.env_state.task_state
    assert torch.equal(physics["mu"][1], own[1][surrogate.indices[1]]) and physics["gravity"].shape == (2, 2)
    assert torch.equal(memory["tip"], tip) and torch.equal(memory["phase"], phase)


def test_plans_are_tried_in_longer_substeps_and_carried_out_in_the_tasks_own():
    """With the same particles the surrogate starts from the very state that is planned for."""
    config = replace(PLANNED, task="run", particles=300, substeps=None, dtype="float64")
    assert MPC(config).surrogate is None
    mpc = MPC(replace(config, train_dt=2e-4))
    assert mpc.env.model.solver.dt == 1e-4 and mpc.planner.env.model.solver.dt == 2e-4
    learn(mpc, 2)
    before = mpc.env.state
    learn(mpc, 1)
    assert torch.equal(mpc.planner.env.state.x, before.x) and torch.equal(mpc.planner.env.state.F, before.F)
