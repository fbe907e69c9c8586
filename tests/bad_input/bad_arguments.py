"""Bad arguments of torchmpm and dittogym."""

import math
from dataclasses import replace

import gymnasium
import numpy as np
import torch
from bad_cases import Case

import dittogym
from dittogym import Outcome, TorchEnv, make_spec
from dittogym.bodies.shapes import Disc, Figure, Lattice, Rectangle
from dittogym.geometry import ceiling, solid
from dittogym.spec import BodySpec as RobotBody
from torchmpm import Body, Elastic, Grid, ParticleState, Solver, VelocityRule, VonMises, lame, sampling

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
        ("Grid of a text", lambda: Grid("big"), "resolution must be a whole number, got 'big'"),
        ("Grid of half a node", lambda: Grid(128.5), "resolution must be a whole number, got 128.5"),
        ("Grid without end", lambda: Grid(16, math.inf), "spacing must be finite, got inf"),
        ("Grid all margin", lambda: Grid(16, margin=0.5), "margin must be below half the window's width, 0.5, got 0.5"),
        ("Grid, margin not a number", lambda: Grid(16, margin=math.nan), "margin must not be negative, got nan"),
        ("rule on one index", lambda: VelocityRule("-y", 3), "i must be an inclusive range (low, high)"),
        ("rule on three indices", lambda: VelocityRule("-y", j=(1, 2, 3)), ("j must be", "got (1, 2, 3)")),
        ("rule on names", lambda: VelocityRule("-y", ("a", "b")), ("i must be", "node indices or None", "('a', 'b')")),
        ("rule, rough", lambda: VelocityRule("-y", friction="rough"), "friction must be a number, got 'rough'"),
        ("body, half a particle", lambda: body(count=2.5), "count must be a whole number, got 2.5"),
        ("body, infinite mass", lambda: body(mass=math.inf), "mass must be finite, got inf"),
        ("body, masses in a list", lambda: body(mass=[1.0]), "mass must be a number or a tensor, got [1.0]"),
        ("Elastic, stiff", lambda: Elastic("stiff", 1.0), "mu must be a number or a tensor, got 'stiff'"),
        ("Elastic, infinite", lambda: Elastic(math.inf, 1.0), "mu must be finite, got inf"),
        ("VonMises without", lambda: VonMises(1.0, 1.0, None), "yield_stress must be a number or a tensor, got None"),
        ("lame, incompressible", lambda: lame(1.0, 0.5), "poisson must be above -1 and below 0.5, got 0.5"),
        ("von Mises matter without shear", lambda: VonMises(0.0, 1.0, 1.0), "mu must be positive, got 0.0"),
        ("lame, negative", lambda: lame(-1.0, 0.2), "young must not be negative, got -1.0"),
        ("gravity of one number", lambda: solver(gravity=-9.8), ("gravity must be two numbers", "got -9.8")),
        ("gravity of three", lambda: solver(gravity=(0.0, 0.0, 1.0)), ("gravity", "two numbers", "(0.0, 0.0, 1.0)")),
        ("gravity not a number", lambda: solver(gravity=(0.0, math.nan)), "gravity y must be finite, got nan"),
        ("gravity for another batch", lambda: solver(gravity=torch.zeros(3, 2)).step(state()), "gravity must have"),
        ("negative damping", lambda: solver(damping=-1), "damping must not be negative, got -1"),
        ("dt as text", lambda: solver(dt="1 ms"), "dt must be a number, got '1 ms'"),
        ("dt infinite", lambda: solver(dt=math.inf), "dt must be finite, got inf"),
        ("no backend", lambda: solver(backend=None), ("backend must be one of", "eager", "got None")),
        ("half a substep", lambda: solver().step(state(), substeps=1.5), "substeps must be a whole number, got 1.5"),
        ("segment of a text", lambda: solver().step(state(), segment="all"), ("segment must be", "got 'all'")),
        ("state of integers", lambda: ParticleState.at_rest(torch.zeros(5, 2, dtype=torch.int64)), "float32 or"),
        ("state of halves", lambda: ParticleState.at_rest(torch.zeros(5, 2).half()), "float32 or float64, got"),
        ("state of one axis", lambda: ParticleState.at_rest(torch.zeros(5)), ("(B, N, 2) or (N, 2), got (5,)",)),
        ("disc inside out", lambda: sampling.disc(np.zeros((3, 2)), (0, 0), -1.0), "radius must be positive, got -1.0"),
        ("lattice of no cells", lambda: sampling.lattice((0, 3), (0, 0), (1, 1)), "cells in x must be at least 1"),
        ("half a point", lambda: sampling.sobol(2.5, 0), "count must be a whole number, got 2.5"),
    ]
) + table(
    [
        ("body of jelly", lambda: body(material="jelly"), "material must be a Material, got 'jelly'"),
        ("body of a class", lambda: body(material=Elastic), "material must be a Material, got <class"),
        ("solver without grid", lambda: solver(grid=None), "grid must be a Grid, got None"),
        ("solver of one body", lambda: solver(bodies=body()), "bodies must be a sequence of Body, got Body"),
        ("solver of jelly", lambda: solver(bodies=("jelly",)), "bodies[0] must be a Body, got 'jelly'"),
        ("solver, named rule", lambda: solver(rules=("floor",)), "rules[0] must be a VelocityRule, got 'floor'"),
        ("step from a tensor", lambda: solver().step(torch.zeros(1, 5, 2)), "state must be a ParticleState, got"),
        ("origin of a list", lambda: solver().step(state(), origin=[0.0, 0.0]), "origin must be a Tensor, got list"),
        ("state of an array", lambda: ParticleState.at_rest(np.zeros((5, 2))), "x must be a Tensor, got ndarray"),
        ("state without v", lambda: ParticleState(torch.zeros(1, 5, 2), *[None] * 4), "v must be a Tensor, got None"),
    ],
    TypeError,
)

