"""Constants of the matter given at a reset: what each does, how long it holds, and its gradient."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import actions, assert_same_bits, set_particles, stir, tiny

import dittogym
import torchmpm
from dittogym import TorchEnv
from dittogym.physics import NAMES

DT = 1e-4
OWN = {name: getattr(dittogym.make_spec("kick"), name) for name in NAMES if name != "mass"} | {"mass": 1.0}


def given(env: TorchEnv, **physics: object) -> TorchEnv:
    """The environment after a reset with these constants."""
    env.reset(seed=0, options={"physics": physics})
    return env


def alike(env: TorchEnv, **physics: object) -> TorchEnv:
    """The same, with the particles of all elements where those of the first are."""
    env.reset(seed=0)
    env.reset(options={"physics": physics, "positions": env.state.x[0].clone()})
    return env


def drive(env: TorchEnv, level: float = 1.0) -> torch.Tensor:
    """Contraction along x, expansion along y, everywhere."""
    action = torch.full((env.num_envs, *env.action_shape), level, dtype=env.dtype)
    action[:, 1] *= -1
    return action


def strain(env: TorchEnv, count: int | None = None) -> torch.Tensor:
    """Mean distance of the robot's elastic F from the identity, (B,)."""
    return (env.state.F[:, :count] - torch.eye(2, dtype=env.dtype)).flatten(2).norm(dim=2).mean(1)


def test_numbers_and_lists_are_as_exact_as_arrays() -> None:
    """torch would make them float32, or whatever its default is, first."""
    env = tiny("kick", 2)
    env.reset(seed=0)
    places = (env.state.x[0] + 1e-12).tolist()
    for default in (torch.float32, torch.bfloat16):
        torch.set_default_dtype(default)
        try:
            env.reset(options={"positions": places, "physics": {"mu": 650.1, "lam": [49.9, np.float32(50.0)]}})
        finally:
            torch.set_default_dtype(torch.float32)
        assert env.env_state.physics["mu"].tolist() == [650.1] * 2
        assert env.env_state.physics["lam"].tolist() == [49.9, 50.0] and env.state.x[1].tolist() == places


@torch.no_grad()
def test_the_tasks_own_values_change_nothing() -> None:
    for task in dittogym.TASKS:
        spec = dittogym.make_spec(task)
        env, plain = tiny(task, 2, substeps=10), tiny(task, 2, substeps=10)
        given(env, **{name: getattr(spec, name) for name in NAMES if name != "mass"}, mass=1.0)
        plain.reset(seed=0)
        stir(env)
        stir(plain)
        for action in actions(env, 2):
            ours, theirs = env.step(action), plain.step(action)
        assert torch.equal(ours[0], theirs[0]) and torch.allclose(ours[1], theirs[1], rtol=1e-10, atol=1e-10)
        for a, b in zip(env.state.components(), plain.state.components(), strict=True):
            assert torch.allclose(a, b, rtol=1e-9, atol=1e-9), task


# What each of them does.


@pytest.mark.parametrize(("dt", "largest"), [(1e-4, 781_250.0), (2e-4, 195_312.5)])
def test_gravity_has_a_limit_that_depends_on_the_substeps(dt: float, largest: float) -> None:
    """Beyond it a particle at rest crosses a cell within a substep."""
    env = tiny("run", 1, dt=dt, substeps=1)
    given(env, gravity=(0.0, -0.99 * largest))
    with pytest.raises(ValueError, match=rf"^physics\['gravity'\].* must be above -{largest}"):
        given(env, gravity=(0.0, -1.01 * largest))
    with pytest.raises(ValueError, match=rf"^gravity.* must be below {largest}"):
        spec = replace(dittogym.make_spec("run"), gravity=(2 * largest, 0.0))
        TorchEnv(spec, 1, dt=dt, substeps=1)


@torch.no_grad()
def test_gravity_makes_fall() -> None:
    """SHAPE MATCH's robot hangs in the air: free fall, to the last digits, in the direction of gravity."""
    pulls = torch.tensor([[0.0, 0.0], [0.0, -2.0], [0.0, -20.0], [5.0, 0.0]], dtype=torch.float64)
    env = given(tiny("shapematch", 4, substeps=10), gravity=pulls)
    start = env.env_state.start.com
    still = torch.zeros(4, *env.action_shape, dtype=env.dtype)
    for _ in range(3):
        info = env.step(still)[-1]
    fallen = info["com"] - start
    assert torch.allclose(fallen, pulls * DT**2 * 30 * 31 / 2, rtol=1e-6, atol=1e-12)
    assert torch.allclose(env.state.v, (30 * DT * pulls)[:, None].expand_as(env.state.v), rtol=1e-6, atol=1e-10)


