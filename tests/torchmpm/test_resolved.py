"""Derivatives of snow where it is too stiff or too fast for the substep, and where it is not."""

from dataclasses import replace

import pytest
import scenes
import torch
from native_scenes import solvers
from scenes import Leaves, normal, robot
from test_native_adjoint import compare_gradients, gradients, state_leaves

from torchmpm import Body, Snow, Solver
from torchmpm.native.library import find_compiler

COUNT = 24
#: Of the soil below: the hardening factor at which a substep becomes unstable, as in DIG below the bound of 5.
LIMIT = 390625.0 / 2e5


def hard_soil(count: int = COUNT, lam: float = 4e4, **changes: object) -> Solver:
    """Soil that a substep resolves until it hardens."""
    material = Snow(6e4, lam, **changes)
    return robot(count, bodies=(Body(count, material),), rules=())


def hardened(count: int = COUNT, batch: int = 1) -> Leaves:
    """Elastic states, some of them hard; every fifth particle spins faster than a substep resolves."""
    leaves = state_leaves(count, batch)
    F = torch.eye(2, dtype=torch.float64) + 0.001 * normal(batch, count, 2, 2, seed=1)
    C = leaves["C"].clone()
    C[:, ::5, 0, 1] += 400.0
    C[:, ::5, 1, 0] -= 400.0
    return leaves | {"F": 0.99 * F, "C": C, "Jp": torch.linspace(0.8, 1.2, count).double().expand(batch, -1)}


def gradient(given: Leaves, substeps: int, *wanted: str, **changes: object) -> Leaves:
    return gradients(lambda _: hard_soil(**changes), given, wanted, substeps, scenes.BACKEND)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("name", ["soil", "three bodies", "tensor values"])
def test_resolved_motion_has_the_exact_gradient(name: str) -> None:
    """To the last bit."""

    def solver(exact: bool) -> Solver:
        made = solvers(COUNT, 1)[name]
        bodies = [
            replace(b, material=replace(b.material, exact_gradients=exact)) if isinstance(b.material, Snow) else b
            for b in made.bodies
        ]
        return replace(made, bodies=tuple(bodies))

    given = state_leaves(COUNT, 1)
    found, expected = (
        gradients(lambda _, exact=exact: solver(exact), given, tuple(given), 10, scenes.BACKEND)
        for exact in (False, True)
    )
    for leaf, value in expected.items():
        assert torch.equal(found[leaf], value), leaf


@pytest.mark.usefixtures("backend")
def test_hard_soil_has_the_tangent_of_the_stiffest_that_is_stable() -> None:
    given = hardened() | {"C": state_leaves(COUNT, 1)["C"]}
    found, exact = (gradient(given, 1, "F", "Jp", "v", exact_gradients=exact) for exact in (False, True))
    softer = gradient(given, 1, "F", exact_gradients=True, hardening_range=(0.1, LIMIT))
    torch.testing.assert_close(found["F"], softer["F"], rtol=1e-9, atol=1e-12)
    hard = torch.exp(10.0 * (1.0 - given["Jp"])) > LIMIT
    assert hard.any() and not hard.all()
    same = (found["F"] == exact["F"]).flatten(2).all(-1)
    assert same[~hard].all() and not same[hard].all()
    assert torch.equal(found["Jp"], exact["Jp"]) and torch.equal(found["v"], exact["v"])


@pytest.mark.usefixtures("backend")
def test_grains_that_spin_too_fast_pass_no_derivative_on() -> None:
    given = hardened() | {"Jp": torch.ones(1, COUNT).double()}
    wanted = ("x", "v", "C", "F", "Jp")
    found, exact = (gradient(given, 1, *wanted, exact_gradients=exact) for exact in (False, True))
    fast = torch.arange(COUNT) % 5 == 0
    for name in wanted:
        assert (found[name][:, fast] == 0).all()
        assert torch.equal(found[name][:, ~fast], exact[name][:, ~fast])
    assert all(exact[name][:, fast].abs().amax() > 0 for name in wanted[:4])


@pytest.mark.usefixtures("backend")
def test_states_are_those_of_the_exact_gradient() -> None:
    given = hardened()
    state = scenes.ParticleState(*(given[name] for name in ("x", "v", "C", "F", "Jp")))
    scenes.assert_identical(*(hard_soil(exact_gradients=exact).step(state, substeps=30) for exact in (False, True)))


@pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize(("substeps", "lam"), [(1, 4e4), (25, 4e4), (1, -2e4)])
def test_backends_agree(batch: int, substeps: int, lam: float) -> None:
    given = hardened(batch=batch)
    compare_gradients(lambda _: hard_soil(lam=lam), given, tuple(given), substeps, 1e-9)


@pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
def test_gradients_of_hard_soil_do_not_grow() -> None:
    """Of soil at rest, hardened to 5, where the exact ones grow in every substep."""
    still = scenes.ParticleState.at_rest(scenes.positions(COUNT))
    given = state_leaves(COUNT, 1) | {name: getattr(still, name) for name in ("x", "v", "C", "F")}
    given["Jp"] = torch.full((1, COUNT), 0.8, dtype=torch.float64)
    limited, exact = (
        gradients(lambda _, exact=exact: hard_soil(exact_gradients=exact), given, ("F",), 60, "native")["F"].norm()
        for exact in (False, True)
    )
    assert limited < 100.0 < 1e6 < exact
