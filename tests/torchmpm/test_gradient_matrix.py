"""Gradients through a step at the points where they could go wrong: F = I, the yield surface, inverted elements."""

import math
from dataclasses import replace

import pytest
import torch
from scenes import Leaves, assert_slope, combination, normal, positions, robot, turn
from torch import Tensor

from torchmpm import Body, ParticleState, Snow, VonMises

pytestmark = pytest.mark.usefixtures("backend")

COUNT, MU, LAM, YIELD = 12, 500.0, 50.0, 60.0
INPUTS = ("x", "v", "C", "F", "actuation", "mu", "lam", "yield_stress", "gravity", "mass")


def stretch(first: float, second: float, angle: float = 0.4, axes: float = 0.9) -> Tensor:
    """Stretches along turned axes, then a rotation."""
    diagonal = torch.diag(torch.tensor([first, second], dtype=torch.float64))
    return turn(angle) @ turn(axes) @ diagonal @ turn(-axes)


#: Trial deformations of particles in pairs; beside singular ones the stress is steep, but smooth.
POINTS = {
    "identity": (torch.eye(2, dtype=torch.float64), turn(1.0)),
    "elastic": (stretch(1.03, 0.98), stretch(1.02, 1.02)),
    "flowing": (stretch(1.3, 0.8), stretch(1.4, 0.6)),
    "inverted": (stretch(1.02, -0.98), stretch(1.3, -0.7)),
    "inverted, trace zero": (torch.diag(torch.tensor([1.0, -1.0])).double(), stretch(0.99, -1.01, 0.0)),
    "singular polar factor": (stretch(0.8, 1e-3), stretch(0.8, -1e-3)),
    "small": (stretch(0.03, 0.02), stretch(0.06, -0.04)),
}


def inputs(F: tuple[Tensor, ...]) -> Leaves:
    value = {"mu": MU, "lam": LAM, "yield_stress": YIELD, "mass": 2.0}
    return {
        "x": positions(COUNT, corner=(0.4, 0.45)),
        "v": 0.3 * normal(1, COUNT, 2, seed=1),
        "C": torch.zeros(1, COUNT, 2, 2, dtype=torch.float64),
        "F": torch.stack([F[k % len(F)] for k in range(COUNT)])[None],
        "actuation": 30.0 * normal(1, 2, 16, 16, seed=2),
        "gravity": torch.tensor([0.5, -9.0], dtype=torch.float64),
        **{name: torch.tensor(number, dtype=torch.float64) for name, number in value.items()},
    }


def loss(given: Leaves, substeps: int = 2) -> Tensor:
    body = Body(COUNT, VonMises(given["mu"], given["lam"], given["yield_stress"]), given["mass"], muscle=True)
    solver = robot(COUNT, bodies=(body,), gravity=given["gravity"])
    start = ParticleState(given["x"], given["v"], given["C"], given["F"], torch.ones(1, COUNT, dtype=torch.float64))
    final = solver.step(start, given["actuation"], substeps=substeps)
    return combination(final, 10, x=100.0, v=1.0, C=0.05, F=1.0)


def gradient(given: Leaves, name: str, substeps: int = 2) -> Tensor:
    leaf = given[name].clone().requires_grad_()
    return torch.autograd.grad(loss(given | {name: leaf}, substeps), leaf, materialize_grads=True)[0]


@pytest.mark.parametrize("point", POINTS)
def test_against_central_differences(point: str) -> None:
    given = inputs(POINTS[point])
    leaves = {name: given[name].clone().requires_grad_() for name in INPUTS}
    gradients = torch.autograd.grad(loss(given | leaves), list(leaves.values()), materialize_grads=True)
    for name, found in zip(INPUTS, gradients, strict=True):
        torch.testing.assert_close(gradient(given, name), found, rtol=1e-12, atol=1e-12 * float(found.abs().max()))
        assert_slope(loss, given, name, found, 1e-6 * max(given[name].abs().max().item(), 1.0), rounding=1e-15)


def at_yield() -> Tensor:
    """A deformation exactly on the yield surface, as far as numbers go."""
    half = math.exp(math.sqrt(2.0 * ((YIELD / (2 * MU)) ** 2 - 1e-8)) / 2.0)
    return stretch(half, 1.0 / half)


