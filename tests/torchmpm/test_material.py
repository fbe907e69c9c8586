"""Constitutive laws against independent formulas, and their derivatives against finite differences."""

import math

import numpy as np
import pytest
import torch
from scenes import generator, matrix, normal, planes, turn
from torch import Tensor

from torchmpm import Elastic, Snow, VonMises, lame
from torchmpm.materials.elastic import corotated_stress
from torchmpm.materials.von_mises import von_mises_return, yield_surface

MU, LAM, YIELD = 500.0, 50.0, 62.0
LIMIT = YIELD / (2 * MU)


def symmetric(planes: tuple[Tensor, ...]) -> Tensor:
    xx, xy, yy = planes
    return torch.stack((xx, xy, xy, yy), -1).unflatten(-1, (2, 2))


def returned(F: Tensor, limit: float | Tensor = LIMIT) -> Tensor:
    return matrix(von_mises_return(planes(F), limit))


def stretched(first: Tensor | float, second: Tensor | float, left: Tensor | float, right: Tensor | float) -> Tensor:
    """U diag(first, second) V^T with U and V turned by the angles left and right."""
    sigma = torch.stack((torch.as_tensor(first, dtype=torch.float64), torch.as_tensor(second, dtype=torch.float64)), -1)
    return turn(left) @ torch.diag_embed(sigma) @ turn(right).mT


def deformations(count: int, low: float, high: float, seed: int, share_inverted: float = 0.3) -> Tensor:
    """(1, N, 2, 2) with principal stretches spread evenly in their logarithm; some inverted."""
    draw = torch.rand(5, 1, count, generator=generator(seed), dtype=torch.float64)
    sigma = low * (high / low) ** draw[:2]
    sign = torch.where(draw[4] < share_inverted, -1.0, 1.0)
    return stretched(sigma[0], sign * sigma[1], 2 * math.pi * draw[2], 2 * math.pi * draw[3])


def return_by_svd(F: np.ndarray, limit: float) -> tuple[np.ndarray, bool]:
    """Von Mises return of one matrix after mpm.md 6.2 and 6.3, with an SVD and logarithms; and whether it yields."""
    U, sigma, Vt = np.linalg.svd(F)
    strain = np.log(np.maximum(sigma, 0.05))
    deviator = strain - strain.mean()
    norm = math.sqrt(deviator @ deviator + 1e-8)
    excess = norm - limit
    if excess <= 0:
        return F, False
    return U @ np.diag(np.exp(strain - excess / norm * deviator)) @ Vt, True


@pytest.mark.parametrize(
    ("low", "high", "seed"),
    [(0.7, 1.4, 0), (0.95, 1.08, 1), (0.01, 0.2, 2), (0.04, 3.0, 3)],
    ids=["large strains", "around the limit", "around the floor", "everything"],
)
def test_return_against_svd_and_logarithms(low: float, high: float, seed: int) -> None:
    """To 3e-7 (limits of 0.02 and more): the constant 1e-8 under the norm is treated exactly at yield only."""
    F = deformations(1500, low, high, seed)
    limit = 0.02 + 0.15 * torch.rand(1, 1500, generator=generator(seed + 10), dtype=torch.float64)
    found = returned(F, limit)
    expected = [return_by_svd(f, e) for f, e in zip(F[0].numpy(), limit[0].tolist(), strict=True)]
    yields = torch.tensor([y for _, y in expected])
    assert yields.sum() > 100 and (~yields).sum() > 50, "the test must reach both branches"
    assert (torch.linalg.det(F[0])[yields] < 0).sum() > 30
    wanted = torch.from_numpy(np.stack([m for m, _ in expected]))
    error = (found[0] - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)
    assert error.max() <= 3e-7
    assert torch.equal(found[0][~yields], F[0][~yields]), "what does not yield must stay as it came, bit by bit"
    assert (found[0][yields] != F[0][yields]).flatten(1).any(1).all()


@pytest.mark.parametrize("limit", [3e-4, 0.062])
def test_the_constant_under_the_norm_shifts_the_limit(limit: float) -> None:
    """Yield begins where sqrt((e1 - e2)^2 / 2 + 1e-8) reaches the limit."""
    difference = math.sqrt(2.0 * (limit**2 - 1e-8))
    for factor, yields in ((1 - 1e-9, False), (1 + 1e-9, True)):
        F = stretched(math.exp(factor * difference), 1.0, 0.4, 1.3)[None, None]
        assert (returned(F, limit) != F).any() == yields