@torch.no_grad()
def test_max_actuation_scales_the_field() -> None:
    """The cost of actions is proportional to it, and so is the motion of the first substep."""
    env = alike(tiny("run", 4, substeps=1), max_actuation=[0.0, 10.0, 20.0, 45.0], gravity=(0.0, 0.0))
    action = actions(env, 1)[0, :1].expand(4, -1, -1, -1)
    _, _, _, _, info = env.step(action)
    cost = info["reward_terms"]["action"]
    assert cost[0] == 0 and (cost[1:] / cost[1]).tolist() == pytest.approx([1.0, 2.0, 4.5])
    v = env.state.v
    assert v[0].abs().max() == 0 and v[1].abs().max() > 0
    assert torch.allclose(v[2], 2.0 * v[1]) and torch.allclose(v[3], 4.5 * v[1])


@torch.no_grad()
def test_mass_makes_inert() -> None:
    """The same forces accelerate all particles in inverse proportion, those of objects too; gravity does not care."""
    env = alike(tiny("kick", 3, substeps=1), mass=[0.5, 1.0, 2.0], gravity=(0.0, 0.0))
    robot = env.model.num_robot_particles
    F = env.state.F.clone()
    F[:, robot:, 0, 0] = 1.05  # a cube that is stretched
    set_particles(env, F=F)
    env.step(drive(env))
    v = env.state.v
    for part in (slice(0, robot), slice(robot, None)):
        assert v[:, part].abs().max() > 0
        for i, factor in ((0, 2.0), (2, 0.5)):
            assert torch.allclose(v[i, part], factor * v[1, part], rtol=1e-6, atol=1e-9)
    env = alike(tiny("shapematch", 2, substeps=5), mass=[0.5, 2.0], gravity=(0.0, -10.0))
    env.step(torch.zeros(2, *env.action_shape, dtype=env.dtype))
    assert torch.allclose(env.state.v[0], env.state.v[1], rtol=1e-6, atol=1e-9)


@torch.no_grad()
@pytest.mark.parametrize(("name", "shape"), [("mu", (1.05, 1 / 1.05)), ("lam", (1.03, 1.03))])
def test_stiffness_of_robot_and_object(name: str, shape: tuple[float, float]) -> None:
    """Matter sheared without change of area is driven by mu alone, matter blown up by lam too."""
    env = tiny("kick", 3, substeps=1)
    alike(env, **{"mu": 600.0, name: [200.0, 400.0, 600.0]}, gravity=(0.0, 0.0), max_actuation=0.0, yield_stress=1e6)
    F = torch.diag(torch.tensor(shape, dtype=env.dtype)).expand_as(env.state.F).clone()
    set_particles(env, F=F)
    env.step(torch.zeros(3, *env.action_shape, dtype=env.dtype))
    for part in (slice(0, env.model.num_robot_particles), slice(env.model.num_robot_particles, None)):
        v = env.state.v[:, part]
        assert (v[1] - v[0]).abs().max() > 1e-6
        assert torch.allclose(v[2] - v[1], v[1] - v[0], rtol=1e-6, atol=1e-9)  # linear in the constant
        ratio = v[2].norm() / v[0].norm()
        assert float(ratio) == pytest.approx(3.0, rel=0.01) if name == "mu" else 1.05 < float(ratio) < 3.0


@torch.no_grad()
def test_yield_stress_limits_the_strain() -> None:
    """The difference of logarithmic principal strains does not exceed sqrt(2) times yield stress over 2 mu."""
    limits = torch.tensor([5.0, 20.0, 1e5], dtype=torch.float64)
    env = alike(tiny("shapematch", 3, substeps=40), yield_stress=limits)
    for _ in range(2):
        env.step(drive(env))
    # F is kept from before the last move, so a little more may have come on top.
    stretches = torch.linalg.svdvals(env.state.F).log()
    gap = (stretches[..., 0] - stretches[..., 1]).amax(1)
    bound = 2**0.5 * limits / (2 * 500.0)
    assert gap[:2].tolist() == pytest.approx(bound[:2].tolist(), rel=1e-2)
    assert float(gap[2]) > 1.2 * float(bound[1])


# How long they hold.


def test_values_stay_until_given_again() -> None:
    env = given(tiny("run", 2), mu=300.0)
    env.reset()
    env.reset(seed=3)
    assert env.env_state.physics["mu"].tolist() == [300.0, 300.0]
    env.reset(options={"physics": {"gravity": (0.0, -1.0)}})
    physics = env.env_state.physics
    assert physics["gravity"].tolist() == [[0.0, -1.0]] * 2
    assert "mu" not in physics  # what is not given is the task's own
    env.reset(options={"physics": {}})
    assert not env.env_state.physics


