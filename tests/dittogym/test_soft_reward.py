"""Smooth counterparts of the rewards: their gradients, where they set in, and how far they are from the true ones."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from tiny import TASKS, actions, assert_same_bits, begun, everything, normal, stir, tiny
from torch import Tensor

from dittogym import TorchEnv, core
from dittogym.core import EnvState
from dittogym.rewards import EXACT, SELECTION_WIDTH, SMOOTH, distance, nearest
from dittogym.tasks.grow import GOAL
from dittogym.tasks.slot import FALLEN, FAR_SIDE

#: Tasks whose reward looks at velocities.
WITH_SPEED = ("run", "kick", "dig", "obstacle", "slot")


def reward(env: TorchEnv, state: EnvState, soft: bool = False) -> Tensor:
    """The task's reward (B,) of a state, under a full actuation."""
    field = torch.ones(env.num_envs, 2, env.spec.patch, env.spec.patch, dtype=env.dtype)
    return core.judge(env.model, core.look(env.model, state, field), soft=soft).reward


def placed(env: TorchEnv, x: Tensor, v: Tensor | None = None) -> EnvState:
    """The present moment of the environment with other positions and velocities."""
    particles = env.state
    return replace(env.env_state, particles=replace(particles, x=x, v=particles.v if v is None else v))


def at_threshold(task: str) -> tuple[TorchEnv, Tensor, Tensor]:
    """A task with the first simulation where its reward jumps or bends, and random velocities."""
    env = begun(tiny(task, 2))
    stir(env)
    x, v, robot = env.state.x.clone(), env.state.v.clone(), env.model.num_robot_particles
    if task == "grow":
        x[0] += torch.tensor(GOAL) + 0.02 - x[0][env.env_state.task_state["tip"][0]].mean(0)
    elif task == "slot":
        x[0, robot:] += torch.tensor([FAR_SIDE, FALLEN]) - x[0, robot:].mean(0)
        v[0, :, 0] += 1.45
    elif task == "catch":
        x[0, robot:] += torch.tensor([0.4, -0.0])
    else:
        v[0, :, 0] += 1.7
    if env.spec.split_limit is not None:
        centre, split = x[:, :robot].mean(1, keepdim=True), env.env_state.start.radius_of_gyration[:, None, None]
        x[1, :robot] = (centre + (x[:, :robot] - centre) * env.spec.split_limit / split)[1]
    return env, x, v


@pytest.mark.parametrize(("task", "name"), [*((task, "x") for task in TASKS), *((task, "v") for task in WITH_SPEED)])
def test_gradient_at_thresholds_against_central_differences(task: str, name: str) -> None:
    env, *given = at_threshold(task)
    which = ("x", "v").index(name)
    leaf, direction = given[which].requires_grad_(), normal(*given[which].shape, seed=1) + 1.0

    def total(value: Tensor) -> Tensor:
        values = [value if i == which else t for i, t in enumerate(given)]
        return (reward(env, placed(env, *values), soft=True) * torch.tensor([1.0, 0.7])).sum()

    slope = (torch.autograd.grad(total(leaf), leaf)[0] * direction).sum().item()
    with torch.no_grad():
        step = 1e-7
        ahead, behind = (total(leaf + side * step * direction).item() for side in (1, -1))
    assert slope == pytest.approx((ahead - behind) / (2 * step), rel=1e-5)
    assert abs(slope) > 0.1


def jumps(values: list[float]) -> float:
    """Largest change from one to the next as a share of the whole range."""
    steps = [abs(b - a) for a, b in pairwise(values)]
    return max(steps) / (max(values) - min(values))


@pytest.mark.parametrize("task", ["run", "grow", "slot"])
@torch.no_grad()
def test_soft_rewards_pass_thresholds_without_a_jump(task: str) -> None:
    """Tearing the robot, reaching GROW's goal, SLOT's cap falling, in 50 small steps."""
    env, x, _ = at_threshold(task)
    robot = env.model.num_robot_particles
    soft, true = [], []
    for k in range(50):
        z = x.clone()
        if task == "run":
            centre = z[:, :robot].mean(1, keepdim=True)
            z[:, :robot] = centre + (z[:, :robot] - centre) * (0.8 + 0.008 * k)
        elif task == "grow":
            z[0] += 0.05 - 0.0016 * k
        else:
            z[0, robot:, 1] += 0.05 - 0.002 * k
            z[0, robot:, 0] += 0.03
        element = 1 if task == "run" else 0
        state = placed(env, z)
        soft.append(reward(env, state, soft=True)[element].item())
        true.append(reward(env, state)[element].item())
    assert jumps(soft) < 0.12
    assert jumps(true) > 0.3


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_gap_from_rest(task: str) -> None:
    """Away from thresholds the soft reward is the true one; SHAPE MATCH counts pixels, and CATCH and SLOT particles."""
    env = begun(tiny(task, 2, particles=2000))
    gap = (reward(env, env.env_state, soft=True) - reward(env, env.env_state)).abs().max()
    bounds = {"shapematch": 2.5, "catch": 0.15, "slot": 0.6}
    assert gap <= bounds.get(task, 0.01)


