"""The gradient planner on tiny robots, and on rewards whose best plan is known."""

import pytest
import torch

from baselines.common.rollout import soft_step
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig, clip_steps
from cfp.errors import ConfigError
from dittogym import TorchEnv


def small(task: str = "run", num_envs: int = 1, **options) -> TorchEnv:
    env = TorchEnv(task, num_envs, **{"particles": 200, "substeps": 20, "resolution": 4, **options})
    env.reset(seed=0)
    return env


def drive(env: TorchEnv, planner: GradientPlanner | None, steps: int) -> torch.Tensor:
    total = torch.zeros(env.num_envs)
    for _ in range(steps):
        action = planner.act() if planner else torch.zeros(env.num_envs, *env.action_shape)
        with torch.no_grad():
            total += env.step(action)[1]
    return total


@pytest.mark.parametrize(("task", "more"), [("kick", 0.5), ("grow", 0.5)])
def test_planned_episode_beats_rest(task: str, more: float) -> None:
    env = small(task, substeps=60)
    planned = drive(env, GradientPlanner(env, GradientPlannerConfig(horizon=8, commit=4, iterations=4)), 12)
    assert float(planned) > float(drive(small(task, substeps=60), None, 12)) + more


def test_simulations_of_a_batch_are_planned_apart() -> None:
    config = GradientPlannerConfig(horizon=3, commit=2, iterations=2, noise=0.0)
    pair = small("kick", 2)
    together = GradientPlanner(pair, config)
    drive(pair, together, 4)
    for i in range(2):
        alone = small("kick")
        alone.reset(seed=i)
        drive(alone, GradientPlanner(alone, config), 4)
        assert torch.allclose(pair.state.x[i], alone.state.x[0], atol=1e-5)
    assert not torch.allclose(pair.state.x[0], pair.state.x[1], atol=1e-4)
    assert together.num_plans == 2 * 2 * 3 and together.num_failed == 0


def test_planning_leaves_the_environment_alone_and_repeats_by_seed() -> None:
    plans = []
    for seed in (0, 0, 1):
        env = small()
        before = env.state
        plans.append(GradientPlanner(env, GradientPlannerConfig(horizon=3, commit=1, iterations=1), seed=seed).plan())
        assert env.state is before
    assert torch.equal(plans[0], plans[1]) and not torch.equal(plans[0], plans[2])
    assert plans[0].abs().max() <= 1.0 and not plans[0].requires_grad


def test_act_plans_the_same_where_the_caller_wants_no_gradients() -> None:
    config = GradientPlannerConfig(horizon=3, commit=1, iterations=2)
    wanted = GradientPlanner(small(), config).act()
    with torch.no_grad():
        assert torch.equal(GradientPlanner(small(), config).act(), wanted)


def test_plan_goes_on_from_the_last() -> None:
    config = GradientPlannerConfig(horizon=4, commit=1, iterations=1, learning_rate=1e-9, noise=0.5)
    env = small()
    planner = GradientPlanner(env, config)
    first = planner.plan()
    planner.act()
    second = planner.plan()
    assert torch.allclose(second[:3], first[1:], atol=1e-6) and second[3].abs().max() > 0
    planner.reset()
    assert not torch.allclose(planner.plan()[:2], second[1:3], atol=1e-3)


def test_state_of_a_planner_goes_on_the_same() -> None:
    config = GradientPlannerConfig(horizon=4, commit=3, iterations=1)
    env = small()
    planner = GradientPlanner(env, config)
    planner.act()
    state, moment = planner.state_dict(), env.save()
    wanted = [planner.act() for _ in range(4)]
    env.load(moment)
    other = GradientPlanner(env, config, seed=7)
    other.load_state_dict(state)
    assert all(torch.equal(other.act(), action) for action in wanted)
    assert (other.num_failed, other.num_plans) == (planner.num_failed, planner.num_plans)


@pytest.mark.parametrize(("layout", "place"), [("image", (0, 0)), ("grid", (0, 3))])
def test_action_layout_is_the_environments(layout: str, place: tuple[int, int]) -> None:
    def upper_left(model, state, action):
        result = soft_step(model, state, action)
        value = result.actuation[:, 0, :8, -8:].mean((1, 2))  # small x, large y
        return result._replace(reward=value, true_reward=value.detach())

    env = small(action_layout=layout)
    config = GradientPlannerConfig(horizon=1, commit=1, iterations=1, noise=0.0)
    plan = GradientPlanner(env, config, step=upper_left).plan()[0, 0, 0]
    assert float(plan[place]) == pytest.approx(0.6, rel=1e-3) and plan[3, 0] == plan[3, 3] == 0


def test_ending_the_episode_forgoes_what_comes_after() -> None:
    def ends_if_contracted(model, state, action):
        result = soft_step(model, state, action)
        value = result.actuation[:, 0].mean((1, 2)) / 45.0
        return result._replace(reward=value, true_reward=1.0 + value.detach(), terminated=value > 0.3)

    chosen = {}
    for termination_steps in (0.0, 5.0):
        env = small()
        config = GradientPlannerConfig(
            horizon=1, commit=1, iterations=2, noise=0.0, learning_rate=0.25, termination_steps=termination_steps
        )
        chosen[termination_steps] = float(GradientPlanner(env, config, step=ends_if_contracted).plan()[0, 0, 0].mean())
    assert chosen[0.0] == pytest.approx(0.5, abs=0.02) and chosen[5.0] == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize(("termination_steps", "charged"), [(5.0, 5), (1000.0, 28)])
