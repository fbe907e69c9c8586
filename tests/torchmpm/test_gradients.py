"""Derivatives of a rollout in everything it is differentiable in, against central differences and each other."""

import math
from dataclasses import replace

import pytest
import torch
from scenes import Leaves, assert_slope, combination, lively, normal, positions, robot
from torch import Tensor

from torchmpm import Body, ParticleState, VelocityRule, VonMises

pytestmark = pytest.mark.usefixtures("backend")

B, N = 2, 40
SUBSTEPS = 20
NAMES = ("x", "v", "C", "F", "actuation", "origin", "mu", "lam", "yield_stress", "gravity", "mass", "volume")
SCENES = {
    "free": {"strain": 0.01, "rules": ()},
    "yielding": {"strain": 0.15, "rules": ()},
    "sticky floor": {"strain": 0.1, "rules": (VelocityRule("-y", j=(None, 7), friction=math.inf),)},
    "rubbing floor": {"strain": 0.1, "rules": (VelocityRule("-y", j=(None, 7), friction=0.3),)},
}


def inputs(strain: float) -> Leaves:
    """Everything that a loss may be differentiated in; material values in all shapes that are accepted."""
    state = lively(N, B, strain=strain, seed=11)
    scale = torch.tensor([0.9, 1.2], dtype=torch.float64)
    return {
        "x": state.x,
        "v": state.v,
        "C": state.C,
        "F": state.F,
        "actuation": 40.0 * normal(B, 2, 16, 16, seed=1),
        "origin": torch.tensor([[0.01, -0.02], [-0.07, 0.03]], dtype=torch.float64),
        "mu": 500.0 * scale,
        "lam": 50.0 * (1.0 + 0.1 * normal(B, N, seed=2).abs()),
        "yield_stress": torch.tensor(60.0, dtype=torch.float64),
        "gravity": torch.tensor([[0.5, -9.8], [2.0, -5.0]], dtype=torch.float64),
        "mass": 2.0 * scale.flip(0),
        "volume": 1.0 + 0.2 * normal(B, N, seed=3).abs(),
    }


def loss(given: Leaves, rules: tuple[VelocityRule, ...]) -> Tensor:
    """A random combination of all numbers of the final state."""
    material = VonMises(given["mu"], given["lam"], given["yield_stress"])
    body = Body(N, material, given["mass"], given["volume"], muscle=True)
    solver = robot(N, bodies=(body,), gravity=given["gravity"], rules=rules, damping=0.999)
    start = ParticleState(given["x"], given["v"], given["C"], given["F"], given["x"].new_ones(B, N))
    field, origin = given["actuation"], given["origin"]
    final = solver.step(start, field, substeps=SUBSTEPS, origin=origin)
    return combination(final, 20, x=1.0, v=0.2, C=0.01, F=1.0)


def gradients(scene: str, dtype: torch.dtype = torch.float64) -> Leaves:
    options = SCENES[scene]
    given = {name: value.to(dtype, copy=True).requires_grad_() for name, value in inputs(options["strain"]).items()}
    found = torch.autograd.grad(loss(given, options["rules"]), list(given.values()))
    return dict(zip(given, found, strict=True))


@pytest.fixture(scope="module", params=SCENES)
def scene(request: pytest.FixtureRequest, backend: str) -> tuple[str, Leaves]:
    """A scene and its gradients by plain autograd."""
    return request.param, gradients(request.param)


@pytest.mark.parametrize("name", NAMES)
def test_against_central_differences(scene: tuple[str, Leaves], name: str) -> None:
    """In a random direction over 20 substeps, to 1e-5."""
    label, found = scene
    options = SCENES[label]
    given = inputs(options["strain"])
    if name == "yield_stress" and label == "free":
        assert found[name] == 0.0, "nothing may yield in this scene"
        return
    # Where a step may cross a yield surface or a cell it is shorter; elsewhere rounding asks for a longer one.
    step = (1e-6 if name in ("x", "F", "origin") else 1e-5) * given[name].abs().max().item()
    assert_slope(lambda given: loss(given, options["rules"]), given, name, found[name], step)


def test_default_step_is_differentiable_from_rest() -> None:
    """F = I and v = 0 exactly, in single precision, in contact: every gradient is a number."""
    x = positions(60).float().requires_grad_()
    actuation = torch.zeros(1, 2, 16, 16, requires_grad=True)
    solver = robot(60, rules=(VelocityRule("-y", j=(None, 7), friction=0.5),))
    final = solver.step(ParticleState.at_rest(x), actuation, substeps=25)
    for gradient in torch.autograd.grad(final.x.square().sum() + final.F.square().sum(), (x, actuation)):
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0


def test_single_precision_gradients_are_near_double() -> None:
    single = gradients("yielding", dtype=torch.float32)
    for name, double in gradients("yielding").items():
        error = (single[name].double() - double).norm() / double.norm()
        assert error <= 1e-3, f"{name}: {error:.1e}"


def test_frozen_particles_pass_their_gradient_through() -> None:
    state = lively(10)
    x = (state.x + torch.tensor([3.0, 0.0], dtype=torch.float64)).requires_grad_()
    final = robot(10).step(replace(state, x=x), substeps=4)
    (gradient,) = torch.autograd.grad(final.x.sum(), x)
    assert torch.equal(gradient, torch.ones_like(x))
