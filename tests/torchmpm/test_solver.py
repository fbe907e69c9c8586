"""The substep: against a loop after mpm.md, in closed form, by its symmetries and balances, and in batches."""

import itertools
import math
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scenes
import torch
from scenes import GRID, assert_close, assert_identical, generator, lively, normal, positions, robot, robot_and_ball
from test_material import return_by_svd
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Solver, VelocityRule, VonMises, diagnostics, fixed
from torchmpm.materials.body import METHODS

pytestmark = pytest.mark.usefixtures("backend")

R, H = GRID.resolution, GRID.h


def field(batch: int = 1, size: float = 60.0, seed: int = 0) -> Tensor:
    """Random muscle actuation on all nodes."""
    return size * normal(batch, 2, R, R, seed=seed)


# --- against a loop -------------------------------------------------------------------------------------------------


def return_and_stress(F: np.ndarray, material: VonMises | Elastic) -> tuple[np.ndarray, np.ndarray]:
    """mpm.md 6.3 and 6.4 with an SVD; without the reference's habit of dropping small shears (6.2)."""
    if isinstance(material, VonMises):
        F, _ = return_by_svd(F, material.yield_stress / (2 * material.mu))
    U, _, Vt = np.linalg.svd(F)
    J = np.linalg.det(F)
    return F, 2 * material.mu * (F - U @ Vt) @ F.T + material.lam * J * (J - 1) * np.eye(2)


def reference_substep(
    solver: Solver, state: dict[str, np.ndarray], actuation: np.ndarray | None, origin: np.ndarray
) -> dict[str, np.ndarray]:
    """One substep of one simulation, particle by particle and node by node, in the order of mpm.md 4."""
    n, h, dt = solver.grid.resolution, solver.grid.h, solver.dt
    state = {name: value.copy() for name, value in state.items()}
    grid_mass, grid_v = np.zeros((n, n)), np.zeros((n, n, 2))
    bodies = [body for body in solver.bodies for _ in range(body.count)]

    def nodes(x: np.ndarray) -> list[tuple[int, int, float, np.ndarray]]:
        u = (x - origin) / h
        base = np.trunc(u - 0.5).astype(int)
        f = u - base
        w = np.stack((0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2))
        around = ((p, q) for p in range(3) for q in range(3))
        found = [(base[0] + p, base[1] + q, w[p, 0] * w[q, 1], (np.array((p, q)) - f) * h) for p, q in around]
        return [node for node in found if 0 <= node[0] < n and 0 <= node[1] < n]

    offsets = state["x"] - origin
    inside = [k for k, (x, y) in enumerate(offsets) if 1e-5 < x < n * h - 1e-5 and 0.0 <= y <= n * h]
    for k in inside:
        body, x, v, C = bodies[k], state["x"][k], state["v"][k], state["C"][k]
        F, tau = return_and_stress((np.eye(2) + dt * C) @ state["F"][k], body.material)
        state["F"][k] = F
        if body.muscle and actuation is not None:
            alpha = sum((w * actuation[:, i, j] for i, j, w, _ in nodes(x)), np.zeros(2))
            tau = tau + F @ np.diag(alpha) @ F.T
        P = -dt * body.volume * 4 / h**2 * tau + body.mass * C
        for i, j, w, d in nodes(x):
            grid_mass[i, j] += w * body.mass
            grid_v[i, j] += w * (body.mass * v + P @ d)

    shift = np.trunc(origin / h).astype(int)
    for i, j in itertools.product(range(n), range(n)):
        v = grid_v[i, j] / (grid_mass[i, j] + 1e-10)
        v = solver.damping * (v + dt * np.array(solver.gravity))
        for rule in solver.rules:
            node = np.array((i, j)) + (shift if rule.frame == "world" else 0)
            ends = [
                (-math.inf if low is None else low, math.inf if high is None else high)
                for low, high in (rule.i, rule.j)
            ]
            axis, sign = "xy".index(rule.direction[1]), int(rule.direction[0] + "1")
            if all(low <= c <= high for c, (low, high) in zip(node, ends, strict=True)) and v[axis] * sign > 0:
                v[axis] = 0.0
                if rule.friction == math.inf:
                    v[:] = 0.0
        grid_v[i, j] = v

    for k in inside:
        around = nodes(state["x"][k])
        state["v"][k] = sum((w * grid_v[i, j] for i, j, w, _ in around), np.zeros(2))
        state["C"][k] = 4 / h**2 * sum((w * np.outer(grid_v[i, j], d) for i, j, w, d in around), np.zeros((2, 2)))
        state["x"][k] += dt * state["v"][k]
    return state


