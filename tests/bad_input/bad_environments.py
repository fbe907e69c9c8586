"""Bad arguments of dittogym: what the error must name, and a call."""

import math
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from bad_cases import table

import dittogym
from dittogym import Reward, TorchEnv, core, make_spec, trajectories
from dittogym.bodies.shapes import Disc, Figure, Rectangle
from dittogym.geometry import Box, Obstacle, Window, floor, side_walls, solid
from dittogym.render.recording import as_function
from dittogym.rewards import EXACT, SMOOTH, distance
from dittogym.spec import BodySpec
from dittogym.wrappers import action_resolution, observation_resolution
from torchmpm import Elastic, VelocityRule

ID = "dittogym/run-coarse-v0"
SMALL = {"particles": 60, "substeps": 1}
NAN, ONE = math.nan, torch.zeros(1)


def env(**changes):
    return TorchEnv(**{"task": "run", **SMALL, "backend": "eager", **changes})


def grow(**conditions):
    return env(task="grow", conditions=conditions)


def begun(**changes):
    made = env(num_envs=2, **changes)
    made.reset(seed=0)
    return made


def spec(**changes):
    return replace(make_spec("run"), **changes)


def single(**options):
    return gymnasium.make(ID, **SMALL, **options).unwrapped


def batch(**options):
    return gymnasium.make_vec(ID, 2, vectorization_mode="vector_entry_point", **SMALL, **options)


def step(made, action):
    made.reset(seed=0)
    return made.step(action)


def action(**options):
    return begun().step(torch.zeros((2, 2, 8, 8), **options))


def reset(seed=None, **options):
    return env(num_envs=2).reset(seed=seed, options=options)


def physics(**values):
    return reset(physics=values)


def load(mask=None, **changes):
    """A snapshot of an environment that differs."""
    other = env(**{"num_envs": 2, **changes})
    other.reset(seed=0)
    return begun().load(other.save(), mask)


def moved_out():
    """Given positions inside of the window, which a shift moves out of it."""
    at_edge = np.linspace((0.8, 0.5), (0.999, 0.5), 60)
    env(task="shapematch", num_envs=8, conditions={"shift": 0.1}).reset(seed=0, options={"positions": at_edge})


def state(**changes):
    """The state of an environment that differs."""
    begun(task="catch", particles=(60, 60)).env_state = begun(**changes).env_state


def pure(action):
    """A step of the pure functions."""
    made = begun()
    return core.step(made.model, made.env_state, action)


def pure_reset(positions, **physics):
    return core.reset(env().model, positions, physics)


def model(**changes):
    """A model of the pure functions."""
    arguments = {"spec": make_spec("run"), "counts": (60,), "substeps": 1, "backend": "eager", **changes}
    return core.make_model(**arguments)


def film(path=None, policy=lambda seen: None, **options):
    return env().film(policy, path, **options)


def played():
    return env().film(lambda seen: np.zeros((1, 2, 8, 8), np.float32), max_steps=1)


def body(given, task="run"):
    return env(task=task, body=given)


def target(given):
    return make_spec("shapematch", target=given)


def register(make, name="x"):
    return dittogym.register(name, make)


def returned(weights=None, start=None, **changes):
    """A task whose reward function returns something else in a field."""

    def reward_fn(transition, spec):
        risen = {"height": transition.now.com[:, 1]}
        return Reward(**{"terms": risen, **changes})

    def remember(transition, spec):
        return {"first": transition.now.com} if start is None else start

    return env(task=spec(reward_fn=reward_fn, weights=weights or {"height": 1.0}, initial_task_state=remember))


def height_of_one(transition, spec):
    """A mistake: the second simulation in place of the second axis."""
    return Reward({"height": transition.now.com[1]})


def json_of(shape):
    """An environment that is made again from the JSON of its specification."""
    made = gymnasium.make(ID, body=shape, **SMALL).spec.to_json()
    return gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(made))


@dataclass(frozen=True)
class Tilted(Disc):
    """A shape of one's own."""

    tilt: float = 0.0


class Spilling(Rectangle):
    """A shape that is larger than it says."""

    def positions(self, numbers):
        return 2 * super().positions(numbers)


class Lost(Rectangle):
    """A shape that does not place all particles."""

    def positions(self, numbers):
        return super().positions(numbers)[::2]


