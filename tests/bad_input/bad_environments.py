"""Bad arguments of dittogym."""

import math
from dataclasses import replace

import gymnasium
import numpy as np
import torch
from bad_cases import table

import dittogym
from dittogym import TorchEnv, make_spec
from dittogym.bodies.shapes import Disc, Figure, Rectangle
from dittogym.geometry import Box, Window, solid
from dittogym.rewards import EXACT
from dittogym.spec import BodySpec

ID = "dittogym/run-coarse-v0"


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
    options = {"particles": 60, "substeps": 1, **options}
    return gymnasium.make_vec(ID, 2, vectorization_mode="vector_entry_point", **options)


def step(made, action):
    made.reset(seed=0)
    return made.step(action)


def reset(**options):
    return env().reset(options=options)


CASES = table(
    [
        ("task of a list", lambda: env(task=["run"]), "task"),
        ("task of a function", lambda: env(task=make_spec), ("task", "dittogym.register")),
        ("robots and a half", lambda: env(num_envs=1.5), "num_envs"),
        ("resolution of a float", lambda: env(resolution=8.0), ("resolution", "1 to 64", "got 8.0")),
        ("half particles", lambda: env(particles=(1.5,)), "particles[0]"),
        ("substeps not a number", lambda: env(substeps=math.nan), "substeps"),
        ("dtype of torch", lambda: env(dtype=torch.float16), "dtype"),
        ("device abacus", lambda: env(device="abacus"), ("device", "got 'abacus'")),
        ("layout of a page", lambda: env(action_layout="page"), ("action_layout", "got 'page'")),
        ("resample no", lambda: env(resample="no"), "resample"),
        ("seed and a half", lambda: env().reset(seed=1.5), "seed"),
        ("seed too large", lambda: env(num_envs=2).reset(seed=2**32 - 1), "seed"),
        ("options of a list", lambda: env().reset(options=[1]), ("options must be a mapping", "physics", "got [1]")),
        ("positions of a text", lambda: reset(positions="x"), ("positions", "'x'")),
        ("positions of NaN", lambda: reset(positions=np.full((60, 2), math.nan)), "positions"),
        ("mu of a truth", lambda: reset(physics={"mu": True}), ("physics['mu']", "True")),
        ("gravity that crosses cells", lambda: reset(physics={"gravity": (0.0, -1e12)}), "physics['gravity']"),
        ("mass of a planet", lambda: reset(physics={"mass": 1e30}), "physics['mass']"),
        ("load, mask of a text", lambda: (e := begun()).load(e.save(), "x"), ("mask must be bool of shape", "'x'")),
        ("action of an array", lambda: begun().step(np.zeros((2, 2, 8, 8))), ("action", "got ndarray")),
        ("action of bits", lambda: begun().step(torch.zeros(2, 2, 8, 8, device="meta")), "action"),
        ("action beyond float32", lambda: begun().step(torch.full((2, 2, 8, 8), 1e300, dtype=torch.float64)), "action"),
        ("masked action", lambda: step(single(), np.ma.masked_all((2, 8, 8))), "128 masked entries"),
        ("actions of words", lambda: step(single(), "left"), ("action", "<U4")),
        ("action of rows", lambda: step(single(), [[1.0], [1.0, 2.0]]), ("action", "list: ")),
        ("sparse action", lambda: step(single(), torch.zeros(2, 8, 8).to_sparse()), ("action", "Sparse")),
        ("actions for three", lambda: step(batch(), np.zeros((3, 2, 8, 8))), ("(2, 2, 8, 8)", "(3, 2, 8, 8)")),
        ("soft by name", lambda: begun().step(torch.zeros(2, 2, 8, 8), soft="no"), "soft"),
        ("muscles by name", lambda: single(render_muscles="x"), "render_muscles"),
        ("picture without pixels", lambda: single(render_size=0), "render_size"),
        ("pictures without pixels", lambda: batch(render_size=0), "render_size"),
        ("muscles of a batch", lambda: batch(render_muscles=1), "render_muscles"),
        ("picture from afar", lambda: begun().render(zoom=1e-9), "zoom"),
        ("picture too large", lambda: begun().render(size=10**6), "size"),
        ("policy of nothing", lambda: env().film(lambda seen: None), "policy"),
        ("autoreset sometimes", lambda: batch(autoreset_mode="x"), ("autoreset_mode", "got 'x'")),
        ("limit of no steps", lambda: batch(max_episode_steps=0), "max_episode_steps"),
        (
            "state of another task",
            lambda: setattr(begun(task="catch", particles=(60, 60)), "env_state", begun(particles=120).env_state),
            ("env_state", "object_com"),
        ),
        ("target of numbers", lambda: spec(target=np.zeros((64, 64))), "target"),
        ("target of a number", lambda: make_spec("shapematch", target=3), "target"),
        ("task, window of both kinds", lambda: Window(left=0.1, follow=0.4), "left"),
        ("task, patch too wide", lambda: spec(patch=200), "patch"),
        ("task, two objects", lambda: spec(objects=(spec().robot,) * 2), "objects"),
        ("goal outside of the window", lambda: env(task=replace(make_spec("grow"), goal=(9.0, 0.0))), "goal"),
        ("variant of a name", lambda: make_spec("slot", variant="soft"), "variant"),
        ("box of no order", lambda: Box(0.5, 0.1), ("left and right", "got 0.5 and 0.1")),
        ("box at a name", lambda: solid("box", ("a", "b"), (0, 9)), "i must be"),
        ("box at a truth", lambda: solid("box", (True, 9), (0, 9)), "i must be"),
        ("box from 9 to 0", lambda: solid("box", (9, 0), (0, 9)), ("low <= high", "got (9, 0)")),
        ("box seen by name", lambda: solid("box", (0, 9), (0, 9), visible="no"), "visible"),
        ("step of no width", lambda: EXACT.heaviside(torch.zeros(1), 0.0), "width"),
        ("clamp of no order", lambda: EXACT.clamp(torch.zeros(1), 1.0, 0.5), "low"),
        (
            "nearest of all twice",
            lambda: EXACT.mean_over_nearest(*[torch.zeros(1, 3, 2)] * 2, torch.zeros(1, 2), 2.0),
            "fraction",
        ),
        ("disc at a name", lambda: Disc("home", 0.1), "corner"),
        ("box that draws nothing", lambda: Rectangle((0, 0), (1, 1), draws=0), "draws"),
        ("figure of no pixels", lambda: Figure(np.zeros((3, 3), bool), (0.4, 0.2), 0.1), "mask"),
        ("robot of nothing", lambda: BodySpec(Disc((0.4, 0.2), 0.1), 0), "count"),
        ("robot of no area", lambda: env(body=[(0, 0), (1, 1), (2, 2)]), "body"),
        ("namespace of a module", lambda: dittogym.register("x", spec, namespace="a:b"), ("namespace", "'a:b'")),
        ("namespace of two words", lambda: dittogym.register("x", spec, namespace="a b"), ("namespace", "'a b'")),
    ]
) + table(
    [
        ("unknown option", lambda: env(colour="red"), ("'colour'; its options", "body, obstacles")),
        ("parity", lambda: env(parity="reference"), "'parity'; its options"),
        ("single environment of three", lambda: single(num_envs=3), ("num_envs", "make_vec")),
        ("reward of nothing", lambda: env(task=spec(reward_fn=lambda transition, spec: None)), "must return a Reward"),
    ],
    TypeError,
)
