"""The gradient planner on tiny robots, and on rewards whose best plan is known."""

import pytest
import torch

from baselines.common.rollout import soft_step
from baselines.planning.gradient import Planner, PlannerConfig, _clipped
from cfp.errors import ConfigError
from dittogym import TorchEnv


def small(task: str = "run", num_envs: int = 1, **options) -> TorchEnv:
    env = TorchEnv(task, num_envs, **{"particles": 200, "substeps": 20, "resolution": 4, **options})
    env.reset(seed=0)
    return env


def drive(env: TorchEnv, planner: Planner | None, steps: int) -> torch.Tensor:
    total = torch.zeros(env.num_envs)
    for _ in range(steps):
        action = planner.act() if planner else torch.zeros(env.num_envs, *env.action_shape)
        with torch.no_grad():
            total += env.step(action)[1]
    return total


@pytest.mark.parametrize(("task", "more"), [("kick", 0.5), ("grow", 0.5)])
def test_planned_episode_beats_rest(task: str, more: float) -> None:
    env = small(task, substeps=60)
    planned = drive(env, Planner(env, PlannerConfig(horizon=8, commit=4, iterations=4)), 12)
    assert float(planned) > float(drive(small(task, substeps=60), None, 12)) + more


def test_simulations_of_a_batch_are_planned_apart() -> None:
    config = PlannerConfig(horizon=3, commit=2, iterations=2, noise=0.0)
    pair = small("kick", 2)
    together = Planner(pair, config)
    drive(pair, together, 4)
    for i in range(2):
        alone = small("kick")
        alone.reset(seed=i)
        drive(alone, Planner(alone, config), 4)
        assert torch.allclose(pair.state.x[i], alone.state.x[0], atol=1e-5)
    assert not torch.allclose(pair.state.x[0], pair.state.x[1], atol=1e-4)
    assert together.plans == 2 * 2 * 3 and together.failed == 0


def test_planning_leaves_the_environment_alone_and_repeats_by_seed() -> None:
    plans = []
    for seed in (0, 0, 1):
        env = small()
        before = env.state
        plans.append(Planner(env, PlannerConfig(horizon=3, commit=1, iterations=1), seed=seed).plan())
        assert env.state is before
    assert torch.equal(plans[0], plans[1]) and not torch.equal(plans[0], plans[2])
    assert plans[0].abs().max() <= 1.0 and not plans[0].requires_grad


def test_act_plans_the_same_where_the_caller_wants_no_gradients() -> None:
    config = PlannerConfig(horizon=3, commit=1, iterations=2)
    wanted = Planner(small(), config).act()
    with torch.no_grad():
        assert torch.equal(Planner(small(), config).act(), wanted)


def test_plan_goes_on_from_the_last() -> None:
    config = PlannerConfig(horizon=4, commit=1, iterations=1, learning_rate=1e-9, noise=0.5)
    env = small()
    planner = Planner(env, config)
    first = planner.plan()
    planner.act()
    second = planner.plan()
    assert torch.allclose(second[:3], first[1:], atol=1e-6) and second[3].abs().max() > 0
    planner.forget()
    assert not torch.allclose(planner.plan()[:2], second[1:3], atol=1e-3)


def test_state_of_a_planner_goes_on_the_same() -> None:
    config = PlannerConfig(horizon=4, commit=3, iterations=1)
    env = small()
    planner = Planner(env, config)
    planner.act()
    state, moment = planner.state_dict(), env.save()
    wanted = [planner.act() for _ in range(4)]
    env.load(moment)
    other = Planner(env, config, seed=7)
    other.load_state_dict(state)
    assert all(torch.equal(other.act(), action) for action in wanted)
    assert (other.failed, other.plans) == (planner.failed, planner.plans)


@pytest.mark.parametrize(("layout", "place"), [("image", (0, 0)), ("grid", (0, 3))])
def test_action_layout_is_the_environments(layout: str, place: tuple[int, int]) -> None:
    def upper_left(model, state, action):
        result = soft_step(model, state, action)
        value = result.actuation[:, 0, :8, -8:].mean((1, 2))  # small x, large y
        return result._replace(reward=value, true_reward=value.detach())

    env = small(action_layout=layout)
    config = PlannerConfig(horizon=1, commit=1, iterations=1, noise=0.0)
    plan = Planner(env, config, judge=upper_left).plan()[0, 0, 0]
    assert float(plan[place]) == pytest.approx(0.6, rel=1e-3) and plan[3, 0] == plan[3, 3] == 0


