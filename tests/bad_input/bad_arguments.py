"""Bad arguments of torchmpm."""

import math

import numpy as np
import torch
from bad_cases import Case

from torchmpm import (
    Body,
    Elastic,
    Grid,
    ParticleState,
    Solver,
    VelocityRule,
    diagnostics,
    estimate_memory,
    lame,
    sampling,
    segment_for,
)


def state(count=5):
    return ParticleState.at_rest(torch.rand(1, count, 2) * 0.2 + 0.4)


def body(**changes):
    return Body(**{"count": 5, "material": Elastic(500.0, 50.0), **changes})


def solver(**changes):
    return Solver(**{"grid": Grid(16), "bodies": (body(),), "backend": "eager", **changes})


def table(rows, error=ValueError):
    return [
        Case(name, lambda desk, call=call: call(), words if isinstance(words, tuple) else (words,), error)
        for name, call, words in rows
    ]


MEMORY = table(
    [
        (
            "memory of two numbers",
            lambda: estimate_memory(solver(), (1, 5), substeps=1),
            "state must be a ParticleState",
        ),
        (
            "memory of a dtype by name",
            lambda: estimate_memory(solver(), (1, 5, "float32"), substeps=1),
            "(B, N, torch.float32 or torch.float64), got (1, 5, 'float32')",
        ),
        (
            "memory of no solver",
            lambda: estimate_memory(None, state(), substeps=1),
            "solver must be a Solver, got None",
        ),
    ],
    TypeError,
) + table(
    [
        (
            "memory of minus five particles",
            lambda: estimate_memory(solver(), (1, -5, torch.float32), substeps=1),
            "N of the state must be at least 1, got -5",
        ),
        (
            "segment for a budget as text",
            lambda: segment_for(solver(), state(), substeps=2, budget="1 GB"),
            "budget must be a whole number, got '1 GB'",
        ),
        (
            "segment for half substeps",
            lambda: segment_for(solver(), state(), substeps=2.5, budget=10**9),
            "substeps must be a whole number, got 2.5",
        ),
    ]
)

