"""Laws that hold for any scene: balances, symmetries, Galilean invariance, independence of a batch's elements.

Hypothesis draws the scenes: bodies of all materials, from one particle up, windows, gravity, damping, rules, muscles.
"""

from dataclasses import dataclass, replace

import pytest
import scenes
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import assert_close, assert_identical, generator
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Snow, Solver, VelocityRule, VonMises, diagnostics, tree
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.usefixtures("backend")

SUBSTEPS = 4
FREE = {"rules": (), "damping": 1.0}


@dataclass(frozen=True, eq=False, repr=False)
class Case:
    """What a solver takes: all particles well inside the window."""

    solver: Solver
    state: ParticleState
    actuation: Tensor
    origin: Tensor

    def run(self, substeps: int = SUBSTEPS) -> ParticleState:
        solver = replace(self.solver, backend=scenes.BACKEND)
        return solver.step(self.state, self.actuation, substeps=substeps, origin=self.origin)


MATERIAL = st.sampled_from(
    [Elastic(300.0, 80.0), VonMises(500.0, 50.0, 60.0), VonMises(200.0, 300.0, 1.0), Snow(400.0, 250.0, 0.05, 0.02)]
)
BODY = st.builds(
    Body,
    count=st.integers(1, 12),
    material=MATERIAL,
    mass=st.floats(0.5, 5.0),
    volume=st.floats(0.3, 2.0),
    muscle=st.booleans(),
)
END = st.none() | st.integers(-2, 20)
RANGE = st.tuples(END, END).map(lambda ends: ends if None in ends else tuple(sorted(ends)))
RULE = st.builds(
    VelocityRule,
    direction=st.sampled_from(["+x", "-x", "+y", "-y"]),
    i=RANGE,
    j=RANGE,
    friction=st.sampled_from([0.0, float("inf")]),
    frame=st.just("window"),
)


@st.composite
def cases(draw: st.DrawFn, **options: object) -> Case:
    """Random scenes; ``options`` of the solver are as given."""
    bodies = tuple(draw(st.lists(BODY, min_size=1, max_size=3)))
    batch, resolution = draw(st.integers(1, 3)), draw(st.integers(10, 20))
    grid = Grid(resolution, spacing=draw(st.sampled_from([None, 0.05])))
    dials = {
        "gravity": draw(st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))),
        "damping": draw(st.sampled_from([1.0, 0.999, 0.9])),
        "rules": tuple(draw(st.lists(RULE, max_size=4))),
    }
    solver = Solver(grid, bodies, **{**dials, **options})
    noise = generator(draw(st.integers(0, 10**6)))

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=noise, dtype=torch.float64)

    count, identity = solver.num_particles, torch.eye(2, dtype=torch.float64)
    spread = torch.rand(batch, count, 2, generator=noise, dtype=torch.float64)
    origin = normal(batch, 2)
    state = ParticleState(
        x=origin[:, None] + grid.h * (3.0 + (resolution - 7.0) * spread),
        v=normal(batch, count, 2),
        C=5.0 * normal(batch, count, 2, 2),
        F=identity + draw(st.sampled_from([0.0, 0.05, 0.3])) * normal(batch, count, 2, 2),
        Jp=1.0 + 0.02 * normal(batch, count),
    )
    return Case(solver, state, 40.0 * normal(batch, 2, resolution, resolution), origin)


@settings(max_examples=15)
@given(cases())
def test_momentum_changes_by_the_impulses(case: Case) -> None:
    """Of gravity, damping and rules; muscles and inner forces add none; mass stays."""
    solver = replace(case.solver, backend=scenes.BACKEND)
    after = case.run(1)
    change = diagnostics.momentum(solver, after) - diagnostics.momentum(solver, case.state)
    impulses = diagnostics.impulses(solver, case.state, case.actuation, case.origin)
    size = (diagnostics.masses(solver, case.state)[..., None] * case.state.v.abs()).sum((1, 2)).max().item()
    torch.testing.assert_close(change, sum(impulses.values()), rtol=1e-8, atol=1e-8 * (1.0 + size))
    assert torch.equal(diagnostics.mass(solver, after), diagnostics.mass(solver, case.state))


def mapped(case: Case, state: ParticleState, Q: Tensor) -> ParticleState:
    """A state under an orthogonal map of space about the middle of the nodes."""
    grid = case.solver.grid
    middle = case.origin[:, None] + 0.5 * (grid.resolution - 1) * grid.h
    x, v = middle + (state.x - middle) @ Q.T, state.v @ Q.T
    return ParticleState(x, v, Q @ state.C @ Q.T, Q @ state.F @ Q.T, state.Jp)