@pytest.mark.parametrize("strain", [0.01, 0.2], ids=["elastic", "yielding"])
@pytest.mark.parametrize("moved", [0.0, -0.31], ids=["window at home", "window moved"])
def test_against_a_loop_over_particles_and_nodes(strain: float, moved: float) -> None:
    """Three bodies, muscles, rules in both frames, damping, and particles beyond every edge of the window."""
    origin = torch.tensor([[moved, 0.02]], dtype=torch.float64)
    rules = (
        VelocityRule("-y", j=(None, 6), friction=math.inf),
        VelocityRule("+x", i=(9, 9)),
        *fixed((10, 11), (4, 6), frame="window"),
    )
    tail = Body(6, VonMises(700.0, 30.0, 40.0), mass=1.0, muscle=True)
    bodies = (*robot_and_ball(12, 8).bodies, tail)
    solver = robot(26, bodies=bodies, rules=rules, damping=0.999)
    state = lively(26, strain=strain)
    x = origin + state.x
    places = [(-0.1, 0.5), (0.02, 0.5), (0.99, 0.5), (1.2, 0.5), (0.5, -0.11), (0.5, -0.02), (0.5, 0.97), (0.5, 1.3)]
    x[0, 10:18] = origin + torch.tensor(places, dtype=torch.float64)
    state = replace(state, x=x)
    actuation = field()

    expected = {name: getattr(state, name)[0].numpy() for name in ("x", "v", "C", "F")}
    for _ in range(3):
        expected = reference_substep(solver, expected, actuation[0].numpy(), origin[0].numpy())
    found = solver.step(state, actuation, substeps=3, origin=origin)
    # What yields is as exact as the return map (3e-7 in F), and stress passes that on.
    tolerance = {"x": 1e-13, "v": 1e-11, "C": 1e-9, "F": 1e-12} if strain < 0.05 else {}
    for name, allowed in ({"x": 1e-9, "v": 2e-6, "C": 1e-4, "F": 1e-6} | tolerance).items():
        error = np.abs(getattr(found, name)[0].numpy() - expected[name]).max()
        assert error <= allowed, f"{name} differs by {error:.1e}"
    assert torch.equal(found.Jp, state.Jp)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_positive_actuation_contracts(axis: int, sign: float) -> None:
    """Along its own direction, a negative one extends; and never moves the centre of mass."""
    state = ParticleState.at_rest(positions(300))
    actuation = torch.zeros(1, 2, R, R, dtype=torch.float64)
    actuation[:, axis] = sign * 40.0
    result = robot(300, rules=(), gravity=(0.0, 0.0)).step(state, actuation, substeps=40)
    growth = (result.x.std(1) / state.x.std(1) - 1.0)[0]
    assert sign * growth[axis].item() < -1e-4
    assert growth[axis].abs() > 3 * growth[1 - axis].abs()
    torch.testing.assert_close(result.x.mean(1), state.x.mean(1), rtol=0, atol=1e-12)


def test_steps_add_up() -> None:
    solver, state = robot(40), lively(40)
    assert_identical(solver.step(solver.step(state, substeps=4), substeps=3), solver.step(state, substeps=7))
    assert_identical(solver.step(state, substeps=0), state)


# --- balances -------------------------------------------------------------------------------------------------------

CONTACT = (VelocityRule("-y", j=(None, 7), friction=math.inf), VelocityRule("+x", i=(9, None), friction=0.4))


@pytest.mark.parametrize("muscles", [False, True], ids=["passive", "muscles"])
def test_angular_momentum_in_free_space(muscles: bool) -> None:
    """To 1e-9 of its size over 100 substeps: APIC carries the spin, and every stress is symmetric."""
    solver, state = robot_and_ball(300, 100, rules=(), gravity=(0.0, 0.0)), lively(400)
    before = diagnostics.angular_momentum(solver, state)
    after = diagnostics.angular_momentum(solver, solver.step(state, field() if muscles else None, substeps=100))
    assert before.abs() > 1.0
    torch.testing.assert_close(after, before, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("material", "kept"), [(Elastic(300.0, 80.0), 0.3), (VonMises(300.0, 80.0, 1.0), 0.02)], ids=["elastic", "plastic"]
)
def test_energy_of_a_body(material: Elastic, kept: float) -> None:
    """APIC and plastic flow may lose energy, a body in free space gains none to speak of (1e-3 over 100 substeps)."""
    solver = Solver(GRID, (Body(400, material, mass=2.0),), backend=scenes.BACKEND)
    state = lively(400, strain=0.03)

    def energy(state: ParticleState) -> float:
        spin = 0.5 * (H**2 / 4) * 2.0 * state.C.square().sum()
        return (diagnostics.kinetic_energy(solver, state) + diagnostics.elastic_energy(solver, state) + spin).item()

    energies = [energy(state)]
    for _ in range(10):
        state = solver.step(state, substeps=10)
        energies.append(energy(state))
    assert max(energies) <= energies[0] * 1.001
    assert energies[-1] > kept * energies[0]


# --- batches --------------------------------------------------------------------------------------------------------


