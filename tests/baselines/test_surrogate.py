"""Planning in a simulation with fewer particles than the one that the plan is for."""

from dataclasses import replace

import pytest
import torch

from baselines import MPC, GradientPlannerConfig
from baselines.planning.mpc import MPCConfig
from baselines.planning.surrogate import Surrogate
from cfp.sections import EnvironmentConfig
from dittogym import TASKS, TorchEnv

ENVIRONMENT = EnvironmentConfig(num_envs=1, particles=600, substeps=2)
PLANNER = GradientPlannerConfig(horizon=3, commit=2, iterations=1)
CONFIG = MPCConfig(task="grow", device="cpu", grid=4, environment=ENVIRONMENT, planner=PLANNER)


def make(task: str, particles: int, seed: int = 0) -> TorchEnv:
    env = TorchEnv(task, num_envs=2, particles=particles, substeps=10)
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("task", TASKS)
def test_stands_for_the_same_robot(task: str) -> None:
    large, small = make(task, 900), make(task, 150)
    surrogate = Surrogate(large, small)
    for _ in range(3):
        large.step(0.5 * torch.ones(2, *large.action_shape))
    surrogate.sync(large.env_state)
    robot, body = (env.state.x[:, : env.model.num_robot_particles] for env in (small, large))
    torch.testing.assert_close(robot.mean(1), body.mean(1), atol=4e-3, rtol=0)
    torch.testing.assert_close(robot.std(1), body.std(1), atol=4e-3, rtol=0)
    mass = [
        sum(part.count * part.mass for part in env.model.solver.bodies if isinstance(part.mass, float))
        for env in (large, small)
    ]
    assert mass[0] == pytest.approx(mass[1])
    one, other = (env.step(torch.zeros(2, *large.action_shape))[1] for env in (small, large))
    assert torch.equal(small.env_state.steps, large.env_state.steps)
    if task != "shapematch":  # so few particles leave holes in a silhouette
        torch.testing.assert_close(one, other, atol=0.5, rtol=0.05)


def test_each_stands_for_another() -> None:
    large, small = make("kick", 400), make("kick", 300, seed=5)
    chosen = Surrogate(large, small).indices
    count = large.model.num_robot_particles
    assert all(len(set(row.tolist())) == len(row) for row in chosen)
    few = small.model.num_robot_particles
    assert bool((chosen[:, :few] < count).all() and (chosen[:, few:] >= count).all())


def test_takes_over_constants_of_particles() -> None:
    large, small = make("run", 400), make("run", 100)
    own = torch.linspace(300.0, 600.0, 400).expand(2, 400)
    large.reset(seed=0, options={"physics": {"mu": own, "gravity": torch.tensor([0.0, -5.0])}})
    surrogate = Surrogate(large, small)
    surrogate.sync(large.env_state)
    physics = small.env_state.physics
    assert torch.equal(physics["mu"][1], own[1][surrogate.indices[1]]) and physics["gravity"].shape == (2, 2)
    small.step(torch.zeros(2, *small.action_shape))


def test_takes_over_memory_but_for_numbers_of_particles() -> None:
    large, small = make("grow", 400), make("grow", 100)
    surrogate, tip = Surrogate(large, small), small.env_state.task_state["tip"]
    phase = torch.tensor([3, 4])
    surrogate.sync(replace(large.env_state, task_state={**large.env_state.task_state, "phase": phase}))
    assert torch.equal(small.env_state.task_state["tip"], tip)
    assert torch.equal(small.env_state.task_state["phase"], phase)


def test_plans_are_tried_in_longer_substeps_and_carried_out_in_the_tasks_own() -> None:
    """With the same particles the surrogate starts from the very state that is planned for."""
    config = replace(CONFIG, environment=EnvironmentConfig(1, 300, dtype="float64"))
    assert MPC(replace(config, train_dt=1e-4)).surrogate is None
    mpc = MPC(replace(config, task="run"))
    assert mpc.env.model.solver.dt == 1e-4 and mpc.planner.env.model.solver.dt == 2e-4
    mpc.learn(2)
    before = mpc.env.state
    mpc.learn(1)
    assert torch.equal(mpc.planner.env.state.x, before.x) and torch.equal(mpc.planner.env.state.F, before.F)


def test_plans_in_it_are_carried_out_in_the_other() -> None:
    config = replace(CONFIG, train_particles=80)
    first, second = MPC(config), MPC(config)
    first.learn(5)
    assert first.env.num_particles == 600 and first.planner.env.num_particles == 80
    second.load_state_dict(first.state_dict())
    second.num_timesteps = 5
    for mpc in (first, second):
        mpc.learn(2)
    assert torch.equal(first.actions, second.actions) and bool(first.actions.any())