#: Maps of space, of the directions of rules, and of the actuation, as material axes go along: those of a quarter turn
#: to the left change places.
MAPS = {
    "quarter turn": (((0.0, -1.0), (1.0, 0.0)), "+y -y -x +x", lambda field: torch.rot90(field, 1, (2, 3)).flip(1)),
    "mirror": (((-1.0, 0.0), (0.0, 1.0)), "-x +x +y -y", lambda field: field.flip(2)),
}


@pytest.mark.parametrize("name", MAPS)
@settings(max_examples=20)
@given(case=cases())
def test_a_map_of_space(name: str, case: Case) -> None:
    """What happens there is what happens here, turned or mirrored."""
    matrix, directions, turned = MAPS[name]
    Q, solver = torch.tensor(matrix, dtype=torch.float64), case.solver
    direction = dict(zip(("+x", "-x", "+y", "-y"), directions.split(), strict=True))
    rules = []
    for rule in solver.rules:  # nodes (i, j) become (last - j, i), or (last - i, j)
        i, j = (rule.j, rule.i) if name == "quarter turn" else (rule.i, rule.j)
        i = tuple(None if end is None else solver.grid.resolution - 1 - end for end in reversed(i))
        rules.append(replace(rule, direction=direction[rule.direction], i=i, j=j))
    gravity = tuple((Q @ torch.tensor(solver.gravity, dtype=torch.float64)).tolist())
    there = replace(solver, gravity=gravity, rules=tuple(rules))
    found = Case(there, mapped(case, case.state, Q), turned(case.actuation), case.origin).run()
    assert_close(found, mapped(case, case.run(), Q), 1e-9)


@settings(max_examples=15)
@given(cases(), st.integers(-30, 30), st.integers(-30, 30))
def test_a_shift_of_the_world(case: Case, across: int, up: int) -> None:
    """By whole cells, window and all."""
    offset = case.solver.grid.h * torch.tensor([[float(across), float(up)]], dtype=torch.float64)
    there = replace(case, state=replace(case.state, x=case.state.x + offset[:, None]), origin=case.origin + offset)
    result = there.run()
    assert_close(replace(result, x=result.x - offset[:, None]), case.run(), 1e-9)


@settings(max_examples=15)
@given(cases(**FREE), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_uniform_motion_goes_unnoticed(case: Case, across: float, up: float) -> None:
    """In a window that goes along: but for the 1e-10 kg of each node, which stay behind."""
    speed = torch.tensor([across, up], dtype=torch.float64)
    moving, resting = replace(case, state=replace(case.state, v=case.state.v + speed)), case
    for k in range(1, SUBSTEPS + 1):
        way = k * case.solver.dt * speed
        moving = replace(moving, state=moving.run(1), origin=case.origin + way)
        resting = replace(resting, state=resting.run(1))
    back = replace(moving.state, x=moving.state.x - way, v=moving.state.v - speed)
    assert_close(back, resting.state, 1e-6)


@settings(max_examples=25)
@given(cases(), st.randoms(use_true_random=False), st.sampled_from([torch.float32, torch.float64]))
def test_elements_of_a_batch_do_not_know_each_other(case: Case, random, dtype: torch.dtype) -> None:
    """Each as if alone, in any order: natively to the last bit, else to rounding."""
    dtype = dtype if scenes.BACKEND == "native" else torch.float64
    tensors = tree.map(lambda t: t.to(dtype), (case.state, case.actuation, case.origin))
    case = Case(case.solver, *tensors)
    order = list(range(case.state.batch_size))
    random.shuffle(order)
    shuffled = Case(case.solver, case.state[order], case.actuation[order], case.origin[order]).run()
    together = case.run()
    for place, i in enumerate(order):
        one = slice(i, i + 1)
        alone = Case(case.solver, case.state[one], case.actuation[one], case.origin[one]).run()
        for other in (together[i], shuffled[place]):
            if scenes.BACKEND == "native":
                assert_identical(other, alone)
            else:
                assert_close(other, alone, 1e-11)


@pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
@settings(max_examples=25)
@given(cases())
def test_backends_agree(case: Case) -> None:
    ends = [
        replace(case.solver, backend=name).step(case.state, case.actuation, substeps=SUBSTEPS, origin=case.origin)
        for name in ("native", "eager")
    ]
    assert_close(*ends, 1e-9)
