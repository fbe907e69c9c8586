"""Bad arguments: each is refused where it comes in, by an error that names it."""

import math
import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from scenes import GRID, lively, robot
from torch import Tensor

from torchmpm import (
    Body,
    Elastic,
    Grid,
    ParticleState,
    Snow,
    Solver,
    VelocityRule,
    VonMises,
    diagnostics,
    lame,
    repeated,
    sampling,
    trajectory,
)

NAN, INF, SQUARE = math.nan, math.inf, np.zeros((3, 2))
FIELD = torch.zeros(1, 2, 16, 16, dtype=torch.float64)


def body(**changes: Any) -> Body:
    return Body(**{"count": 5, "material": Elastic(500.0, 50.0), **changes})


def solver(**changes: Any) -> Solver:
    return Solver(**{"grid": GRID, "bodies": (body(),), "backend": "eager", **changes})


def step(*arguments: Any, **options: Any) -> ParticleState:
    return robot(5).step(*(arguments or (lively(5),)), **options)


def state(**changes: Tensor) -> ParticleState:
    return ParticleState(**{name: getattr(lively(5), name) for name in ("x", "v", "C", "F", "Jp")} | changes)


class Averaged(Elastic):
    """A law whose stress has the shape (B, 1), which would broadcast."""

    def stress(self, F: Any, Jp: Tensor) -> Any:
        return tuple(component.mean(1, keepdim=True) for component in super().stress(F, Jp))


class Alone(Elastic):
    """A law that forgets Jp."""

    def return_map(self, F: Any, Jp: Tensor) -> Any:
        return F


class Single(Elastic):
    """A law in single precision, which would round the state."""

    def return_map(self, F: Any, Jp: Tensor) -> Any:
        return tuple(component.float() for component in F), Jp


class Endless(Elastic):
    """A law whose stiffness is not returned."""

    def stiffness(self) -> Any:
        pass


@dataclass
class Hidden:
    """A container that is not registered as a tree."""

    x: Tensor