def test_flow_is_isochoric_and_idempotent() -> None:
    F = deformations(1000, 0.06, 3.0, seed=5)
    once = returned(F)
    moved = (once != F).flatten(2).any(2)
    assert moved.sum() > 500
    torch.testing.assert_close(torch.linalg.det(once), torch.linalg.det(F), rtol=1e-12, atol=0)
    torch.testing.assert_close(returned(once), once, rtol=0, atol=1e-13)


def test_tiny_yield_stress_is_finite() -> None:
    """Limits below the constant under the norm flow back to (almost) no deviator at all."""
    F = deformations(100, 0.3, 3.0, seed=7).requires_grad_()
    for limit in (0.0, 1e-5, torch.zeros((), dtype=torch.float64)):
        result = returned(F, limit)
        sigma = torch.linalg.svdvals(result.detach())
        torch.testing.assert_close(sigma[..., 0], sigma[..., 1], rtol=2e-4, atol=0)
        (gradient,) = torch.autograd.grad(result.sum(), F)
        assert gradient.isfinite().all()


@pytest.mark.parametrize(
    ("material", "hardened"),
    [
        (Elastic(MU, LAM), 1.0),
        (VonMises(MU, LAM, YIELD), 1.0),
        *((Snow(MU, LAM, shear_cutoff=0.0), Jp) for Jp in (0.95, 1.0, 1.05)),
    ],
    ids=["elastic", "von mises", "hardened snow", "snow", "softened snow"],
)
def test_stress_is_the_derivative_of_the_energy(material: Elastic, hardened: float) -> None:
    """Kirchhoff: tau = (d energy / d F) F^T."""
    F = deformations(500, 0.2, 3.0, seed=8, share_inverted=0.0).requires_grad_()
    Jp = torch.full((1, 500), hardened, dtype=torch.float64)
    (first_piola,) = torch.autograd.grad(material.energy(planes(F), Jp).sum(), F)
    tau = symmetric(material.stress(planes(F.detach()), Jp))
    torch.testing.assert_close(tau, first_piola @ F.detach().mT, rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(tau, tau.mT, rtol=0, atol=0)


@pytest.mark.parametrize("limit", [2e-4, 1e-3, 0.07, 1.0, 10.0, 1e9])
def test_yield_in_single_precision(limit: float) -> None:
    """To its last digits: the ratio of the stretches alone holds few of a small limit."""
    single = torch.tensor([limit])
    difference = min(math.sqrt(2.0 * (single.item() ** 2 - 1e-8)), 40.0)
    ratio = math.exp(difference)
    exact = [math.tanh(difference / 2), ratio, 2 * math.cosh(difference / 2), 2 * math.sinh(difference / 2)]
    assert yield_surface(single.item()) == pytest.approx(exact, rel=1e-13)
    assert [value.item() for value in yield_surface(single)] == pytest.approx(
        exact, rel=3e-6 if difference > 4 else 1e-6
    )


def test_stress_formula() -> None:
    """2 mu (F - R) F^T + lam J (J - 1) I with R of an SVD, det F < 0 included (mpm.md 6.4)."""
    F = deformations(500, 0.2, 3.0, seed=9)
    U, _, Vh = torch.linalg.svd(F)
    J = torch.linalg.det(F)[..., None, None]
    expected = 2 * MU * (F - U @ Vh) @ F.mT + LAM * J * (J - 1) * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(symmetric(corotated_stress(planes(F), MU, LAM)), expected, rtol=1e-12, atol=1e-9)


def test_energy_of_a_collapsed_element() -> None:
    """The polar factor of F = 0 is the identity: mu |I|^2 + lam / 2."""
    zero, one = torch.zeros(1, 1, 2, 2, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    assert Elastic(MU, LAM).energy(planes(zero), one).item() == 2 * MU + 0.5 * LAM


NEAR = torch.tensor([[0.3, -0.8], [0.4, 0.6]], dtype=torch.float64)
POINTS = {
    "identity": torch.eye(2, dtype=torch.float64),
    "1e-7 from identity": torch.eye(2, dtype=torch.float64) + 1e-7 * NEAR,
    "rotation": turn(0.9),
    "1e-7 from rotation": turn(0.9) + 1e-7 * NEAR,
    "half turn": turn(math.pi),
    "uniform stretch": 1.3 * torch.eye(2, dtype=torch.float64),
    "rotated uniform stretch": 0.7 * turn(-2.0),
    "elastic": stretched(1.05, 0.99, 0.4, 1.3),
    "yielded": stretched(1.2, 0.9, 0.4, 1.3),
    "yielded along the axes": stretched(1.2, 0.9, 0.0, 0.0),
    "yielded below the floor": stretched(1.1, 0.02, 0.4, 1.3),
    "inverted elastic": stretched(1.02, -1.0, 0.4, 1.3),
    "inverted yielded": stretched(1.4, -0.7, 0.4, 1.3),
    "inverted, trace zero": stretched(1.4, -0.7, 0.0, 0.0),
}


def all_of_it(F: Tensor, mu: Tensor, lam: Tensor, yield_stress: Tensor) -> Tensor:
    """Return map and stress as the substep chains them; the material values as multiples of MU, LAM and YIELD."""
    material = VonMises(MU * mu, LAM * lam, YIELD * yield_stress)
    Jp = torch.ones_like(F[..., 0, 0])
    mapped, _ = material.return_map(planes(F), Jp)
    return torch.cat((matrix(mapped).flatten(2), torch.stack(material.stress(mapped, Jp), -1) / MU), -1)


def factors(dtype: torch.dtype = torch.float64) -> tuple[Tensor, ...]:
    return tuple(torch.ones((), dtype=dtype, requires_grad=True) for _ in range(3))


@pytest.mark.parametrize("name", POINTS)
def test_gradients_against_finite_differences(name: str) -> None:
    F = POINTS[name][None, None].clone().requires_grad_()
    assert torch.autograd.gradcheck(all_of_it, (F, *factors()), eps=1e-8, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("name", POINTS)
def test_gradients_in_single_precision(name: str) -> None:
    """To 5e-7 of the largest entry, at a point that single precision can represent."""
    F = POINTS[name][None, None].float()
    jacobians = []
    for dtype in (torch.float32, torch.float64):
        jacobian = torch.autograd.functional.jacobian(all_of_it, (F.to(dtype), *factors(dtype)))
        jacobians.append(torch.cat([block.reshape(7, -1).double() for block in jacobian], dim=1))
    single, double = jacobians
    assert single.isfinite().all()
    torch.testing.assert_close(single, double, rtol=0, atol=5e-7 * double.abs().max().item())


def test_gradients_in_single_precision_at_large_strains() -> None:
    """Half are within 5e-7; where stretches differ by a factor of two, rounding in the yield ratio costs more."""
    F, weight = deformations(2000, 0.7, 1.4, seed=0).float(), normal(1, 2000, 7, seed=3)
    gradients = []
    for dtype in (torch.float32, torch.float64):
        point = F.to(dtype).requires_grad_()
        total = (all_of_it(point, *factors(dtype)) * weight.to(dtype)).sum()
        gradients.append(torch.autograd.grad(total, point)[0].double().flatten(2))
    error = (gradients[0] - gradients[1]).norm(dim=2) / gradients[1].norm(dim=2)
    assert error.median() <= 5e-7
    assert error.quantile(0.99) <= 3e-6
    assert error.max() <= 1e-5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "material",
    [VonMises(MU, LAM, YIELD), Snow(MU, LAM), Snow(MU, LAM, shear_cutoff=0.0)],
    ids=["von Mises", "soil", "soil without cutoff"],
)
def test_gradient_of_a_field_has_no_infinities(material: Elastic, dtype: torch.dtype) -> None:
    """Also where branches that are not taken would divide by zero: F = 0, equal stretches, singular F."""
    singular = stretched(1.0, 0.0, 0.5, 0.2)
    F = torch.stack((torch.zeros(2, 2), torch.eye(2), turn(1.0), singular, -torch.eye(2), 1e-12 * turn(0.3)))[None]
    F = F.to(dtype).requires_grad_()
    mapped, after = material.return_map(planes(F), F.new_ones(1, 6))
    total = torch.stack(material.stress(mapped, F.new_ones(1, 6))).sum() + matrix(mapped).sum() + after.sum()
    assert torch.autograd.grad(total, F)[0].isfinite().all()


def test_lame() -> None:
    mu, lam = lame(5000.0, 0.2)
    assert mu == pytest.approx(2083.3333333, rel=1e-9)
    assert lam == pytest.approx(1388.8888889, rel=1e-9)
    young, poisson = torch.tensor([1.0, 7.0]), torch.tensor([0.0, 0.45])
    mu, lam = lame(young, poisson)
    torch.testing.assert_close(mu * (3 * lam + 2 * mu) / (lam + mu), young)
    torch.testing.assert_close(lam / (2 * (lam + mu)), poisson)