ENVIRONMENT = table(
    [
        ("task of a list", lambda: env(task=["run"]), ("task must be one of catch", "got ['run']")),
        ("robots and a half", lambda: env(num_envs=1.5), "num_envs must be a whole number, got 1.5"),
        ("robots as text", lambda: env(num_envs="2"), "num_envs must be a whole number, got '2'"),
        ("resolution of a float", lambda: env(resolution=8.0), ("resolution must be", "1 to 64", "got 8.0")),
        ("resolution of True", lambda: env(resolution=True), ("resolution must be", "got True")),
        ("half particles", lambda: env(particles=(1.5,)), "particles[0] must be a whole number, got 1.5"),
        ("particles too many numbers", lambda: env(particles=(1, 2)), ("particles must be", "1 number(s)", "(1, 2)")),
        ("substeps not a number", lambda: env(substeps=math.nan), "substeps must be a whole number, got nan"),
        ("dtype of torch", lambda: env(dtype=torch.float16), ("dtype must be one of", "'float32'", "'float16'")),
        ("device abacus", lambda: env(device="abacus"), "device must be 'cpu' or 'cuda', got 'abacus'"),
        ("device meta", lambda: env(device="meta"), "device must be 'cpu' or 'cuda', got 'meta'"),
        ("segment zero", lambda: env(segment=0), "segment must be at least 1, None or 'auto', got 0"),
        ("resample no", lambda: env(resample="no"), "resample must be True or False, got 'no'"),
        ("deterministic no", lambda: env(deterministic="no"), "deterministic must be True or False, got 'no'"),
        ("seed of a text", lambda: env().reset(seed="x"), "seed must be a whole number, got 'x'"),
        ("seed and a half", lambda: env().reset(seed=1.5), "seed must be a whole number, got 1.5"),
        ("seed too large", lambda: env(num_envs=2).reset(seed=2**32 - 1), "seed must be at most 4294967294, got"),
        ("options of a list", lambda: env().reset(options=[1]), ("options must be a mapping", "physics", "got [1]")),
        ("positions of a text", lambda: env().reset(options={"positions": "x"}), "positions must be numbers, got 'x'"),
        ("positions imaginary", lambda: env().reset(options={"positions": torch.full((60, 2), 1j)}), "positions"),
        ("mask of a text", lambda: begun().reset(options={"reset_mask": "x"}), ("reset_mask must be bool", "got 'x'")),
        ("load, mask of a text", lambda: (e := begun()).load(e.save(), "x"), ("mask must be bool of shape", "'x'")),
        ("action of an array", lambda: begun().step(np.zeros((2, 2, 8, 8))), ("action must be", "got ndarray")),
        ("picture too large", lambda: begun().render(size=10**6), "size must be at most 8192, got 1000000"),
        ("picture and a half", lambda: begun().render(size=100.5), "size must be a whole number, got 100.5"),
        ("actions of words", lambda: step(single(), "left"), ("action must be numbers of shape (2, 8, 8), got <U4",)),
        ("actions of no shape", lambda: step(single(), [[1], [1, 2]]), ("action must be numbers", "got object")),
        ("actions for three", lambda: step(batch(), np.zeros((3, 2, 8, 8))), ("(2, 2, 8, 8)", "(3, 2, 8, 8)")),
        ("autoreset sometimes", lambda: batch(autoreset_mode="x"), ("autoreset_mode must be one of", "got 'x'")),
        ("horizon of a text", lambda: batch(max_episode_steps="x"), "max_episode_steps must be a whole number"),
        ("task without time", lambda: spec(horizon=0), "horizon must be at least 1, got 0"),
        ("task, patch too wide", lambda: spec(patch=200), "patch must be at most 128, got 200"),
        ("task, no action", lambda: spec(coarse=0), "coarse must be at least 1, got 0"),
        ("task, two objects", lambda: spec(objects=(spec().robot,) * 2), "objects must be at most one body, got 2"),
        (
            "rewards for three",
            lambda: rewarded(lambda moment, spec: Outcome({"velocity": torch.zeros(3)})),
            ("reward_fn of task 'run' must return terms of shape (B,)", "(3,) for 'velocity'"),
        ),
        ("disc of nothing", lambda: Disc((0.4, 0.2), 0.0), "diameter must be positive, got 0.0"),
        ("disc at a name", lambda: Disc("home", 0.1), "corner must be two numbers (x, y), got 'home'"),
        ("rectangle, flat", lambda: Rectangle((0.4, 0.2), (0.1, 0.0)), "size y must be positive, got 0.0"),
        ("lattice, flat", lambda: Lattice((0.4, 0.2), (0.0, 0.1)), "size x must be positive, got 0.0"),
        ("figure of no pixels", lambda: Figure(np.zeros((3, 3), bool), (0.4, 0.2), 0.1), "mask must be an array"),
        ("robot of nothing", lambda: RobotBody(Disc((0.4, 0.2), 0.1), 0), "count must be at least 1, got 0"),
        ("robot lighter than air", lambda: RobotBody(Disc((0.4, 0.2), 0.1), 9, -1.0), "mass must be positive, got -1"),
        ("robot of no area", lambda: env(body=[(0, 0), (1, 1), (2, 2)]), "body must have corners that enclose an area"),
        ("robot from a folder", lambda: env(body="/"), ("body must be", "path of an image; no such file: '/'")),
        ("box at a name", lambda: solid("box", ("a", "b"), (0, 9)), "i must be a range (low, high) of node indices"),
        ("ceiling at a name", lambda: ceiling("top"), "node must be a whole number, got 'top'"),
        ("task called 3", lambda: dittogym.register(3, make_spec), "task must be a name of letters"),
        ("namespace of two words", lambda: dittogym.register("x", spec, namespace="a b"), ("namespace must", "'a b'")),
        ("version minus one", lambda: dittogym.register("x", spec, version=-1), "version must not be negative, got -1"),
        ("target of a number", lambda: make_spec("shapematch", target=3), ("target must be 'star'", "got int")),
    ]
) + table(
    [
        ("unknown option", lambda: env(colour="red"), ("task 'run' has no option 'colour'", "body, obstacles")),
        ("single environment of three", lambda: single(num_envs=3), ("num_envs must not be given", "make_vec")),
        ("reward of nothing", lambda: rewarded(lambda moment, spec: None), "must return an Outcome, got NoneType"),
        ("reward function as text", lambda: spec(reward_fn="fair"), "reward_fn must be a function"),
        ("no robot", lambda: spec(robot=None), "robot must be a BodySpec, got None"),
        ("task of nothing", lambda: dittogym.register("x", None), "make must be a function that returns a TaskSpec"),
    ],
    TypeError,
)

CASES = [*SOLVER, *ENVIRONMENT]
