"""The largest stable substep: where it comes from, that it holds, and that a solver beyond it is refused."""

import math
import re
from dataclasses import replace

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import GRID, generator, normal, positions

from torchmpm import Body, Elastic, ParticleState, Snow, Solver, VonMises, lame
from torchmpm.materials.linalg import Mat2
from torchmpm.native.library import find_compiler
from torchmpm.substep import muscle_stress

MU, LAM = 300.0, 200.0
MATERIALS = {
    "elastic": Elastic(MU, LAM),
    "von Mises": VonMises(MU, LAM, 60.0),
    "soil": Snow(MU, LAM),
    "hard soil": Snow(MU, LAM, hardening_range=(3.0, 5.0)),
    "weak soil": Snow(MU, LAM, hardening_range=(0.1, 0.5)),
    "widening when pulled": Elastic(*lame(1000.0, -0.2)),
    "widening, as tensors": Elastic(*(torch.tensor(value).double() for value in lame(1000.0, -0.2))),
}


def largest_slope(stress) -> float:
    """Largest singular value of the derivative of a stress, as a function of planes of F, at F = I."""

    def full(F: torch.Tensor) -> torch.Tensor:
        planes: Mat2 = tuple(entry.view(1, 1) for entry in F)
        xx, xy, yy = stress(planes)
        return torch.cat((xx, xy, xy, yy)).flatten()

    identity = torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.linalg.matrix_norm(torch.autograd.functional.jacobian(full, identity), 2).item()


@pytest.mark.parametrize("name", MATERIALS)
def test_stiffness_is_the_largest_slope_of_the_stress(name: str) -> None:
    material, one = MATERIALS[name], torch.ones(1, 1, dtype=torch.float64)
    slope = largest_slope(lambda F: material.stress(F, one))
    assert float(material.stiffness()) == pytest.approx(slope, rel=1e-12)
    # Muscles add at most twice their actuation.
    pull = (90.0, -40.0)
    pulled = largest_slope(lambda F: torch.stack(muscle_stress(F, pull)) + torch.stack(material.stress(F, one)))
    assert slope < pulled <= slope + 2 * 90.0


def growth(solver: Solver, state: ParticleState, substeps: int) -> float:
    """By how much the largest strain grows from a random one of 1e-7."""
    identity = torch.eye(2, dtype=torch.float64)
    strain = 1e-7 * normal(*state.F.shape, seed=1)
    final = solver.step(replace(state, F=identity + strain), substeps=substeps)
    return ((final.F - identity).abs().max() / strain.abs().max()).item()


def at_limit(count: int, share: float, backend: str) -> Solver:
    """A body in free space whose substep is this share of the largest stable one."""
    loose = Solver(GRID, (Body(count, Elastic(MU, LAM), mass=2.0),), backend=backend, allow_unstable=True)
    return replace(loose, dt=share * loose.stable_dt())


@pytest.mark.usefixtures("backend")
def test_a_particle_alone_is_stable_up_to_it_and_not_beyond() -> None:
    state = ParticleState.at_rest(positions(1))
    assert growth(at_limit(1, 0.99, scenes.BACKEND), state, 60) < 8
    assert growth(at_limit(1, 1.02, scenes.BACKEND), state, 60) > 1e4


@settings(max_examples=40)
@given(st.integers(1, 80), st.sampled_from([0.02, 0.1, 0.3]), st.integers(0, 999))
def test_small_strains_of_any_arrangement_stay_small(count: int, size: float, seed: int) -> None:
    x = 0.35 + size * torch.rand(1, count, 2, generator=generator(seed), dtype=torch.float64)
    solver = at_limit(count, 0.99, "native" if find_compiler() else "eager")
    # Strains may grow for a while, by 48 in the worst case found (in 3,000 substeps), but not without bound.
    assert growth(solver, ParticleState.at_rest(x), 200) < 100


def test_beyond_it_a_solver_is_refused_and_told_the_limit() -> None:
    body = Body(5, Elastic(MU, LAM), mass=2.0, volume=0.5)
    limit = GRID.h / math.sqrt(2 * (MU + LAM) * 0.5 / 2.0)
    with pytest.raises(ValueError, match=r"dt must be at most .* s .*got 0\.1") as raised:
        Solver(GRID, (body,), dt=0.1)
    named = float(re.search(r"at most (\S+) s", str(raised.value))[1])
    assert named == pytest.approx(limit, rel=1e-12)
    assert Solver(GRID, (body,), dt=named).stable_dt() == named
    with pytest.raises(ValueError, match="allow_unstable"):
        Solver(GRID, (body,), dt=math.nextafter(named, 1.0))
    assert Solver(GRID, (body,), dt=0.1, allow_unstable=True).stable_dt() == named


def test_the_stiffest_and_lightest_particle_counts() -> None:
    slow = Body(5, Elastic(10.0, 0.0))
    shapes = {"number": 8.0, "()": torch.tensor(8.0), "(B,)": torch.tensor([2.0, 8.0, 4.0]), "(B, N)": torch.ones(3, 5)}
    shapes["(B, N)"][1, 4] = 8.0
    for mu in shapes.values():
        solver = Solver(GRID, (slow, Body(5, Elastic(100.0 * mu, 0.0), mass=1.0 / torch.ones(3, 5))))
        assert solver.stable_dt() == pytest.approx(GRID.h / 40.0)
    light = Solver(GRID, (slow, Body(5, Elastic(100.0, 0.0), mass=torch.tensor([0.5, 0.125, 1.0]))))
    assert light.stable_dt() == pytest.approx(GRID.h / 40.0)
    assert Solver(GRID, (Body(5, Elastic(0.0, 0.0)),), dt=1e9).stable_dt() == math.inf


def test_muscles_count_where_there_are_any() -> None:
    solver = Solver(GRID, (Body(5, Elastic(MU, LAM), muscle=True), Body(5, Elastic(1.5 * MU, LAM))))
    assert solver.stable_dt() == solver.stable_dt(100.0) == pytest.approx(GRID.h / math.sqrt(1300.0))
    assert solver.stable_dt(-200.0) == pytest.approx(GRID.h / math.sqrt(1400.0))
    assert solver.stable_dt(torch.tensor([0.0, 200.0])) == pytest.approx(GRID.h / math.sqrt(1400.0))


def test_a_stiffness_with_a_graph() -> None:
    """Of a material that does not detach it; (B,) goes together with (B, 1) and (B, count)."""

    class Learned(Elastic):
        def stiffness(self) -> torch.Tensor:
            return 2.0 * (self.mu + self.lam)

    mu = torch.tensor([MU, 1.5 * MU], requires_grad=True)
    solver = Solver(GRID, (Body(5, Learned(mu, LAM), mass=torch.ones(2), muscle=True),))
    assert solver.stable_dt(torch.tensor([100.0, 0.0])) == pytest.approx(GRID.h / math.sqrt(1300.0))