def test_ending_the_episode_forgoes_what_comes_after() -> None:
    def ends_if_contracted(model, state, action):
        result = soft_step(model, state, action)
        value = result.actuation[:, 0].mean((1, 2)) / 45.0
        return result._replace(reward=value, true_reward=1.0 + value.detach(), terminated=value > 0.3)

    chosen = {}
    for forgone in (0.0, 5.0):
        env = small()
        config = PlannerConfig(horizon=1, commit=1, iterations=2, noise=0.0, learning_rate=0.25, forgone=forgone)
        chosen[forgone] = float(Planner(env, config, judge=ends_if_contracted).plan()[0, 0, 0].mean())
    assert chosen[0.0] == pytest.approx(0.5, abs=0.02) and chosen[5.0] == pytest.approx(0.25, abs=0.02)


def test_plans_end_with_the_episode() -> None:
    env = small("shapematch", substeps=1)
    planner = Planner(env, PlannerConfig(horizon=16, commit=8, iterations=1))
    lengths = []
    for step in range(32):
        env.step(planner.act())
        env.detach()
        if step % 8 == 0:
            lengths.append(len(planner._ahead))
    assert lengths == [16, 16, 14, 6] and env.env_state.steps.item() == 32


def test_plans_that_are_not_finite_are_counted_and_not_carried_out(monkeypatch) -> None:
    env = small("run", 2)
    planner = Planner(env, PlannerConfig(horizon=2, commit=1, iterations=2, noise=0.0, learning_rate=0.01))
    judge, calls = planner._judge, []

    def breaks(start, plan):
        climbed, value = judge(start, plan)
        calls.append(plan.detach().clone())
        spoilt = torch.tensor([0.0, torch.nan if len(calls) > 1 else 0.0])
        return climbed + spoilt, value + spoilt

    monkeypatch.setattr(planner, "_judge", breaks)
    plan = planner.plan()
    assert planner.failed == 2 and planner.plans == 6
    assert torch.equal(plan[:, 1], calls[0][:, 1])  # the only one whose value was finite
    assert torch.equal(calls[2][:, 1], calls[0][:, 1])  # the search went on from there
    assert plan.isfinite().all() and not torch.equal(calls[2][:, 0], calls[0][:, 0])


def test_spread_near_the_limit_costs() -> None:
    env = small("run")
    plan = torch.zeros(1, 1, *env.action_shape)
    spread = float(env.env_state.start.split)
    for stretch in (1.0, 0.094 / spread):
        env.state.x[:] = 0.3 + stretch * (env.state.x - env.state.x.mean(1))
        values = []
        for margin in (0.0, 300.0):
            planner = Planner(env, PlannerConfig(horizon=1, commit=1, margin=margin))
            values.append(torch.stack(planner._judge(env.env_state, plan)))
        cost = 300.0 * max(0.0, stretch * spread / 0.1 - 0.8) ** 2
        assert (values[0] - values[1]).flatten().tolist() == pytest.approx([cost, cost], rel=0.05, abs=1e-6)


def test_clipping_limits_steps_to_medians() -> None:
    gradient = torch.zeros(5, 2, 2, 1, 1)
    gradient[:, 0, 0, 0, 0] = torch.tensor([1.0, 2.0, 3.0, 4.0, 100.0])
    clipped = _clipped(gradient, 3.0)
    assert clipped[:, 0, 0, 0, 0].tolist() == pytest.approx([1.0, 2.0, 3.0, 4.0, 9.0])
    assert (clipped[:, 1] == 0).all()


@pytest.mark.parametrize("ends", [1, 2, 3, 8])
def test_clipping_does_not_count_steps_after_the_end(ends: int) -> None:
    gradient = torch.zeros(8, 1, 2, 1, 1)
    gradient[:ends, 0, 0] = 1.0
    assert torch.equal(_clipped(gradient, 3.0), gradient)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"commit": 17}, "commit: got 17, allowed 1 to the horizon, 16"),
        ({"iterations": 0}, "iterations: got 0, allowed more than 0"),
        ({"noise": -0.1}, "noise: got -0.1, allowed 0 or more"),
        ({"forgone": float("nan")}, "forgone: got nan"),
    ],
)
def test_bad_options(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Planner(small(), PlannerConfig(**options))