def test_batch_equals_independent_runs() -> None:
    """To 1e-12 over 100 substeps, with different materials, masses, gravity, windows and actuation each."""
    B, N = 3, 80
    scale = torch.tensor([0.7, 1.0, 1.4], dtype=torch.float64)
    per_particle = 1.0 + torch.rand(B, 20, generator=generator(5), dtype=torch.float64)
    gravity = torch.tensor([[0.0, -9.8], [3.0, 0.0], [-1.0, 5.0]], dtype=torch.float64)
    origin = torch.tensor([[0.0, 0.0], [-0.17, 0.05], [0.21, -0.1]], dtype=torch.float64)
    state, actuation = lively(N, B), field(B)

    def solver(b: slice) -> Solver:
        bodies = (
            Body(60, VonMises(500.0 * scale[b], 50.0 * scale[b], 40.0), mass=2.0 * scale[b], muscle=True),
            Body(20, Elastic(300.0, 80.0 * per_particle[b]), mass=per_particle[b], volume=1.5 * scale[b]),
        )
        return robot(N, bodies=bodies, gravity=gravity[b], rules=CONTACT)

    together = solver(slice(None)).step(state, actuation, substeps=100, origin=origin)
    assert together.is_finite().all()
    for b in range(B):
        one = slice(b, b + 1)
        alone = solver(one).step(state[b], actuation[one], substeps=100, origin=origin[one])
        assert_close(together[b], alone, 1e-12)
    assert not torch.allclose(together.v[0], together.v[1])


# --- the window -----------------------------------------------------------------------------------------------------


def test_input_is_left_as_it_was() -> None:
    state, actuation = lively(30, 2), field(2)
    copy, field_copy = state.clone(), actuation.clone()
    robot(30).step(state, actuation, substeps=3)
    assert_identical(state, copy)
    assert torch.equal(actuation, field_copy)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_is_the_state_s(dtype: torch.dtype) -> None:
    state = lively(100).to(dtype)
    result = robot_and_ball(60, 40).step(state, field().to(dtype), substeps=20)
    assert {t.dtype for t in result.components()} == {dtype}
    exact = robot_and_ball(60, 40).step(lively(100), field(), substeps=20)
    torch.testing.assert_close(result.x.double(), exact.x, rtol=0, atol=1e-6)


def test_spacing_is_only_a_unit() -> None:
    """Twice the lengths and times, so the same velocities; but for the 1e-10 kg that every node gets."""
    state = lively(60)
    small = robot(60, gravity=(0.0, 0.0), rules=())
    large = replace(small, grid=Grid(R, spacing=2 * H), dt=2 * small.dt)
    body = large.bodies[0]
    large = replace(large, bodies=(replace(body, mass=4 * body.mass, volume=4 * body.volume),))
    doubled = large.step(replace(state, x=2 * state.x, C=state.C / 2), field(), substeps=20)
    here = small.step(state, field(), substeps=20)
    assert_close(replace(doubled, x=doubled.x / 2, C=doubled.C * 2), here, 1e-7)


def test_a_list_of_bodies_is_copied() -> None:
    """All backends see the bodies that the solver was made with."""
    bodies, rules = list(robot(5).bodies), list(robot(5).rules)
    solver = robot(5, bodies=bodies, rules=rules)
    before = solver.step(lively(5), substeps=3)
    bodies[0] = Body(5, Elastic(1.0, 1.0))
    rules.clear()
    assert_identical(solver.step(lively(5), substeps=3), before)
    assert solver.rules == robot(5).rules


def test_other_constants_in_the_same_solver() -> None:
    """As if it had been made with them, but without checks."""
    solver, state = robot(20), lively(20)
    solver.step(state)
    bodies = (Body(20, VonMises(torch.tensor([400.0]), 50.0, 60.0), mass=2.0, muscle=True),)
    other = solver.with_constants(bodies, (0.0, -3.0))
    expected = robot(20, bodies=bodies, gravity=(0.0, -3.0))
    assert_identical(other.step(state, field(), substeps=3), expected.step(state, field(), substeps=3))
    stiff = (Body(20, Elastic(1e12, 0.0)),)
    assert solver.with_constants(stiff, (0.0, 0.0)).stable_dt() < solver.dt


def test_a_copy_of_a_solver_builds_its_own_tables() -> None:
    solver, state = robot(20), lively(20)
    expected = solver.step(state, substeps=2)
    assert_identical(pickle.loads(pickle.dumps(solver)).step(state, substeps=2), expected)


def own_law(name: str, value: Tensor) -> SimpleNamespace:
    """A law of somebody else, with a tensor of some kind."""
    law = Elastic(300.0, 50.0)
    return SimpleNamespace(**{method: getattr(law, method) for method in METHODS}, **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("log_mass", torch.tensor(-1.0)),
        ("mass", torch.tensor(-1.0)),
        ("volume", torch.tensor([0.0, -2.0])),
        ("table", torch.zeros(0)),
        ("on", torch.tensor([True, False])),
        ("phase", torch.tensor(1j)),
        ("index", torch.tensor([-3])),
    ],
)
def test_tensors_of_a_material_may_be_of_all_kinds(name: str, value: Tensor) -> None:
    own, known = (
        robot(5, bodies=(Body(5, law, mass=2.0),), backend="eager").step(lively(5), substeps=2)
        for law in (own_law(name, value), Elastic(300.0, 50.0))
    )
    assert_identical(own, known)


def test_numbers_of_a_material_and_of_bodies_are_checked() -> None:
    with pytest.raises(ValueError, match=r"bodies\[0\].material.log_mass"):
        robot(5, bodies=(Body(5, own_law("log_mass", torch.tensor(math.nan)), mass=2.0),))