def test_early_end_is_charged_at_the_mean_reward_of_a_step(termination_steps: float, charged: int) -> None:
    def ends(model, state, action):
        result = soft_step(model, state, action)
        reward = torch.full_like(result.reward, 1.5)
        return result._replace(reward=reward, true_reward=reward, terminated=result.state.steps == 2)

    env = small("shapematch", substeps=1)
    config = GradientPlannerConfig(horizon=2, commit=1, termination_steps=termination_steps, split_weight=0.0)
    planner = GradientPlanner(env, config, step=ends)
    smooth, value = planner._returns(env.env_state, torch.zeros(2, 1, *env.action_shape))
    assert env.spec.horizon == 30 and float(smooth) == 3.0
    assert float(value) == pytest.approx(3.0 - 1.5 * charged)


def test_plans_end_with_the_episode() -> None:
    env = small("shapematch", substeps=1)
    planner = GradientPlanner(env, GradientPlannerConfig(horizon=16, commit=8, iterations=1))
    lengths = []
    for step in range(32):
        env.step(planner.act())
        env.detach()
        if step % 8 == 0:
            lengths.append(len(planner._plan))
    assert lengths == [16, 16, 14, 6] and env.env_state.steps.item() == 32


def test_plans_that_are_not_finite_are_counted_and_not_carried_out(monkeypatch) -> None:
    env = small("run", 2)
    planner = GradientPlanner(
        env, GradientPlannerConfig(horizon=2, commit=1, iterations=2, noise=0.0, learning_rate=0.01)
    )
    returns, calls = planner._returns, []

    def breaks(start, plan):
        climbed, value = returns(start, plan)
        calls.append(plan.detach().clone())
        spoilt = torch.tensor([0.0, torch.nan if len(calls) > 1 else 0.0])
        return climbed + spoilt, value + spoilt

    monkeypatch.setattr(planner, "_returns", breaks)
    plan = planner.plan()
    assert planner.num_failed == 2 and planner.num_plans == 6
    assert torch.equal(plan[:, 1], calls[0][:, 1])  # the only one whose value was finite
    assert torch.equal(calls[2][:, 1], calls[0][:, 1])  # the search went on from there
    assert plan.isfinite().all() and not torch.equal(calls[2][:, 0], calls[0][:, 0])


def test_a_search_without_any_finite_gradient_warns(monkeypatch) -> None:
    planner = GradientPlanner(small(), GradientPlannerConfig(horizon=2, commit=1, iterations=2))
    returns = planner._returns

    def without_derivative(start, plan):
        climbed, value = returns(start, plan)
        return climbed + (climbed - climbed.detach()).square().sqrt(), value

    monkeypatch.setattr(planner, "_returns", without_derivative)
    with pytest.warns(UserWarning, match="no gradient of a plan was finite: plans are not improved"):
        planner.plan()


def test_spread_near_the_limit_costs() -> None:
    env = small("run")
    plan = torch.zeros(1, 1, *env.action_shape)
    spread = float(env.env_state.start.radius_of_gyration)
    for stretch in (1.0, 0.094 / spread):
        env.state.x[:] = 0.3 + stretch * (env.state.x - env.state.x.mean(1))
        values = []
        for split_weight in (0.0, 300.0):
            planner = GradientPlanner(env, GradientPlannerConfig(horizon=1, commit=1, split_weight=split_weight))
            values.append(torch.stack(planner._returns(env.env_state, plan)))
        cost = 300.0 * max(0.0, stretch * spread / 0.1 - 0.8) ** 2
        assert (values[0] - values[1]).flatten().tolist() == pytest.approx([cost, cost], rel=0.05, abs=1e-6)


def test_clipping_limits_steps_to_medians() -> None:
    gradient = torch.zeros(5, 2, 2, 1, 1)
    gradient[:, 0, 0, 0, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0])
    clipped = clip_steps(gradient, 3.0)
    assert clipped[:, 0, 0, 0, 0].tolist() == pytest.approx([1.0, 2.0, 3.0, 4.0, 9.0])
    assert (clipped[:, 1] == 0).all()


@pytest.mark.parametrize("ends", [1, 2, 3, 8])
def test_clipping_does_not_count_steps_after_the_end(ends: int) -> None:
    gradient = torch.zeros(8, 1, 2, 1, 1)
    gradient[:ends, 0, 0] = 1.0
    assert torch.equal(clip_steps(gradient, 3.0), gradient)


@pytest.mark.parametrize(
    ("option", "value"),
    [("commit", 17), ("iterations", 0), ("noise", -0.1), ("termination_steps", float("nan")), ("split_weight", -1.0)],
)
def test_bad_options_are_named(option: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{option}.*{value}"):
        GradientPlanner(small(), GradientPlannerConfig(**{option: value}))
