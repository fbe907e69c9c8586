"""Backends: the same numbers, and clear words where one cannot run."""

import shutil
from dataclasses import replace

import pytest
import torch
from scenes import assert_close, lively, normal, robot, robot_and_ball
from torch import Tensor

from torchmpm import ParticleState, Solver
from torchmpm.backends import BACKENDS, compiler_found


def run(solver: Solver) -> tuple[ParticleState, tuple[Tensor, ...]]:
    """Twenty substeps of two simulations, and the gradient in velocities and actuation."""
    state = lively(30, 2, strain=0.1)
    v, actuation = state.v.clone().requires_grad_(), (40.0 * normal(2, 2, 16, 16, seed=1)).requires_grad_()
    origin = torch.tensor([[0.0, 0.0], [0.1, 0.05]], dtype=torch.float64)
    final = solver.step(replace(state, v=v), actuation, substeps=20, origin=origin)
    total = final.x.square().sum() + final.F.square().sum() + 0.1 * final.v.square().sum()
    return final.detach(), torch.autograd.grad(total, (v, actuation))


@pytest.mark.slow
def test_compiled_equals_eager() -> None:
    """To 1e-10 with gradients; where there is no compiler the choice of this backend must say so."""
    solver = robot_and_ball(20, 10)
    if not compiler_found():
        with pytest.raises(ValueError, match="needs a C\\+\\+ compiler"):
            replace(solver, backend="compile")
        return
    (final, gradient), (compiled, of_compiled) = run(solver), run(replace(solver, backend="compile"))
    assert_close(compiled, final, 1e-10)
    for one, other in zip(of_compiled, gradient, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-10 * other.abs().max().item())


def test_auto_is_eager() -> None:
    state = lively(30)
    results = [robot(30, backend=backend).step(state, substeps=5) for backend in ("auto", "eager")]
    assert torch.equal(results[0].x, results[1].x)


def test_unknown_backend() -> None:
    with pytest.raises(ValueError, match=r"backend must be one of \('auto', .*'native'\), got 'warp'"):
        robot(5, backend="warp")
    assert BACKENDS == ("auto", "eager", "compile", "native")


def test_missing_compiler_is_said_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchmpm.solver.compiler_found", lambda: False)
    with pytest.raises(ValueError, match=r"backend 'compile' needs a C\+\+ compiler .* found none: use 'eager'"):
        robot(5, backend="compile")
    robot(5, backend="eager")


@pytest.mark.parametrize(
    ("installed", "variable", "found"),
    [
        ({"g++"}, None, True),
        ({"clang++"}, None, True),
        (set(), None, False),
        ({"g++"}, "icpx", False),
        ({"icpx"}, "icpx", True),
    ],
)
def test_compiler_search(
    monkeypatch: pytest.MonkeyPatch, installed: set[str], variable: str | None, found: bool
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name in installed else None)
    monkeypatch.delenv("CXX", raising=False)
    if variable is not None:
        monkeypatch.setenv("CXX", variable)
    assert compiler_found() == found


@pytest.mark.cuda
def test_cuda_equals_cpu() -> None:
    """To 1e-10 in double precision: only the order of the sums on the nodes differs."""
    solver, state, field = robot_and_ball(20, 10), lively(30, 2, strain=0.1), 40.0 * normal(2, 2, 16, 16, seed=1)
    on_cpu = solver.step(state, field, substeps=20)
    on_cuda = solver.step(state.to("cuda"), field.to("cuda"), substeps=20)
    assert on_cuda.device.type == "cuda"
    assert_close(on_cuda.to("cpu"), on_cpu, 1e-10)