@torch.no_grad()
def test_only_masked_elements_change() -> None:
    env, twin = (given(tiny("run", 3), mu=[100.0, 200.0, 300.0]) for _ in range(2))
    drives = actions(env, 4)
    for e in (env, twin):
        e.step(drives[0])
    mask = [False, True, False]
    env.reset(options={"physics": {"mu": 900.0, "mass": 2.0}, "reset_mask": mask})
    physics = env.env_state.physics
    assert physics["mu"].tolist() == [100.0, 900.0, 300.0] and physics["mass"].tolist() == [1.0, 2.0, 1.0]
    for action in drives[1:]:
        env.step(action)
        twin.step(action)
    for i in (0, 2):
        assert_same_bits([p[i] for p in env.state.components()], [p[i] for p in twin.state.components()])
    env.reset(options={"reset_mask": mask})
    assert env.env_state.physics["mu"].tolist() == [100.0, 900.0, 300.0]
    env.reset(options={"reset_mask": [True, True, False]})
    assert env.env_state.physics["mu"].tolist() == [100.0, 900.0, 300.0]
    env.reset(options={"physics": {}, "reset_mask": [True, True, False]})
    assert env.env_state.physics["mu"].tolist() == [650.0, 650.0, 300.0]
    assert env.env_state.physics["mass"].tolist() == [1.0, 1.0, 1.0]
    env.reset(options={"physics": {"mu": [1.0, 2.0, 3.0]}, "reset_mask": [False, False, True]})
    assert env.env_state.physics["mu"].tolist() == [650.0, 650.0, 3.0]


# Gradients.

#: Soft and weak enough that the robot flows within a few milliseconds.
BASE = {"mu": 500.0, "lam": 60.0, "yield_stress": 12.0, "max_actuation": 48.0, "gravity": (0.5, -11.0), "mass": 1.1}


def rollout(env: TorchEnv, physics: dict, drives: torch.Tensor) -> torch.Tensor:
    """Rewards of each element, added up over a few steps."""
    env.reset(seed=0, options={"physics": physics})
    # A throw to the right and downwards, against the floor.
    set_particles(env, v=env.state.v + torch.tensor([1.0, -1.5], dtype=env.dtype))
    return torch.stack([env.step(action)[1] for action in drives]).sum(0)


def test_gradients_of_a_reward_in_every_constant() -> None:
    """One value per element, against central differences of each; the reward of SLOT looks at the robot's shape."""
    env = tiny("slot", 2, substeps=10)
    drives = actions(env, 3)
    scale = torch.tensor([0.9, 1.1], dtype=env.dtype)
    values = {name: torch.tensor(value, dtype=env.dtype) for name, value in BASE.items()}
    values = {name: scale.view(2, *[1] * v.ndim) * v for name, v in values.items()}
    leaves = {name: v.clone().requires_grad_() for name, v in values.items()}
    gradients = torch.autograd.grad(rollout(env, leaves, drives).sum(), list(leaves.values()))
    assert (strain(env, env.model.num_robot_particles) > 1e-3).all()
    for name, gradient in zip(leaves, gradients, strict=True):
        for column in range(2 if name == "gravity" else 1):
            step = torch.zeros_like(values[name])
            step.view(2, -1)[:, column] = 1e-5 * values[name].abs().max()
            with torch.no_grad():
                ends = [rollout(env, {**values, name: values[name] + sign * step}, drives) for sign in (1, -1)]
            difference = (ends[0] - ends[1]) / (2e-5 * values[name].abs().max())
            ours = gradient.view(2, -1)[:, column]
            assert difference.abs().min() > 1e-6, name
            assert ours.tolist() == pytest.approx(difference.tolist(), rel=1e-4), name


# What is refused.


def test_matter_too_stiff_for_the_substeps_is_refused() -> None:
    """By the task's numbers, muscles included; the batch goes on as it was."""
    env = tiny("run", 2)
    env.reset(seed=0)
    before = env.state
    limit = 1.0 / 128 / math.sqrt(2 * (9000.0 + 50.0 + 45.0) / 2.0)
    for physics in ({"mu": [9000.0, 650.0]}, {"mu": 650.0, "mass": 0.05}, {"max_actuation": 1e4}, {"lam": 1e4}):
        with pytest.raises(ValueError, match=r"dt must be at most \S+ s .* of the robot") as raised:
            env.reset(options={"physics": physics})
        if "mu" in physics and "mass" not in physics:
            assert float(str(raised.value).split()[5]) == pytest.approx(limit, rel=1e-6)
    assert env.state is before
    env.reset(options={"physics": {"mu": 3000.0}})
    with pytest.raises(ValueError, match="dt must be at most"):
        tiny(replace(dittogym.make_spec("run"), mu=9000.0))
    kick = dittogym.make_spec("kick")
    hard = replace(kick.objects[0], material=torchmpm.Elastic(2e4, 100.0))
    with pytest.raises(ValueError, match="of the object"):
        tiny(replace(kick, objects=(hard,)))


def test_every_episode_can_be_differentiated() -> None:
    """Also after a reset that keeps the constants, which then count as numbers."""
    env, mu = tiny("kick"), torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
    gradients = []
    for options in ({"physics": {"mu": mu}}, {"physics": {"mu": mu}}, None):
        env.reset(seed=0, options=options)
        reward = env.step(actions(env, 1)[0])[1].sum()
        gradients += torch.autograd.grad(reward, mu) if reward.requires_grad else [None]
    assert gradients[0] != 0 and gradients[0] == gradients[1] and gradients[2] is None