#: What the error names, and calls that must raise it.
VALUES = {
    "resolution": [lambda n=n: Grid(n) for n in (128.5, 3, 0, -1, 10**9)],
    "spacing": [lambda h=h: Grid(8, h) for h in (0.0, -1.0, NAN)],
    "margin": [lambda m=m: Grid(16, margin=m) for m in (0.5, NAN)],
    "direction": [lambda: VelocityRule("down")],
    "frame": [lambda: VelocityRule("-y", frame="robot")],
    "friction": [lambda f=f: VelocityRule("-y", friction=f) for f in (-0.1, NAN)],
    "i": [lambda i=i: VelocityRule("-y", i=i) for i in (3, (4, 3))],
    "j": [lambda: VelocityRule("-y", j=(4, 3))],
    "count": [
        *(lambda n=n: body(count=n) for n in (2.5, 0)),
        *(lambda n=n: sampling.sobol(n, 0) for n in (2**40, 0, -3)),
    ],
    "mass": [
        *(lambda m=m: body(mass=m) for m in ([1.0], torch.ones(0), 0.0)),
        *(lambda m=m: body(mass=torch.tensor(m)) for m in (0.0, -1.0, -1)),
        lambda: robot(5, bodies=(body(mass=torch.ones(3)),)).step(lively(5, 2)),
    ],
    "volume": [*(lambda v=v: body(volume=v) for v in (-1.0, *map(torch.tensor, (0.0, -1.0, INF))))],
    "muscle": [lambda: body(muscle="yes")],
    "values of bodies[1]": [
        lambda: solver(bodies=(body(), body(material=Elastic(torch.ones(2), 1.0), mass=torch.ones(3))))
    ],
    "values of bodies[0]": [lambda: solver(bodies=(body(material=Elastic(*torch.tensor([10.0, -20.0]))),))],
    "mu": [
        *(lambda m=m: VonMises(m, 50.0, 62.0) for m in (-1.0, NAN, "stiff", torch.tensor(0.0))),
        *(lambda m=m: Elastic(torch.tensor(m), 50.0) for m in (NAN, [1.0, -100.0])),
        lambda: robot(5, bodies=(body(material=Elastic(torch.ones(4), 1.0)),)).step(lively(5, 2)),
    ],
    "lam": [*(lambda v=v: Elastic(1.0, v) for v in (NAN, -1.5))],
    "yield_stress": [lambda y=y: VonMises(500.0, 50.0, y) for y in (-1.0, NAN, torch.tensor(-5.0))],
    "compression": [lambda c=c: Snow(1.0, 1.0, compression=c) for c in (-0.1, 1.5, torch.tensor(2.0))],
    "shear_cutoff": [lambda: Snow(1.0, 1.0, shear_cutoff=-1.0)],
    "hardening_range": [lambda: Snow(1.0, 1.0, hardening_range=(5.0, 0.1))],
    "exact_gradients": [lambda: Snow(1.0, 1.0, exact_gradients="no")],
    "young": [lambda y=y: lame(y, 0.3) for y in (-1.0, torch.tensor([1.0, -1.0]))],
    "poisson": [lambda p=p: lame(1.0, p) for p in (0.5, torch.tensor([0.2, 0.7]))],
    "bodies": [lambda: solver(bodies=())],
    "gravity": [
        *(lambda g=g: solver(gravity=g) for g in (-9.8, np.array(-9.8), (0.0, -1e30), torch.tensor([1e30, 0.0]))),
        *(lambda g=g: solver(gravity=torch.zeros(g)) for g in ((), (3,), (5, 5), (1, 1, 2), 0, (0, 2))),
        *(lambda g=g: solver(gravity=g) for g in (torch.zeros(2) * 1j, torch.zeros(2) == 1, torch.tensor([0.0, NAN]))),
        lambda: solver(gravity=torch.zeros(3, 2)).step(lively(5, 2)),
        lambda: diagnostics.potential_energy(solver(gravity=torch.zeros(3, 2)), lively(5)),
    ],
    "damping": [lambda d=d: solver(damping=d) for d in (1e30, -1)],
    "dt": [lambda dt=dt: solver(dt=dt) for dt in (INF, NAN, 0.0, 0.1)],
    "allow_unstable": [lambda: solver(allow_unstable=2)],
    "backend": [lambda b=b: solver(backend=b) for b in (None, "compile")],
    "substeps": [lambda n=n: step(substeps=n) for n in (1.5, -1)],
    "segment": [lambda n=n: repeated(torch.sin, torch.ones(1), 3, segment=n) for n in (0, -3, True, "all")],
    "checkpointed": [lambda: trajectory(torch.add, torch.ones(1), [1], observe=id, checkpointed="no")],
    "times": [lambda: repeated(torch.sin, torch.ones(1), -1)],
    "state has": [
        lambda: step(lively(6)),
        lambda: step(ParticleState.at_rest(torch.zeros(1, 0, 2))),
        lambda: diagnostics.mass(solver(), lively(3)),
    ],
    "actuation": [
        *(lambda a=a: step(lively(5), a) for a in (FIELD[:, :1], FIELD.float(), FIELD.to("meta"))),
        *(lambda a=a: robot(5).stable_dt(a) for a in (NAN, "strong", torch.tensor([1.0, INF]))),
    ],
    "stiffness() of bodies[0].material": [lambda: solver(bodies=(body(material=Endless(300.0, 80.0)),))],
    "other": [
        lambda s=s: lively(5).where(torch.tensor([True]), s)
        for s in (lively(5, 3), lively(4), lively(5).to(torch.float32))
    ],
    "origin": [
        lambda: step(origin=torch.zeros(2).double()),
        lambda: diagnostics.inside(solver(), lively(5), torch.zeros(2).double()),
    ],
    "x": [
        *(lambda s=s: state(x=torch.zeros(s)) for s in ((5, 3), (5,), (2, 5, 1), (1, 2, 5, 2))),
        *(lambda t=t: lively(4, 3).to(t) for t in (torch.float16, torch.int64)),
    ],
    **{
        name: [
            lambda name=name: state(**{name: getattr(lively(4), name)}),
            lambda name=name: state(**{name: getattr(lively(5), name).float()}),
            lambda name=name: state(**{name: getattr(lively(5), name).to("meta")}),
        ]
        for name in ("v", "C", "F", "Jp")
    },
    "seed": [lambda s=s: sampling.sobol(3, s) for s in (None, 2**70)],
    "numbers": [
        *(lambda n=n: sampling.disc(n, (0, 0), 1.0) for n in ("ab", np.full((3, 2), 2.0), torch.rand(5, 2))),
        *(lambda n=n: sampling.box(n, (0, 0), (1, 1)) for n in ([[0.1, 0.2]], np.full((5, 2), "a"), SQUARE > 0)),
        *(lambda n=n: sampling.box(n, (0, 0), (1, 1)) for n in (np.zeros((5, 3)), np.full((5, 2), NAN))),
    ],
    "centre": [lambda: sampling.disc(SQUARE, (0,), 1.0), lambda: sampling.chord_disc(SQUARE, (0, NAN), 1.0)],
    "radius": [lambda: sampling.disc(SQUARE, (0, 0), -1.0)],
    "size": [lambda: sampling.box(SQUARE, (0, 0), (1, -1))],
    "mask": [
        *(
            lambda m=m: sampling.image(SQUARE, m, (0, 0), (1, 1))
            for m in (np.ones(3, bool), np.full((2, 2), NAN), np.zeros((3, 3), bool))
        ),
        lambda: lively(5).where(torch.ones(1), lively(5)),
        *(lambda n=n: lively(5).where(torch.ones(n) > 0, lively(5)) for n in (3, (1, 5))),
    ],
    "cells": [lambda c=c: sampling.lattice(c, (0, 0), (1, 1)) for c in ((3,), None, (10**9, 10**9))],
}
TYPES = {
    "grid": [lambda: solver(grid=None)],
    "bodies": [lambda: solver(bodies=body())],
    "rules[0]": [lambda: solver(rules=("floor",))],
    "material": [lambda m=m: body(material=m) for m in (Elastic, "jelly")],
    "state": [
        lambda: step(torch.zeros(1, 5, 2)),
        lambda: diagnostics.elastic_energy(solver(), 5),
        lambda: diagnostics.impulses(solver(), "x"),
        lambda: repeated(lambda _, s: s, Hidden(torch.ones(1)), 3, segment=1, shared=torch.ones(1)),
    ],
    "solver": [lambda: diagnostics.momentum(None, lively(5))],
    "x": [
        *(lambda x=x: ParticleState.at_rest(x) for x in (np.zeros((5, 2)), torch.zeros(1, 5, 2).to_sparse())),
        lambda: state(x=lively(5).x.to_sparse()),
    ],
    "v": [lambda: state(v=lively(5).v.to_sparse())],
    "actuation": [lambda: step(lively(5), FIELD.to_sparse())],
    "mask": [lambda: lively(5).where([True], lively(5))],
    "shared": [lambda: repeated(lambda net, x: net(x), torch.ones(1), 3, segment=1, shared=torch.nn.Linear(1, 1))],
    "origin": [lambda: step(origin=[0.0, 0.0])],
    "stress of Averaged": [lambda: solver(bodies=(body(material=Averaged(300.0, 80.0)),)).step(lively(5, 2))],
    "return_map of Alone": [lambda: solver(bodies=(body(material=Alone(300.0, 80.0)),)).step(lively(5, 2))],
    "return_map of Single": [lambda: solver(bodies=(body(material=Single(300.0, 80.0)),)).step(lively(5, 2))],
}
CASES = [
    (error, name, call)
    for error, table in ((ValueError, VALUES), (TypeError, TYPES))
    for name, calls in table.items()
    for call in calls
]