class OfTheGrid:
    """A policy that was trained in another layout."""

    description = {"environment": {"action_layout": "grid"}}

    def predict(self, observation, state=None):
        return None, None


VALUES = [
    # Environments.
    ("task", lambda: env(task=["run"])),
    ("task", lambda: env(task=make_spec)),
    ("task", lambda: env(task="hope")),
    ("num_envs", lambda: env(num_envs=1.5)),
    ("resolution", lambda: env(resolution=8.0)),
    ("particles[0]", lambda: env(particles=(1.5,))),
    ("substeps", lambda: env(substeps=NAN)),
    ("dt", lambda: env(dt=3e-4, substeps=None)),
    ("dtype", lambda: env(dtype=torch.float16)),
    ("device", lambda: env(device="abacus")),
    ("action_layout", lambda: env(action_layout="page")),
    ("resample", lambda: env(resample="no")),
    ("render_mode", lambda: single(render_mode="ansi")),
    ("render_mode", lambda: batch(render_mode="human")),
    ("render_muscles", lambda: single(render_muscles="x")),
    ("render_size", lambda: batch(render_size=0)),
    ("autoreset_mode", lambda: batch(autoreset_mode="x")),
    ("max_episode_steps", lambda: batch(max_episode_steps=-2)),
    ("size", lambda: observation_resolution(batch(), 65)),
    ("action", lambda: step(action_resolution(single(), 4), np.zeros((2, 5, 5), np.float32))),
    # Conditions.
    *(("latency", lambda value=value: grow(latency=value)) for value in (0.5, (-1, 2), (2, 1))),
    *(("action_noise", lambda value=value: grow(action_noise=value)) for value in (-0.1, NAN)),
    ("action_dropout must be at most 1, got 1.5", lambda: grow(action_dropout=(0.5, 1.5))),
    ("observation_dropout must be a number or a pair", lambda: grow(observation_dropout=(0, 0.1, 0.2))),
    ("mu must be positive", lambda: grow(mu=0.0)),
    ("yield_stress must be a number", lambda: grow(yield_stress="1")),
    ("shift must be a number, got (0.0, 0.1)", lambda: grow(shift=(0.0, 0.1))),
    ("shift must be at most 1", lambda: grow(shift=1.5)),
    ("chance", lambda: grow(chance=1.1)),
    *(("grid", lambda size=size: grow(grid=size)) for size in (0, 9)),
    ("'friction'", lambda: grow(friction=1.0)),
    ("conditions", lambda: env(conditions=0.5)),
    ("matter stable, got {'mu': (1.0, 500.0)}, with which dt must be at most", lambda: grow(mu=(1.0, 500.0))),
    ("matter stable", lambda: grow(gravity=1e6)),
    ("matter stable", lambda: grow(mu=(0.5, 1.0)).reset(options={"physics": {"lam": -300.0}})),
    ("robot room, got shift=0.2 and turn=0", lambda: grow(shift=0.2)),
    *(("the obstacle 'right beam'", lambda turn=turn: grow(turn=turn)) for turn in (45.0, 180.0, 720.0)),
    ("place of the object", lambda: env(task="kick", conditions={"shift": 0.15})),
    # Between the largest shifts, where the robot is behind the object or the stair; and with the object left behind.
    ("place of the object", lambda: env(task="kick", conditions={"shift": 0.4})),
    ("the obstacle 'stair 0'", lambda: env(task="obstacle", conditions={"shift": 0.4})),
    ("objects[0] must lie inside the window", lambda: env(task="kick", conditions={"shift": 0.6})),
    # Resets, snapshots and states.
    *(("seed", lambda seed=seed: reset(seed)) for seed in (1.5, 2**32 - 1, [1], [1, -2])),
    ("options", lambda: env().reset(options=[1])),
    ("'position'", lambda: reset(position=0)),
    ("reset_mask", lambda: reset(reset_mask=[1, 0])),
    ("reset_mask", lambda: reset(reset_mask=[True, False])),  # the first time
    ("positions", lambda: reset(positions="x")),
    ("positions", lambda: reset(positions=np.zeros((59, 2)))),
    ("positions", lambda: reset(positions=np.full((60, 2), NAN))),
    ("positions", lambda: reset(positions=np.linspace((0.0, 0.5), (2.0, 0.5), 60))),  # outside the window
    ("positions", moved_out),
    ("physics", lambda: reset(physics=3.0)),
    ("'nu'", lambda: physics(nu=0.3)),
    *(
        ("physics['mu']", lambda mu=mu: physics(mu=mu))
        for mu in (True, "stiff", [[1.0], [1.0, 2.0]], [1.0] * 3, [1.0, -2.0])
    ),
    ("physics['max_actuation']", lambda: physics(max_actuation=torch.ones(2, 60))),
    ("physics['yield_stress']", lambda: physics(yield_stress=-1.0)),
    ("physics['lam']", lambda: physics(lam=[50.0, -5000.0])),
    ("physics['lam']", lambda: physics(lam=-70.0, mu=torch.tensor([[60.0, 80.0]]).repeat(2, 30))),
    *(("physics['gravity']", lambda g=g: physics(gravity=g)) for g in (-9.0, (0.0, NAN), (0.0, -1e12))),
    *(("physics['mass']", lambda mass=mass: physics(mass=mass)) for mass in (0.0, 1e30)),
    *(("mask", lambda mask=mask: load(mask)) for mask in ("x", [1, 0], [True])),
    ("task", lambda: load(task="grow")),
    ("particles", lambda: load(particles=59)),
    ("dtype", lambda: load(dtype="float64")),
    ("num_envs", lambda: load(num_envs=3)),
    ("substeps", lambda: load(substeps=3)),
    ("dt", lambda: load(dt=5e-5, substeps=1)),
    ("obstacles", lambda: load(obstacles=())),
    ("robot", lambda: load([True, False], body=np.ones((9, 5), bool))),
    *(("env_state", lambda c=c: state(**c)) for c in ({"particles": 120}, {"particles": 9}, {"dtype": "float64"})),
    ("task state", lambda: setattr(env(task="grow", num_envs=2), "env_state", begun().env_state)),  # of another task
    # Steps, pictures and films.
    ("action", lambda: begun().step(np.zeros((2, 2, 8, 8)))),
    ("action", lambda: action(dtype=torch.int64)),
    ("action", lambda: action(device="meta")),
    ("action", lambda: begun().step(torch.zeros(2, 2, 8, 8).to_sparse())),
    ("action", lambda: begun().step(torch.full((2, 2, 8, 8), NAN))),
    ("action", lambda: step(single(), np.ma.masked_all((2, 8, 8)))),
    ("action", lambda: step(single(), "left")),
    ("action", lambda: step(single(), [[1.0], [1.0, 2.0]])),
    ("action", lambda: step(single(), torch.zeros(2, 8, 8).to_sparse())),
    ("action", lambda: step(batch(), np.zeros((3, 2, 8, 8)))),
    ("soft", lambda: begun().step(torch.zeros(2, 2, 8, 8), soft="no")),
    ("action", lambda: pure(torch.zeros(2, 2, 65, 65))),
    ("action", lambda: pure(torch.zeros(2, 2, 8, 8, dtype=torch.float64))),
    ("positions", lambda: pure_reset(torch.zeros(60, 2))),
    ("physics", lambda: pure_reset(torch.full((1, 60, 2), 0.3), young=torch.ones(1))),
    ("counts", lambda: model(counts=(60, 60))),
    ("counts[0]", lambda: model(counts=(0,))),
    *(("substeps", lambda s=s: model(substeps=s)) for s in (0, -1, 2.5)),
    ("segment", lambda: model(segment=0)),
    *(("dt", lambda dt=dt: model(dt=dt)) for dt in ("x", -1e-4)),
    ("zoom", lambda: begun().render(zoom=1e-9)),
    ("size", lambda: begun().render(size=3)),
    ("muscles", lambda: begun().render(muscles="no")),
    ("time", lambda: played().picture(NAN)),
    *(("speed", lambda s=s: played().page(s)) for s in (0, -1.0)),
    ("policy", film),
    ("policy", lambda: film(policy=OfTheGrid())),
    ("path", lambda: film("film.avi")),
    ("size", lambda: film("film.mp4", size=3)),
    ("rate", lambda: film("film.gif", rate=0)),
    ("rate", lambda: film("film.gif", rate=1e-3)),
    ("speed", lambda: film("film.gif", speed=-1)),
    ("zoom", lambda: film("film.gif", zoom=0)),
    ("pictures", lambda: film("film.png", pictures=0)),
    ("size", lambda: film("film.html", size=64)),  # without effect
    ("max_steps", lambda: film(max_steps=0)),
    ("env", lambda: trajectories.record(begun(), lambda seen: None)),
    ("fields", lambda: trajectories.record(env(), lambda seen: None, fields=("x", "y"))),
    ("path", lambda: trajectories.save_episodes("a.h5", [])),
    ("episodes", lambda: trajectories.save_episodes("a.npz", [])),
    # Bodies and obstacles.
    ("body", lambda: body(np.zeros((8, 8), bool))),
    ("body", lambda: body([(0, 0), (1, 0), (0, NAN)])),
    ("body", lambda: body([(0, 0), (1, 1), (2, 2)])),
    ("body", lambda: body("no/such/file.png")),
    ("body", lambda: body(42)),
    ("body", lambda: body(np.zeros((5, 5, 2), np.uint8))),
    ("kind of a body", lambda: json_of(Tilted((0.1, 0.16), 0.15))),
    ("kind of a body", lambda: body({"kind": ["Disc"]})),
    ("robot", lambda: body(Rectangle((-0.45, 0.2), (0.1, 0.9)))),  # outside the window
    ("robot", lambda: body(Rectangle((0.25, 0.16), (0.1, 0.1)), "kick")),  # in the object
    ("robot", lambda: body(Rectangle((0.05, 0.1), (0.1, 0.1)))),  # in the floor
    ("robot", lambda: body([(0, 0), (6, 0), (6, 1), (0, 1)])),  # torn from the start
    ("objects[0]", lambda: env(task=spec(objects=(BodySpec(Disc((0.17, 0.02), 0.06), 100),)))),
    ("objects[0]", lambda: env(task=spec(objects=(BodySpec(Rectangle((0.9, 0.3), (0.2, 0.1)), 9),)))),
    *(("target", lambda t=t: target(t)) for t in ("heart", 3, np.zeros((64, 64), bool), np.full((8, 8), 2.0))),
    ("target", lambda: target([[1], [1, 0]])),
    ("corner", lambda: Disc("home", 0.1)),
    ("draws", lambda: Rectangle((0, 0), (1, 1), draws=0)),
    ("mask", lambda: Figure(np.zeros((3, 3), bool), (0.4, 0.2), 0.1)),
    ("mask", lambda: Figure(np.pad(np.ones((3, 3), bool), ((0, 1), (0, 0))), (0.4, 0.2), 0.1)),
    ("positions of Spilling", lambda: body(Spilling((0.1, 0.2), (0.1, 0.1)))),
    ("positions of Lost", lambda: body(Lost((0.1, 0.2), (0.1, 0.1)))),
    ("count", lambda: BodySpec(Disc((0.4, 0.2), 0.1), 0)),
    ("left and right", lambda: Box(0.5, 0.1)),
    *(("i must", lambda i=i: solid("box", i, (0, 9))) for i in (("a", "b"), (True, 9), (9, 0))),
    ("visible", lambda: solid("box", (0, 9), (0, 9), visible="no")),
    ("boxes", lambda: solid("thin", (3, 5), (0, 9))),
    ("boxes", lambda: Obstacle("nothing")),
    ("friction", lambda: floor(friction=-1.0)),
    *(("top", lambda top=top: side_walls(top)) for top in (2.5, "high")),
    ("friction", lambda: replace(floor(), friction=0.3)),  # it would have no effect
    ("left", lambda: Window(left=0.1, follow=0.4)),
    # Tasks.
    ("task", lambda: register(make_spec, "run")),
    ("task", lambda: register(dittogym.TASKS["run"])),
    ("make must have arguments of other names", lambda: register(lambda conditions=None: spec())),
    ("got body, particles", lambda: register(lambda particles=3, body=None: spec())),
    ("variant", lambda: make_spec("slot", variant="soft")),
    ("goal", lambda: env(task=replace(make_spec("grow"), goal=(9.0, 0.0)))),
    ("goal", lambda: spec(goal=(1.0, 2.0, 3.0))),
    ("target", lambda: spec(target=np.zeros((3, 3), bool))),
    ("patch", lambda: spec(patch=200)),
    ("objects", lambda: spec(objects=(spec().robot,) * 2)),
    ("max_actuation", lambda: spec(max_actuation=-5.0)),
    ("damping", lambda: spec(damping=2.0)),
    ("patch_centre y", lambda: spec(patch_centre=(None, "up"))),
    ("view", lambda: spec(view=(-0.1, 0.5))),
    ("coarse", lambda: spec(coarse=17)),
    ("weights['action']", lambda: spec(weights={"action": -2e-4})),
    ("weights", lambda: returned({"heigth": 7.0})),
    ("weights", lambda: returned({"height": 7.0, "alve": 1.0})),
    ("'height'", lambda: returned(terms={"height": torch.zeros(2)})),
    ("'height'", lambda: env(task=spec(reward_fn=height_of_one, weights={"height": 1.0}))),
    ("finite terms", lambda: returned(terms={"height": torch.tensor([1.0, torch.nan, 1.0])})),
    ("terms", lambda: returned(terms={"alive": torch.zeros(3)})),
    ("terminated", lambda: returned(terminated=torch.zeros(2, 2, dtype=torch.bool))),
    ("success", lambda: returned(success=torch.zeros(3))),
    ("info", lambda: returned(info={"com": torch.zeros(3)})),
    ("'_risen'", lambda: returned(info={"_risen": torch.zeros(3)})),
    ("'risen'", lambda: returned(info={"risen": 1.0})),
    ("task_state", lambda: returned(task_state={"first": torch.zeros(2)})),
    ("initial_task_state", lambda: returned(start={"peak": 1.0})),
    ("width", lambda: EXACT.heaviside(ONE, 0.0)),
    ("low", lambda: EXACT.clamp(ONE, 1.0, 0.5)),
    *(("width", lambda ops=ops: ops.clamp(ONE, 0.0)) for ops in (EXACT, SMOOTH)),
    ("width", lambda: SMOOTH.clamp(ONE, 0.0, width=0)),
    ("fraction", lambda: EXACT.mean_over_nearest(*[torch.zeros(1, 3, 2)] * 2, torch.zeros(1, 2), 2.0)),
    *(("point", lambda point=point: distance(torch.zeros(1, 2), point)) for point in (1.0, (0.0, 0.0, 9.0))),
]
TYPES = [
    ("'colour'; its options", lambda: env(colour="red")),
    ("'target'; its options", lambda: make_spec(make_spec("run"), target="star")),
    ("'sped'", lambda: film("film.mp4", sped=1)),
    ("path", lambda: film(size=64)),
    ("num_envs", lambda: single(num_envs=3)),
    ("env_state", lambda: setattr(begun(), "env_state", None)),
    ("material", lambda: BodySpec(Disc((0.4, 0.2), 0.1), 9, material=3)),
    ("env", lambda: action_resolution(env(), 4)),
    ("env", lambda: trajectories.record(None, lambda seen: None)),
    *(("fields", lambda f=f: trajectories.record(env(), lambda seen: None, fields=f)) for f in ("xv", (1,))),
    ("policy", lambda: as_function(3, env())),
    ("options of a film must be among size", lambda: begun().film(lambda seen: None, "a.mp4", fps=10)),
    ("make", lambda: register(5)),
    ("make", lambda: register(lambda: None)),
    ("'pull'", lambda: register(lambda pull: spec())),
    ("weights", lambda: spec(weights=1.0)),
    ("obstacles[0] must be of type Obstacle", lambda: spec(obstacles=(VelocityRule("-y"),))),
    ("obstacles", lambda: spec(obstacles=floor())),
    ("initial_task_state", lambda: spec(initial_task_state="peak")),
    ("reward_fn", lambda: env(task=spec(reward_fn=lambda transition, spec: None))),
    ("terms", lambda: returned(terms=None)),
    ("info", lambda: returned(info=[1])),
    ("task_state", lambda: returned(task_state=torch.zeros(1))),
    ("initial_task_state", lambda: returned(start=3.0)),
    ("Tensor", lambda: json_of(BodySpec(Disc((0.1, 0.16), 0.15), 900, material=Elastic(torch.tensor(300.0), 50.0)))),
]
STATES = [
    ("call reset() first", lambda: env().step(torch.zeros(1, 2, 8, 8))),
    ("call reset() first", lambda: env().save()),
    ("call reset() first", lambda: env(num_envs=2).load(begun().save(), [True, False])),
    ("call reset() first", lambda: setattr(env(resample=True), "generators", begun(resample=True).generators)),
]


def cases(rows, error):
    return table([(f"{words} {k} ({error.__name__})", call, words) for k, (words, call) in enumerate(rows)], error)


CASES = [*cases(VALUES, ValueError), *cases(TYPES, TypeError), *cases(STATES, RuntimeError)]
