"""Constants of the matter given at a reset: what each does, how long it holds, and its gradient."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import actions, assert_same_bits, begun, stir, tiny

import dittogym
import torchmpm
from dittogym import TorchEnv
from dittogym.physics import NAMES


def given(env: TorchEnv, **physics: object) -> TorchEnv:
    """The environment after a reset with these constants."""
    env.reset(seed=0, options={"physics": physics})
    return env


def test_numbers_and_lists_are_as_exact_as_arrays() -> None:
    """torch would make them float32, or whatever its default is, first."""
    env = begun(tiny("kick", 2))
    places = (env.state.x[0] + 1e-12).tolist()
    for default in (torch.float32, torch.bfloat16):
        torch.set_default_dtype(default)
        env.reset(options={"positions": places, "physics": {"mu": 650.1, "lam": [49.9, np.float32(50.0)]}})
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

#: Other values for each of two simulations.
OTHERS = {
    "mu": (400.0, 900.0),
    "lam": (20.0, 80.0),
    "yield_stress": (5.0, 40.0),
    "max_actuation": (10.0, 60.0),
    "gravity": ((0.0, -3.0), (2.0, -12.0)),
    "mass": ((0.5, 2.0), (3.0, 0.7)),  # factors on those of robot and object
}


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_constant_of_a_reset_acts_as_that_of_the_task(name: str) -> None:
    """On robot and object, in each simulation and for each particle its own."""
    env, spec = tiny("kick", 2, substeps=10), dittogym.make_spec("kick")
    values = torch.tensor(OTHERS[name], dtype=torch.float64)
    robot = env.model.num_robot_particles
    if name == "mass":
        values = values.repeat_interleave(torch.tensor([robot, env.num_particles - robot]), 1)
    stir(given(env, **{name: values}))
    drives = actions(env, 3)
    for action in drives:
        together = env.step(action)
    for i, value in enumerate(OTHERS[name]):
        own = {name: value}
        if name == "mass":
            bodies = [replace(body, mass=body.mass * factor) for body, factor in zip(spec.bodies, value, strict=True)]
            own = {"robot": bodies[0], "objects": bodies[1:]}
        single = tiny(replace(spec, **own), substeps=10)
        single.reset(seed=i)
        stir(single, i)
        for action in drives:
            alone = single.step(action[i : i + 1])
        assert together[1][i].item() == pytest.approx(alone[1].item(), rel=1e-9)
        for ours, theirs in zip(env.state.components(), single.state.components(), strict=True):
            torch.testing.assert_close(ours[i], theirs[0], rtol=1e-9, atol=1e-9)


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


# What is refused.


def test_matter_too_stiff_for_the_substeps_is_refused() -> None:
    """By the task's numbers, muscles included; the batch goes on as it was."""
    env = begun(tiny("run", 2))
    before = env.state
    limit = 1.0 / 128 / math.sqrt(2 * (9000.0 + 50.0 + 45.0) / 2.0)
    for physics in ({"mu": [9000.0, 650.0]}, {"mu": 650.0, "mass": 0.05}, {"max_actuation": 1e4}, {"lam": 1e4}):
        with pytest.raises(ValueError, match=r"dt must be at most \S+ s .* of the robot") as raised:
            env.reset(options={"physics": physics})
        if "mu" in physics and "mass" not in physics:
            assert float(str(raised.value).split()[5]) == pytest.approx(limit, rel=1e-6)
    assert env.state is before
    env.reset(options={"physics": {"mu": 3000.0}})
    for own, words in (({"mu": 9000.0}, "dt must be at most"), ({"gravity": (2e6, 0.0)}, "^gravity")):
        with pytest.raises(ValueError, match=words):
            tiny(replace(dittogym.make_spec("run"), **own))
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