@pytest.mark.parametrize("task", ["shapematch", "slot", "run"])
def test_step_with_soft_rewards(task: str) -> None:
    """The same simulation, judged twice; the gradient reaches back through several steps."""
    env, plain = begun(tiny(task, 2, resolution=8)), begun(tiny(task, 2, resolution=8))
    drive = (0.5 * actions(env, 2)).requires_grad_()
    total = torch.zeros(2, dtype=env.dtype)
    for action in drive:
        image, soft, terminated, truncated, info = env.step(action, soft=True)
        seen, true, their_end, their_limit, theirs = plain.step(action)
        total = total + soft
    assert torch.equal(info["true_reward"], true) and torch.equal(terminated, their_end)
    assert torch.equal(truncated, their_limit) and torch.equal(env.save().observation, seen)
    assert info["reward_terms"].keys() == theirs["reward_terms"].keys()
    assert torch.allclose(sum(info["reward_terms"].values()), soft)
    assert torch.equal(image, env.soft_observation())
    assert_same_bits(everything(env), everything(plain))
    (gradient,) = torch.autograd.grad(total.sum() + 1e-3 * image.sum(), drive)
    assert gradient.isfinite().all() and all(g.abs().max() > 0 for g in gradient)


def test_soft_limits() -> None:
    z = torch.linspace(-40.0, 60.0, 101, dtype=torch.float64)
    hard, soft = EXACT.clamp(z, -20.0, 30.0), SMOOTH.clamp(z, -20.0, 30.0)
    assert torch.equal(hard, z.clamp(-20.0, 30.0))
    assert (soft - hard).abs().max().item() == pytest.approx(1.5 * math.log(2))
    assert soft[40].item() == pytest.approx(0.0, abs=1e-7)
    assert (soft.diff() > 0).all()
    assert torch.equal(EXACT.clamp(z, high=30.0), z.clamp_max(30.0))
    assert EXACT.clamp(z) is z and SMOOTH.clamp(z) is z
    zero = SMOOTH.clamp(z / 50.0, 0.0, 1.0)
    assert (zero - (z / 50.0).clamp(0.0, 1.0)).abs().max().item() == pytest.approx(0.05 * math.log(2))
    relu = SMOOTH.clamp(z, 0.0, width=2.0)
    assert (relu - z.clamp_min(0.0)).abs().max().item() == pytest.approx(2.0 * math.log(2))
    assert EXACT.heaviside(torch.tensor([-1.0, 0.0, 1.0]), 0.1).tolist() == [0.0, 0.0, 1.0]
    near = SMOOTH.heaviside(torch.tensor([-0.4, 0.0, 0.4]), 0.1).tolist()
    assert near == pytest.approx([0.018, 0.5, 0.982], abs=1e-3)


def test_soft_split() -> None:
    split = torch.tensor([0.05, 0.1 - 1e-9, 0.1 + 1e-9, 0.15, 0.3], dtype=torch.float64)
    hard, soft = (ops.split_penalty(split, 0.1) for ops in (EXACT, SMOOTH))
    assert hard.tolist() == pytest.approx([0.0, 0.0, -4.0, -9.0, -16.0])
    assert soft.tolist() == pytest.approx([0.0, -2.0, -2.0, -9.0, -36.0], abs=1e-3)


def test_soft_choice_of_the_nearest() -> None:
    """Near the mean over the chosen; a particle fades in while it passes the edge."""
    x = torch.rand(2, 500, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    point = torch.full((2, 2), 0.3, dtype=torch.float64)
    hard = EXACT.mean_over_nearest(x, x, point, 0.2)
    assert torch.equal(hard, x.gather(1, nearest(x, point, 0.2)[..., None].expand(-1, -1, 2)).mean(1))
    soft = SMOOTH.mean_over_nearest(x, x, point, 0.2)
    assert (soft - hard).abs().max() < SELECTION_WIDTH
    alone = SMOOTH.mean_over_nearest(x[:, :1], x[:, :1], x[:, 0], 0.2)
    assert torch.allclose(alone, x[:, 0])


def test_distances_of_particles_and_of_averages() -> None:
    x, point = normal(3, 5, 2, seed=1), normal(3, 2, seed=2)
    expected = (x - point[:, None]).norm(dim=-1)
    torch.testing.assert_close(distance(x, point), expected)
    torch.testing.assert_close(distance(x[:, 1], point), expected[:, 1])
    torch.testing.assert_close(distance(x, point[0])[0], expected[0])
