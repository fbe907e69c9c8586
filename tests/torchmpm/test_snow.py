"""Snow against an independent singular value decomposition, and its derivatives against finite differences."""

import math

import numpy as np
import pytest
import torch
from test_material import deformations, matrix, planes, stretched, symmetric, turn
from torch import Tensor

from torchmpm import Snow, lame
from torchmpm.materials.elastic import corotated_stress
from torchmpm.materials.snow import snow_return

MU, LAM = lame(5000.0, 0.2)
LOW, HIGH = 0.975, 1.0045


def soil(**values) -> Snow:
    return Snow(MU, LAM, **values)


def by_svd(F: np.ndarray, cutoff: float) -> tuple[np.ndarray, float]:
    """Clamped F, and area before over after, from R, S and one Jacobi rotation (mpm.md 6.2 and 6.6)."""
    U, sigma, Vt = np.linalg.svd(F)
    R, S = U @ Vt, Vt.T @ np.diag(sigma) @ Vt
    if abs(S[0, 1]) < cutoff:
        sigma, V = np.diag(S).copy(), np.eye(2)
    else:
        sigma, V = np.linalg.eigh(S)
    new = np.clip(sigma, LOW, HIGH)
    return R @ V @ np.diag(new) @ V.T, float(np.prod(sigma / new))


@pytest.mark.parametrize("cutoff", [0.0, 1e-5, 0.02])
def test_clamp_against_svd(cutoff: float) -> None:
    """All around the range, some inverted; the large cutoff catches about half of them."""
    F = torch.cat((deformations(300, 0.96, 1.03, seed=1), deformations(100, 0.2, 3.0, seed=2)), 1)
    clamped, squeezed = snow_return(planes(F), LOW, HIGH, cutoff)
    expected = [by_svd(f, cutoff) for f in F[0].numpy()]
    np.testing.assert_allclose(matrix(clamped)[0].numpy(), np.stack([e[0] for e in expected]), rtol=0, atol=2e-14)
    np.testing.assert_allclose(squeezed[0].numpy(), [e[1] for e in expected], rtol=1e-13)


@pytest.mark.parametrize(("Jp", "factor"), [(1.0, 1.0), (0.9, math.e), (0.5, 5.0), (1.1, 1 / math.e), (2.0, 0.1)])
def test_hardening(Jp: float, factor: float) -> None:
    F = deformations(10, LOW, HIGH, seed=5, share_inverted=0.0)
    tau = symmetric(soil().stress(planes(F), torch.full((1, 10), Jp, dtype=torch.float64)))
    expected = symmetric(corotated_stress(planes(F), factor * MU, factor * LAM))
    torch.testing.assert_close(tau, expected, rtol=1e-12, atol=1e-10)


def test_inverted_soil_is_at_rest_in_its_mirrored_shape() -> None:
    F = (turn(0.3) @ torch.diag(torch.tensor([1.0, -1.0], dtype=torch.float64)))[None, None]
    one = torch.ones(1, 1, dtype=torch.float64)
    assert symmetric(soil().stress(planes(F), one)).abs().max() < 1e-10
    assert soil().energy(planes(F), one).abs().max() < 1e-20


POINTS = {
    "identity": torch.eye(2, dtype=torch.float64),
    "rotated": turn(0.7),
    "inside": stretched(1.003, 0.98, 0.4, 1.3),
    "one stretched": stretched(1.02, 0.99, 0.4, 1.3),
    "both squeezed": stretched(0.95, 0.9, 0.4, 1.3),
    "both squeezed alike": 0.9 * turn(0.2),
    "beyond both ends": stretched(1.1, 0.9, 0.4, 1.3),
    "inverted": stretched(1.1, -0.98, 0.4, 1.3),
}


def all_of_it(F: Tensor, Jp: Tensor, mu: Tensor) -> Tensor:
    """Return map and stress as the substep chains them, without the cutoff: it is not continuous."""
    material = Snow(MU * mu, LAM, shear_cutoff=0.0)
    mapped, after = material.return_map(planes(F), Jp)
    return torch.cat((matrix(mapped).flatten(2), torch.stack((*material.stress(mapped, Jp), after), -1) / MU), -1)


@pytest.mark.parametrize("name", POINTS)
def test_gradients_against_finite_differences(name: str) -> None:
    F = POINTS[name][None, None].clone().requires_grad_()
    Jp, mu = torch.full((1, 1), 0.95, dtype=torch.float64, requires_grad=True), torch.ones((), dtype=torch.float64)
    assert torch.autograd.gradcheck(all_of_it, (F, Jp, mu.requires_grad_()), eps=1e-8, atol=1e-7, rtol=1e-6)


def test_steep_hardening_has_derivatives() -> None:
    """Where the factor is at its bound its exponential overflows: the derivative there is zero, not no number."""
    for Jp, at_bound in ((0.05, True), (1.5, True), (0.99, False)):
        plane = torch.full((1, 1), Jp, requires_grad=True)
        xx, *_ = soil(hardening=100.0).stress(tuple(torch.tensor([[[[f]]]]) for f in (1.1, 0.0, 0.0, 1.0)), plane)
        plain, *_ = soil(hardening=0.0).stress(
            tuple(torch.tensor([[[[f]]]]) for f in (1.1, 0.0, 0.0, 1.0)), plane.detach()
        )
        (slope,) = torch.autograd.grad(xx.sum(), plane)
        factor = min(max(math.exp(100.0 * (1.0 - Jp)), 0.1), 5.0)
        torch.testing.assert_close(xx, factor * plain)
        assert (slope == 0) == at_bound and slope.isfinite()


@pytest.mark.parametrize("cutoff", [0.0, 1e-5])
def test_return_map_between_the_bounds_is_the_identity_in_single_precision_too(cutoff: float) -> None:
    """Where the principal stretches are nearly equal, a quotient of rounded differences would spoil the derivative."""
    small = 5e-8 * torch.tensor([[[[1.0, 0.7], [0.4, -0.3]]]])
    F = tuple(plane.requires_grad_() for plane in planes(torch.eye(2) + small))
    returned, _ = snow_return(F, LOW, HIGH, cutoff)
    if not cutoff:  # which makes this F symmetric
        slopes = torch.autograd.grad(returned[0].sum(), F)
        torch.testing.assert_close(torch.cat(slopes, 1), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.cat(returned, 1), torch.cat(F, 1), atol=2e-7, rtol=0)
