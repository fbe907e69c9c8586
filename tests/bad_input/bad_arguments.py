"""Bad arguments of torchmpm and dittogym."""

import math
from dataclasses import replace

import gymnasium
import numpy as np
import torch
from bad_cases import Case

import dittogym
from dittogym import Outcome, TorchEnv, make_spec
from dittogym.bodies.shapes import Disc, Figure, Rectangle
from dittogym.geometry import Box, solid
from dittogym.reward_ops import EXACT
from dittogym.spec import BodySpec as RobotBody
from dittogym.window import Window
from torchmpm import (
    Body,
    Elastic,
    Grid,
    ParticleState,
    Solver,
    VelocityRule,
    diagnostics,
    lame,
    sampling,
)

ID = "dittogym/run-coarse-v0"


def state(count=5):
    return ParticleState.at_rest(torch.rand(1, count, 2) * 0.2 + 0.4)


def body(**changes):
    return Body(**{"count": 5, "material": Elastic(500.0, 50.0), **changes})


def solver(**changes):
    return Solver(**{"grid": Grid(16), "bodies": (body(),), "backend": "eager", **changes})


def env(**changes):
    return TorchEnv(**{"task": "run", "particles": 60, "substeps": 1, "backend": "eager", **changes})


def begun(**changes):
    made = env(num_envs=2, **changes)
    made.reset(seed=0)
    return made


def running():
    made = env(num_envs=2, particles=120)
    made.reset(seed=0)
    return made.env_state


def spec(**changes):
    return replace(make_spec("run"), **changes)


def single(**options):
    return gymnasium.make(ID, **{"particles": 60, "substeps": 1, **options}).unwrapped


def batch(**options):
    return gymnasium.make_vec(
        ID, 2, vectorization_mode="vector_entry_point", **{"particles": 60, "substeps": 1, **options}
    )


def step(made, action):
    made.reset(seed=0)
    return made.step(action)


def rewarded(reward_fn):
    return step(env(task=spec(reward_fn=reward_fn)), torch.zeros(1, 2, 8, 8))


def table(rows, error=ValueError):
    return [
        Case(name, lambda desk, call=call: call(), words if isinstance(words, tuple) else (words,), error)
        for name, call, words in rows
    ]


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

