"""The planner without gradients, on tiny robots and on rewards whose best plan is known."""

import pytest
import torch
from test_planning import drive, small

from baselines import CEMPlanner, CEMPlannerConfig
from cfp.errors import ConfigError
from dittogym import core


def quick(**options) -> CEMPlannerConfig:
    return CEMPlannerConfig(**{"horizon": 3, "commit": 2, "iterations": 2, "candidates": 8, "elites": 3, **options})


def test_planned_episode_beats_rest() -> None:
    env = small("obstacle", substeps=100)
    planner = CEMPlanner(env, CEMPlannerConfig(horizon=16, commit=16, iterations=4, candidates=24, noise_grid=2))
    assert float(drive(env, planner, 16)) > float(drive(small("obstacle", substeps=100), None, 16)) + 5.0
    assert planner.num_plans == 4 * 24 and planner.num_failed == 0


def wanted(target: torch.Tensor):
    """Reward a step for how close the muscles' field is to a pattern of every simulation (B, 1, 1, 1), or all."""

    def step(model, state, action):
        result = core.step(model, state, action)
        pattern = target.repeat_interleave(len(action) // len(target), 0)
        value = -(result.actuation / 45.0 - pattern).square().mean((1, 2, 3))
        return result._replace(reward=value, true_reward=value)

    return step


def test_search_finds_what_every_simulation_wants() -> None:
    env = small("run", 2, substeps=1)
    target = torch.tensor([0.6, -0.4]).view(2, 1, 1, 1)
    config = CEMPlannerConfig(horizon=2, commit=1, iterations=12, candidates=40, noise_grid=1, noise=0.0)
    plan = CEMPlanner(env, config, step=wanted(target)).plan()
    assert plan.shape == (2, 2, 2, 4, 4) and plan.abs().max() <= 1.0
    assert (plan.mean((0, 2, 3, 4)) - target.flatten()).abs().max() < 0.1


def test_noise_of_more_cells_than_actions_is_refused() -> None:
    with pytest.raises(ConfigError, match="noise_grid must be at most 4, the action grid, got 5"):
        CEMPlanner(small("run", substeps=1), quick(noise_grid=5)).plan()


def test_simulations_of_a_batch_are_planned_apart() -> None:
    noise = torch.linspace(-1.5, 1.5, 8).view(1, 1, 8, 1, 1, 1).expand(3, 1, 8, 2, 4, 4)
    target = torch.tensor([0.6, -0.4]).view(2, 1, 1, 1)

    class Same(CEMPlanner):
        def _noise(self, plan):
            return noise.expand(-1, plan.shape[1], -1, -1, -1, -1)

    together = Same(small("kick", 2, substeps=1), quick(noise=0.0), step=wanted(target)).plan()
    for i in range(2):
        alone = small("kick", substeps=1)
        alone.reset(seed=i)
        plan = Same(alone, quick(noise=0.0), step=wanted(target[i : i + 1])).plan()
        assert torch.allclose(together[:, i], plan[:, 0], atol=1e-6)
    assert not torch.allclose(together[:, 0], together[:, 1], atol=1e-3)


def test_distribution_moves_to_the_elites_that_are_finite() -> None:
    planner = CEMPlanner(small("run", substeps=1), quick(momentum=0.25))
    elites = torch.tensor([-0.2, 0.6, 0.9]).view(1, 1, 3, 1, 1, 1).expand(3, 1, 3, 2, 4, 4)
    mean, std = torch.full((3, 1, 2, 4, 4), 0.4), torch.full((3, 1, 2, 4, 4), 0.8)
    mean, std = planner._refit(mean, std, elites, torch.tensor([[True, True, False]]))
    torch.testing.assert_close(mean, torch.full_like(mean, 0.25 * 0.4 + 0.75 * 0.2))
    torch.testing.assert_close(std, torch.full_like(std, 0.25 * 0.8 + 0.75 * 0.4))


def test_plan_is_never_worse_than_what_is_kept() -> None:
    env = small("run", substeps=1)
    step = wanted(torch.full((1, 1, 1, 1), 0.25))
    planner = CEMPlanner(env, quick(noise=0.3, initial_std=5.0, iterations=1), step=step)
    planner._plan = torch.full_like(planner._plan, 0.25)
    planner._step = 0  # all of it is kept, and it is the best there can be
    assert (planner.plan() == 0.25).all()


def test_rest_is_tried() -> None:
    env = small("run", substeps=1)
    planner = CEMPlanner(env, quick(initial_std=5.0, noise=0.5), step=wanted(torch.zeros(1, 1, 1, 1)))
    assert (planner.plan() == 0).all()


def test_plans_that_are_not_finite_are_counted_and_no_elites(monkeypatch) -> None:
    env = small("run", 2)
    planner = CEMPlanner(env, quick(candidates=4, elites=3))
    returns = planner._returns

    def breaks(start, plan):
        climbed, value = returns(start, plan)
        spoilt = torch.tensor([0.0, torch.nan, torch.nan, 0.0, *[torch.inf] * 4])  # all of the second simulation
        return climbed, value + spoilt

    monkeypatch.setattr(planner, "_returns", breaks)
    plan = planner.plan()
    assert planner.num_failed == 2 * 6 and planner.num_plans == 2 * 8
    assert plan.isfinite().all() and plan[:, 0].abs().max() > 0 and (plan[:, 1] == 0).all()


@pytest.mark.parametrize(
    ("option", "value"),
    [("elites", 9), ("elites", 1), ("noise_correlation", 1.0), ("momentum", -0.1), ("initial_std", 0.0), ("commit", 4)],
)
def test_bad_options_are_named(option: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{option}.*{value}"):
        CEMPlanner(small(), quick(**{option: value}))