SOLVER = table(
    [
        ("Grid of half a node", lambda: Grid(128.5), "resolution must be a whole number, got 128.5"),
        ("Grid all margin", lambda: Grid(16, margin=0.5), "margin must be below half the window's width, 0.5, got 0.5"),
        ("Grid, margin not a number", lambda: Grid(16, margin=math.nan), "margin must be finite, got nan"),
        ("rule on one index", lambda: VelocityRule("-y", 3), "i must be an inclusive range (low, high)"),
        (
            "mass of other particles",
            lambda: diagnostics.mass(solver(), ParticleState.at_rest(torch.zeros(1, 3, 2))),
            "state has 3 particles, the solver's bodies 5",
        ),
        ("body, half a particle", lambda: body(count=2.5), "count must be a whole number, got 2.5"),
        ("body, masses in a list", lambda: body(mass=[1.0]), "mass must be a number or a tensor, got [1.0]"),
        ("Elastic, stiff", lambda: Elastic("stiff", 1.0), "mu must be a number or a tensor, got 'stiff'"),
        ("lame, incompressible", lambda: lame(1.0, 0.5), "poisson must be below 0.5, got 0.5"),
        ("lame, one of two", lambda: lame(1.0, torch.tensor([0.2, 0.7])), "poisson must be below 0.5, got 0.69"),
        ("Grid of a billion", lambda: Grid(10**9), "resolution must be at most 32768, got 1000000000"),
        ("body, no masses", lambda: body(mass=torch.ones(0)), "mass must be real and not empty, got torch.float32 of"),
        ("body, muscle by name", lambda: body(muscle="yes"), "muscle must be True or False, got 'yes'"),
        ("volume of nothing", lambda: solver(bodies=(body(volume=torch.tensor(0.0)),)), "bodies[0].volume must be pos"),
        ("gravity of NaN", lambda: solver(gravity=torch.tensor([0.0, math.nan])), "gravity must be finite, got nan"),
        (
            "gravity of a star",
            lambda: solver(gravity=(0.0, -1e30)),
            ("gravity, with substeps of", "above -", "got -1e+30"),
        ),
        ("gravity of a star, tensor", lambda: solver(gravity=torch.tensor([1e30, 0.0])), "must be below "),
        ("sobol without end", lambda: sampling.sobol(2**40, 0), "count must be at most 1073741824, got 1099511627776"),
        (
            "lattice without end",
            lambda: sampling.lattice((10**9, 10**9), (0, 0), (1, 1)),
            "number of cells must be at most 1073741824, got 1000000000000000000",
        ),
        ("damping that pushes", lambda: solver(damping=1e30), "damping must be at most 1, got 1e+30"),
        ("unstable, perhaps", lambda: solver(allow_unstable=2), "allow_unstable must be True or False, got 2"),
        ("sobol without a seed", lambda: sampling.sobol(3, None), "seed must be a whole number, got None"),
        (
            "sobol, large seed",
            lambda: sampling.sobol(3, 2**70),
            ("seed must be at most 9223372036854775807", "got 1180"),
        ),
        (
            "disc of words",
            lambda: sampling.disc("ab", (0, 0), 1.0),
            "numbers must be an array (N, 2) of numbers from 0",
        ),
        ("disc beyond one", lambda: sampling.disc(np.full((3, 2), 2.0), (0, 0), 1.0), "numbers from 0 to 1, got an"),
        ("disc on a line", lambda: sampling.disc(np.zeros((3, 2)), (0,), 1.0), "centre must be two numbers (x, y)"),
        ("chord at NaN", lambda: sampling.chord_disc(np.zeros((3, 2)), (0, math.nan), 1.0), "centre y must be finite"),
        ("box inside out", lambda: sampling.box(np.zeros((3, 2)), (0, 0), (1, -1)), "size y must be positive, got -1"),
        (
            "image of a row",
            lambda: sampling.image(np.zeros((3, 2)), np.ones(3, bool), (0, 0), (1, 1)),
            "mask must be an array (H, W) of bool, got bool of shape (3,)",
        ),
        (
            "image of NaN",
            lambda: sampling.image(np.zeros((3, 2)), np.full((2, 2), math.nan), (0, 0), (1, 1)),
            "mask must be an array (H, W) of bool, got float64",
        ),
        ("lattice of one side", lambda: sampling.lattice((3,), (0, 0), (1, 1)), "cells must be two numbers (x, y)"),
        ("lattice of nothing", lambda: sampling.lattice(None, (0, 0), (1, 1)), "cells must be two numbers (x, y)"),
        ("gravity of one number", lambda: solver(gravity=-9.8), ("gravity must be two numbers", "got -9.8")),
        ("negative damping", lambda: solver(damping=-1), "damping must not be negative, got -1"),
        ("dt infinite", lambda: solver(dt=math.inf), "dt must be finite, got inf"),
        ("no backend", lambda: solver(backend=None), ("backend must be one of", "eager", "got None")),
        ("half a substep", lambda: solver().step(state(), substeps=1.5), "substeps must be a whole number, got 1.5"),
        ("disc inside out", lambda: sampling.disc(np.zeros((3, 2)), (0, 0), -1.0), "radius must be positive, got -1.0"),
    ]
) + table(
    [
        (
            "body of a class",
            lambda: body(material=Elastic),
            "material must be a Material, got the class Elastic",
        ),
        (
            "body of jelly",
            lambda: body(material="jelly"),
            "material must be a Material, got 'jelly', which has no method",
        ),
        ("solver without grid", lambda: solver(grid=None), "grid must be a Grid, got None"),
        ("solver of one body", lambda: solver(bodies=body()), "bodies must be a sequence of Body, got Body"),
        ("solver, named rule", lambda: solver(rules=("floor",)), "rules[0] must be a VelocityRule, got 'floor'"),
        ("step from a tensor", lambda: solver().step(torch.zeros(1, 5, 2)), "state must be a ParticleState, got"),
        ("momentum of no solver", lambda: diagnostics.momentum(None, state()), "solver must be a Solver, got None"),
        ("energy of a number", lambda: diagnostics.elastic_energy(solver(), 5), "state must be a ParticleState, got 5"),
        ("whether nothing is finite", lambda: diagnostics.finite(None), "state must be a ParticleState, got None"),
        ("impulses of a name", lambda: diagnostics.impulses(solver(), "x"), "state must be a ParticleState, got 'x'"),
        ("sparse particles", lambda: ParticleState.at_rest(torch.zeros(1, 5, 2).to_sparse()), "x must be a dense Tens"),
        ("sparse actuation", lambda: solver().step(state(), torch.zeros(1, 2, 16, 16).to_sparse()), "a dense Tensor"),
        ("origin of a list", lambda: solver().step(state(), origin=[0.0, 0.0]), "origin must be a Tensor, got list"),
        ("points of no generator", lambda: sampling.uniform(3, None), "generator must be a Generator, got None"),
        ("state of an array", lambda: ParticleState.at_rest(np.zeros((5, 2))), "x must be a Tensor, got ndarray"),
    ],
    TypeError,
)

CASES = [*MEMORY, *SOLVER]