ENVIRONMENT = table(
    [
        ("task of a list", lambda: env(task=["run"]), ("task must be one of catch", "got ['run']")),
        ("robots and a half", lambda: env(num_envs=1.5), "num_envs must be a whole number, got 1.5"),
        ("resolution of a float", lambda: env(resolution=8.0), ("resolution must be", "1 to 64", "got 8.0")),
        ("half particles", lambda: env(particles=(1.5,)), "particles[0] must be a whole number, got 1.5"),
        ("substeps not a number", lambda: env(substeps=math.nan), "substeps must be a whole number, got nan"),
        ("dtype of torch", lambda: env(dtype=torch.float16), ("dtype must be one of", "'float32'", "'float16'")),
        ("device abacus", lambda: env(device="abacus"), "device must be 'cpu' or 'cuda', got 'abacus'"),
        ("resample no", lambda: env(resample="no"), "resample must be True or False, got 'no'"),
        ("seed and a half", lambda: env().reset(seed=1.5), "seed must be a whole number, got 1.5"),
        ("seed too large", lambda: env(num_envs=2).reset(seed=2**32 - 1), "seed must be at most 4294967294, got"),
        ("options of a list", lambda: env().reset(options=[1]), ("options must be a mapping", "physics", "got [1]")),
        (
            "positions of a text",
            lambda: env().reset(options={"positions": "x"}),
            "positions must be real numbers, got 'x'",
        ),
        (
            "positions of NaN",
            lambda: env().reset(options={"positions": np.full((60, 2), math.nan)}),
            "positions must be finite, got nan",
        ),
        ("load, mask of a text", lambda: (e := begun()).load(e.save(), "x"), ("mask must be bool of shape", "'x'")),
        ("action of an array", lambda: begun().step(np.zeros((2, 2, 8, 8))), ("action must be", "got ndarray")),
        ("action of bits", lambda: begun().step(torch.zeros(2, 2, 8, 8, device="meta")), "action must hold numbers"),
        (
            "mu of a truth",
            lambda: env().reset(options={"physics": {"mu": True}}),
            ("physics['mu'] must be real", "True"),
        ),
        (
            "gravity that crosses cells",
            lambda: env().reset(options={"physics": {"gravity": (0.0, -1e12)}}),
            ("physics['gravity'], with substeps of 0.0001 s, must be above -", "got -999999995904.0"),
        ),
        (
            "mass of a planet",
            lambda: env().reset(options={"physics": {"mass": 1e30}}),
            "physics['mass'] must be at most 1e+06, got 1e+30",
        ),
        ("masked action", lambda: step(single(), np.ma.masked_all((2, 8, 8))), "masked array with 128 masked entries"),
        ("muscles by name", lambda: single(render_muscles="x"), "render_muscles must be True or False, got 'x'"),
        ("picture without pixels", lambda: single(render_size=0), "render_size must be at least 16, got 0"),
        ("pictures without pixels", lambda: batch(render_size=0), "render_size must be at least 16, got 0"),
        ("muscles of a batch", lambda: batch(render_muscles=1), "render_muscles must be True or False, got 1"),
        ("picture from afar", lambda: begun().render(zoom=1e-9), "zoom must be at least 0.05, got 1e-09"),
        (
            "soft by name",
            lambda: begun().step(torch.zeros(2, 2, 8, 8), soft="no"),
            "soft must be True or False, got 'no'",
        ),
        (
            "action beyond float32",
            lambda: begun().step(torch.full((2, 2, 8, 8), 1e300, dtype=torch.float64)),
            "action must be finite, got 256 entries",
        ),
        (
            "state of another task",
            lambda: setattr(begun(task="catch", particles=(60, 60)), "env_state", running()),
            "env_state must have the memory of this task, got none of ['object_com']",
        ),
        (
            "target of numbers",
            lambda: spec(target=np.zeros((64, 64))),
            "target must be bool of shape (64, 64), got float64",
        ),
        (
            "box of no order",
            lambda: Box(0.5, 0.1),
            "left and right must be numbers with left <= right, got 0.5 and 0.1",
        ),
        ("step of no width", lambda: EXACT.heaviside(torch.zeros(1), 0.0), "width must be positive, got 0.0"),
        ("clamp of no order", lambda: EXACT.clamp(torch.zeros(1), 1.0, 0.5), "low must be at most high, 0.5, got 1.0"),
        (
            "nearest of all twice",
            lambda: EXACT.mean_over_nearest(*[torch.zeros(1, 3, 2)] * 2, torch.zeros(1, 2), 2.0),
            "fraction must be at most 1, got 2.0",
        ),
        ("picture too large", lambda: begun().render(size=10**6), "size must be at most 8192, got 1000000"),
        ("actions of words", lambda: step(single(), "left"), ("action must be numbers of shape (2, 8, 8), got <U4",)),
        (
            "action of rows",
            lambda: step(single(), [[1.0], [1.0, 2.0]]),
            ("action must be numbers of shape (2, 8, 8), got list: ", "inhomogeneous"),
        ),
        ("sparse action", lambda: step(single(), torch.zeros(2, 8, 8).to_sparse()), ("action must be num", "Sparse")),
        ("actions for three", lambda: step(batch(), np.zeros((3, 2, 8, 8))), ("(2, 2, 8, 8)", "(3, 2, 8, 8)")),
        ("autoreset sometimes", lambda: batch(autoreset_mode="x"), ("autoreset_mode must be one of", "got 'x'")),
        (
            "task, window of both kinds",
            lambda: Window(left=0.1, follow=0.4),
            "left must not be given with follow",
        ),
        (
            "goal outside of the window",
            lambda: env(task=replace(make_spec("grow"), goal=(9.0, 0.0))),
            ("goal must lie inside the window (-0.500 < x < 0.500", "got (9.0, 0.0)"),
        ),
        ("task of a function", lambda: env(task=make_spec), ("task must be one of", "dittogym.register gives a")),
        ("policy of nothing", lambda: env().film(lambda seen: None), "policy must return actions, got NoneType"),
        ("task, patch too wide", lambda: spec(patch=200), "patch must be at most 128, got 200"),
        ("task, two objects", lambda: spec(objects=(spec().robot,) * 2), "objects must be at most one body, got 2"),
        (
            "rewards for three",
            lambda: rewarded(lambda moment, spec: Outcome({"velocity": torch.zeros(3)})),
            ("reward_fn of task 'run' must return terms of shape (B,)", "(3,) for 'velocity'"),
        ),
        ("disc at a name", lambda: Disc("home", 0.1), "corner must be two numbers (x, y), got 'home'"),
        ("box that draws nothing", lambda: Rectangle((0, 0), (1, 1), draws=0), "draws must be one of (2, 4), got 0"),
        ("figure of no pixels", lambda: Figure(np.zeros((3, 3), bool), (0.4, 0.2), 0.1), "mask must be an array"),
        ("robot of nothing", lambda: RobotBody(Disc((0.4, 0.2), 0.1), 0), "count must be at least 1, got 0"),
        ("robot of no area", lambda: env(body=[(0, 0), (1, 1), (2, 2)]), "body must have corners that enclose an area"),
        (
            "box at a name",
            lambda: solid("box", ("a", "b"), (0, 9)),
            "i must be an inclusive range (low, high) of node indices",
        ),
        (
            "box at a truth",
            lambda: solid("box", (True, 9), (0, 9)),
            "i must be an inclusive range (low, high) of node indices",
        ),
        ("box from 9 to 0", lambda: solid("box", (9, 0), (0, 9)), ("with low <= high", "got (9, 0)")),
        (
            "box seen by name",
            lambda: solid("box", (0, 9), (0, 9), visible="no"),
            "visible must be True or False, got 'no'",
        ),
        ("namespace of a module", lambda: dittogym.register("x", spec, namespace="a:b"), ("namespace must", "'a:b'")),
        ("namespace of two words", lambda: dittogym.register("x", spec, namespace="a b"), ("namespace must", "'a b'")),
        ("target of a number", lambda: make_spec("shapematch", target=3), ("target must be 'star'", "got int")),
    ]
) + table(
    [
        (
            "unknown option",
            lambda: env(colour="red"),
            ("'run' got an unexpected keyword argument 'colour'; its options", "body, obstacles"),
        ),
        ("single environment of three", lambda: single(num_envs=3), ("num_envs must not be given", "make_vec")),
        ("reward of nothing", lambda: rewarded(lambda moment, spec: None), "must return an Outcome, got NoneType"),
    ],
    TypeError,
)

CASES = [*SOLVER, *ENVIRONMENT]