@pytest.mark.parametrize(("error", "name", "call"), CASES, ids=[name for _, name, _ in CASES])
def test_bad_arguments(error: type[Exception], name: str, call: Any) -> None:
    with pytest.raises(error, match=rf"^(number of )?{re.escape(name)}(?!\w)"):
        call()


@pytest.mark.parametrize("as_tensor", [False, True])
def test_gravity_moves_a_particle_at_rest_by_less_than_a_cell(as_tensor: bool) -> None:
    largest = robot(5).grid.h / robot(5).dt ** 2
    for factor in (0.999, -0.999, 1.001, -1.001):
        gravity = torch.tensor([0.0, factor * largest]) if as_tensor else (0.0, factor * largest)
        if abs(factor) < 1:
            assert replace(robot(5), gravity=gravity).gravity is not None
        else:
            with pytest.raises(ValueError, match="gravity"):
                robot(5, gravity=gravity)


def test_small_integers_of_numpy_become_python_integers() -> None:
    """Else sums and squares of them would overflow."""
    assert Grid(np.uint8(128)).width ** 2 == 134**2
    assert solver(grid=Grid(np.int16(200)), bodies=(body(count=np.int16(20000)),) * 2).num_particles == 40000
    low, high = np.int64(3), np.int32(5)
    assert type(VelocityRule("-y", i=(low, high)).i[0]) is int
    assert VelocityRule("-y", i=(low, high), j=(None, low)) == VelocityRule("-y", i=(3, 5), j=(None, 3))