@pytest.mark.parametrize("side", [1, -1])
def test_one_sided_derivatives_at_yield(side: int) -> None:
    """Just off the surface the gradient is the one-sided derivative there; the two differ."""
    on = at_yield()
    outwards = stretch(1.0, -1.0) @ torch.linalg.inv(stretch(1.0, 1.0)) @ on  # larger major, smaller minor stretch
    near = inputs((on + side * 1e-9 * outwards,))
    direction = outwards + 0.1 * normal(1, COUNT, 2, 2, seed=30)
    slope = (gradient(near, "F", 1) * direction).sum().item()
    step = side * 1e-6
    there, here = (loss(near | {"F": near["F"] + h * direction}, 1).item() for h in (2 * step, step))
    start = loss(near, 1).item()
    one_sided = (-3.0 * start + 4.0 * here - there) / (2 * step)  # second order
    assert slope == pytest.approx(one_sided, rel=1e-5)
    other = inputs((on - side * 1e-9 * outwards,))
    assert abs((gradient(other, "F", 1) * direction).sum().item() - slope) > 0.1 * abs(slope)


@pytest.mark.parametrize("yield_stress", [1e5, 1e9])
def test_matter_that_never_yields(yield_stress: float) -> None:
    """A stress that no stretch reaches overflowed, and gradients were not numbers; now it is elastic matter."""
    given = inputs(POINTS["flowing"])
    stiff = given | {"yield_stress": torch.tensor(yield_stress, dtype=torch.float64)}
    moderate = given | {"yield_stress": torch.tensor(1e4, dtype=torch.float64)}
    for name in ("F", "mu", "actuation"):
        torch.testing.assert_close(gradient(stiff, name), gradient(moderate, name), rtol=1e-12, atol=1e-12)
    assert gradient(stiff, "yield_stress") == 0.0
    number = VonMises(MU, LAM, yield_stress).return_map(given["F"].flatten(2).unbind(-1), torch.ones(1, COUNT))[0]
    assert torch.equal(torch.stack(number, dim=-1), given["F"].flatten(2))


@pytest.mark.parametrize("small", [0.0, 1e-300, 1e-15, 1e-8])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gradients_are_bounded_beside_singular_elements(small: float, sign: float) -> None:
    """The derivative of the polar factor jumps at det F = 0, but does not grow; single precision too."""
    given = inputs((stretch(1.0, sign * small), stretch(0.2, sign * small)))
    usual = gradient(inputs((stretch(1.0, sign * 0.1), stretch(0.2, sign * 0.1))), "F", 1).abs().max()
    assert gradient(given, "F", 1).abs().max() <= 3.0 * usual
    single = {name: value.float() for name, value in given.items()}
    start = ParticleState(single["x"], single["v"], single["C"], single["F"].requires_grad_(), torch.ones(1, COUNT))
    final = robot(COUNT).step(replace(start), single["actuation"], substeps=2)
    assert torch.autograd.grad(final.v.square().sum(), single["F"])[0].isfinite().all()


def soil_loss(given: Leaves) -> Tensor:
    """Of soil like that of DIG: up to a hardening factor of 1.95 its derivative is the exact one."""
    material = Snow(6e4 * given["mu"], 4e4, shear_cutoff=0.0)
    solver = robot(COUNT, bodies=(Body(COUNT, material, given["mass"]),), gravity=given["gravity"])
    start = ParticleState(given["x"], given["v"], given["C"], given["F"], given["Jp"])
    final = solver.step(start, substeps=2)
    return combination(final, 10, x=100.0, v=1.0, C=0.05, F=1.0, Jp=1.0)


@pytest.mark.parametrize("name", ["x", "v", "C", "F", "Jp", "mu", "mass", "gravity"])
@pytest.mark.parametrize("factor", [0.5, 1.0, 1.9])
def test_soil_against_central_differences(factor: float, name: str) -> None:
    given = inputs((stretch(1.002, 0.998), stretch(1.02, 0.999), stretch(0.999, 0.996)))
    one = torch.ones((), dtype=torch.float64)
    given |= {"Jp": (1.0 - 0.1 * math.log(factor)) * torch.ones(1, COUNT).double(), "mu": one, "mass": one}
    leaf = given[name].clone().requires_grad_()
    found = torch.autograd.grad(soil_loss(given | {name: leaf}), leaf)[0]
    step = (1e-6 if name == "F" else 1e-5) * max(given[name].abs().max().item(), 1.0)  # hardened soil curves in F
    assert_slope(soil_loss, given, name, found, step, rounding=1e-15)
