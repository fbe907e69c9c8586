"""Bad arguments of dittogym; those of torchmpm are in ``tests/torchmpm/test_arguments.py``."""

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

ID = "dittogym/run-coarse-v0"


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

CASES = ENVIRONMENT
