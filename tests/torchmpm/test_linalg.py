"""Closed forms of 2x2 matrices against torch.linalg."""

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scenes import matrix, normal, planes, turn
from torch import Tensor

from torchmpm.materials import linalg

ENTRY = st.floats(-3.0, 3.0).filter(lambda number: number == 0.0 or abs(number) > 1e-6)
MATRIX = st.tuples(ENTRY, ENTRY, ENTRY, ENTRY)


def polar(F: Tensor) -> Tensor:
    return matrix(linalg.orthogonal(planes(F)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_polar_against_svd(dtype: torch.dtype) -> None:
    F = normal(4000, 2, 2, seed=0).to(dtype)
    F = F[torch.linalg.det(F).abs() > 0.05]
    assert (torch.linalg.det(F) < 0).sum() > 1000
    U, _, Vh = torch.linalg.svd(F)
    torch.testing.assert_close(polar(F), U @ Vh, rtol=0, atol=100 * torch.finfo(dtype).eps)


@given(MATRIX)
def test_polar_factor_is_orthogonal_and_leaves_a_positive_factor(entries: tuple[float, ...]) -> None:
    F = torch.tensor(entries, dtype=torch.float64).view(2, 2)
    R = polar(F)
    torch.testing.assert_close(R @ R.T, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-14)
    S = R.T @ F
    torch.testing.assert_close(S, S.T, rtol=0, atol=1e-13)
    assert torch.linalg.eigvalsh(0.5 * (S + S.T)).min() >= -1e-13
    det = torch.linalg.det(F).item()
    assume(abs(det) > 1e-9)
    assert torch.linalg.det(R).item() == pytest.approx(math.copysign(1.0, det), abs=1e-13)


def test_polar_of_zero_is_the_identity() -> None:
    assert torch.equal(polar(torch.zeros(3, 2, 2)), torch.eye(2).expand(3, 2, 2))


def test_polar_of_a_singular_matrix_is_a_rotation() -> None:
    """det = 0 counts as not inverted."""
    F = torch.tensor([[3.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(polar(F), torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-15)


POINTS = {
    "identity": torch.eye(2, dtype=torch.float64),
    "rotation": turn(2.0),
    "stretch": torch.diag(torch.tensor([1.7, 1.7], dtype=torch.float64)),
    "shear": torch.tensor([[1.0, 0.9], [0.1, 0.6]], dtype=torch.float64),
    "reflection": torch.diag(torch.tensor([1.0, -1.0], dtype=torch.float64)),  # trace zero
    "inverted": torch.tensor([[0.3, 1.1], [0.8, -0.2]], dtype=torch.float64),
}


@pytest.mark.parametrize("name", POINTS)
def test_gradient_of_the_polar_factor(name: str) -> None:
    F = POINTS[name].clone().requires_grad_()
    assert torch.autograd.gradcheck(polar, (F,), atol=1e-8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("small", [1e-3, 1e-8, 1e-15])
def test_gradient_beside_singular_matrices_is_bounded(small: float, sign: float) -> None:
    """The reference's rule for det F < 0: without it an inverted F with trace near zero has gradients of 1e14."""
    for angle in (0.0, 0.7, 2.9):
        F = (turn(angle) @ torch.diag(torch.tensor([1.0, sign * small], dtype=torch.float64))).requires_grad_()
        jacobian = torch.autograd.functional.jacobian(polar, F)
        assert jacobian.abs().max() <= 2.0


def test_gradient_at_zero_is_finite() -> None:
    F = torch.zeros(2, 2, requires_grad=True)
    assert torch.autograd.functional.jacobian(polar, F).isfinite().all()


@given(MATRIX, MATRIX)
def test_products(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    A, B = (torch.tensor(entries, dtype=torch.float64).view(2, 2) for entries in (first, second))
    torch.testing.assert_close(matrix(linalg.matmul(planes(A), planes(B))), A @ B, rtol=1e-14, atol=1e-14)
    assert linalg.det(planes(A)).item() == pytest.approx(torch.linalg.det(A).item(), abs=1e-13)


@given(MATRIX)
def test_polar_parts_give_the_singular_values(entries: tuple[float, ...]) -> None:
    F = torch.tensor(entries, dtype=torch.float64).view(2, 2)
    m1, m2, n1, n2, proper = linalg.polar_parts(planes(F))
    lengths = torch.stack((torch.hypot(m1, m2), torch.hypot(n1, n2)))
    sigma = torch.linalg.svdvals(F)
    torch.testing.assert_close(lengths, torch.stack((sigma.sum(), sigma[0] - sigma[1])), rtol=1e-12, atol=1e-12)
    half = 0.5 * torch.stack(linalg.from_polar_parts(linalg.PolarParts(m1, m2, n1, n2, proper)))
    torch.testing.assert_close(half.view(2, 2), F, rtol=0, atol=1e-15)
