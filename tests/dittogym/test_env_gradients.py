"""Gradients of losses on states, soft observations and rewards in everything an environment is differentiable in.

Three witnesses in float64: central differences, plain automatic differentiation (eager, whole graph), and the ways that
are used: eager with checkpoints, and the native adjoint. Random strains put some of the robot beyond yield, random
velocities throw it against the floor.
"""

from dataclasses import replace
from functools import cache

import pytest
import torch
from tiny import actions, begun, normal, set_particles, tiny
from torch import Tensor

from dittogym import TorchEnv, make_spec
from dittogym.spec import TaskSpec
from torchmpm.native.library import find_compiler

TASKS = ("shapematch", "run", "kick", "dig")
STEPS, SUBSTEPS, B = 2, 6, 2
COUNTS = {"shapematch": (50,), "run": (50,), "kick": (40, 12), "dig": (40, 20)}
MATTER = ("mu", "lam", "yield_stress", "mass")
INPUTS = ("action", "x", "v", "C", "F", *MATTER, "max_actuation", "gravity")
LOSSES = ("state", "observation", "soft reward", "reward")
Leaves = dict[str, Tensor]


def exact(task: str) -> TaskSpec:
    """The task, with exact gradients of its soil: here it is strained so much that they would be limited."""
    spec = make_spec(task)
    objects = [
        replace(body, material=replace(body.material, exact_gradients=True)) if body.material else body
        for body in spec.objects
    ]
    return replace(spec, objects=tuple(objects))


def environment(task: str, backend: str, segment: int | None = None) -> TorchEnv:
    env = tiny(exact(task), B, particles=COUNTS[task], substeps=SUBSTEPS, resolution=4, backend=backend)
    env.model = replace(env.model, segment=segment)
    return env


@cache
def inputs(task: str) -> Leaves:
    """Everything that a loss may be differentiated in."""
    env = begun(environment(task, "eager"), seed=3)
    n, spec = env.num_particles, make_spec(task)
    own = {name: getattr(spec, name) for name in MATTER if name != "mass"} | {"mass": 1.0}
    matter = {name: own[name] * (1.0 + 0.1 * normal(B, seed=k).abs()) for k, name in enumerate(MATTER)}
    strain = 0.08 * normal(B, n, 2, 2, seed=10)
    strain[:, env.model.num_robot_particles :] *= 0.2
    return {
        "action": 0.6 * actions(env, STEPS),
        "x": env.state.x.clone(),
        "v": torch.tensor([0.6, -1.0]) + 0.3 * normal(B, n, 2, seed=11),
        "C": 2.0 * normal(B, n, 2, 2, seed=12),
        "F": torch.eye(2) + strain,
        **matter,
        "max_actuation": spec.max_actuation * torch.tensor([0.8, 1.1], dtype=torch.float64),
        "gravity": torch.tensor(spec.gravity) + normal(B, 2, seed=13),
    }


def losses(env: TorchEnv, given: Leaves) -> tuple[Tensor, ...]:
    """Random combinations of the final state and image, and the sums of soft and of true rewards."""
    physics = {name: given[name] for name in (*MATTER, "max_actuation", "gravity")}
    env.reset(seed=0, options={"positions": given["x"], "physics": physics})
    set_particles(env, v=given["v"], C=given["C"], F=given["F"])
    soft = true = torch.zeros(B, dtype=torch.float64)
    for action in given["action"]:
        image, reward, *_, info = env.step(action, soft=True)
        soft, true = soft + reward, true + info["true_reward"]
    final = env.state
    fields = ((final.x, 1.0), (final.v, 0.2), (final.C, 0.01), (final.F, 1.0), (final.Jp, 1.0))
    total = sum(size * (normal(*t.shape, seed=20 + k) * t).sum() for k, (t, size) in enumerate(fields))
    share = torch.tensor([1.0, 0.7], dtype=torch.float64)
    return total, 0.01 * (normal(*image.shape, seed=30) * image).sum(), (share * soft).sum(), (share * true).sum()


def gradients(task: str, backend: str, segment: int | None = None) -> dict[str, Leaves]:
    """By loss and input; zero where a loss does not depend on an input."""
    leaves = {name: value.clone().requires_grad_() for name, value in inputs(task).items()}
    found = {}
    for name, loss in zip(LOSSES, losses(environment(task, backend, segment), leaves), strict=True):
        if not loss.requires_grad:  # SHAPE MATCH's true reward counts pixels
            found[name] = {key: torch.zeros_like(leaf) for key, leaf in leaves.items()}
            continue
        by_input = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True, materialize_grads=True)
        found[name] = dict(zip(leaves, by_input, strict=True))
    return found


@cache
def plain(task: str) -> dict[str, Leaves]:
    return gradients(task, "eager")


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", INPUTS)
def test_against_central_differences(task: str, name: str) -> None:
    """In one random direction, all losses at once."""
    given, direction = inputs(task), normal(*inputs(task)[name].shape, seed=40)
    # Along positions and deformations a step must be short to cross no yield surface and no cell.
    # Along gravity it may be long, and must be where SHAPE MATCH's free robot hardly feels it.
    step = {"x": 1e-8, "F": 1e-8, "gravity": 1e-4}.get(name, 1e-6) * given[name].abs().max().item()
    env = environment(task, "auto")
    with torch.no_grad():
        ahead, behind = (losses(env, given | {name: given[name] + side * step * direction}) for side in (1, -1))
    for k, loss in enumerate(LOSSES):
        slope = (plain(task)[loss][name] * direction).sum().item()
        difference = (ahead[k] - behind[k]).item() / (2 * step)
        # What rounding leaves of a difference of two losses.
        floor = 4e-16 * max(abs(ahead[k].item()), 1.0) / step
        assert abs(slope - difference) <= 1e-5 * abs(difference) + 10 * floor, f"{loss}: {slope} {difference}"


@pytest.mark.parametrize("task", TASKS)
def test_every_input_matters(task: str) -> None:
    """No comparison above is one of zeros, but for what the task does not have."""
    for loss in LOSSES[:3]:
        for name, value in plain(task)[loss].items():
            assert value.isfinite().all()
            assert value.abs().max() > 1e-13, f"{loss} {name}"


def assert_near(found: dict[str, Leaves], expected: dict[str, Leaves], tolerance: float) -> None:
    for loss, leaves in expected.items():
        for name, value in leaves.items():
            error = (found[loss][name] - value).abs().max().item()
            # Forces within the robot hardly move its centre: rewards depend on F and C by differences of large numbers.
            assert error <= tolerance * max(value.abs().max().item(), 1e-3), f"{loss} {name}: {error}"


@pytest.mark.parametrize("task", TASKS)
def test_checkpoints_make_no_difference(task: str) -> None:
    found = gradients(task, "eager", segment=4)
    for tolerance, names in ((1e-12, set(INPUTS) - {"mass"}), (1e-11, {"mass"})):  # a sum by segments, over all of them
        expected = {loss: {n: v for n, v in leaves.items() if n in names} for loss, leaves in plain(task).items()}
        assert_near(found, expected, tolerance)


@pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
@pytest.mark.parametrize("task", TASKS)
def test_native_adjoint(task: str) -> None:
    assert_near(gradients(task, "native"), plain(task), 1e-9)
