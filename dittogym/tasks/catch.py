"""CATCH: reach into a narrow shaft, take hold of a cube, and put it on a shelf."""

import math

from dittogym.bodies.shapes import Disc, Rectangle
from dittogym.copies import constant
from dittogym.geometry import Obstacle, Window, ceiling, floor, nodes, side_walls
from dittogym.rewards import Reward, TaskState, Transition
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import VelocityRule

GOAL = (0.15, 0.25)
#: Distance (|x| + |y|) of the cube's centre from the goal that counts as success (our definition), m.
CAUGHT = 0.05
#: Fraction of the robot's particles that are its hand: 1,201 of 20,000.
HAND = 1201 / 20000
#: Distance from which the costs of cube to goal and hand to cube no longer grow, m.
CAP = 0.5

# Observed blocks do not touch: a seam of one pixel is left between them, as in the reference.
RIGHT_BLOCK = Obstacle(
    "right block",
    (nodes(1, 34, 37, 45), nodes(26, 34, 27, 37), nodes(16, 34, 20, 27)),
    rules=(
        VelocityRule("+x", (1, 2), (37, 45)),
        VelocityRule("+x", (26, 27), (27, 37)),
        VelocityRule("+x", (16, 17), (20, 27)),
        VelocityRule("-y", (2, 31), (45, 45), friction=math.inf),
        VelocityRule("-y", (17, 25), (27, 27)),
        VelocityRule("+y", (2, 25), (37, 37)),
    ),
    observed=(nodes(1, 32, 37, 45), nodes(26, 32, 27, 37), nodes(16, 32, 20, 27)),
)
LEFT_BLOCK = Obstacle(
    "left block",
    (nodes(-34, -11, 37, 45), nodes(-34, -16, 27, 37), nodes(-34, -26, 20, 27)),
    rules=(
        VelocityRule("-x", (-12, -11), (37, 45)),
        VelocityRule("-x", (-17, -16), (27, 37)),
        VelocityRule("-x", (-27, -26), (20, 27)),
        VelocityRule("-y", (-31, -12), (45, 45), friction=math.inf),
        VelocityRule("+y", (-15, -12), (37, 37)),
        VelocityRule("+y", (-25, -17), (27, 27)),
    ),
    observed=(nodes(-32, -11, 37, 45), nodes(-32, -16, 27, 37), nodes(-32, -26, 20, 27)),
)


def initial_task_state(transition: Transition, spec: TaskSpec) -> TaskState:
    """The cube's centre: the hand is chosen by where the cube was a step ago."""
    return {"object_com": transition.object_com}


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Distances of the cube from the goal, and of the hand from the cube."""
    x, cube = transition.robot_x, transition.object_com
    hand = transition.ops.mean_over_nearest(x, x, transition.task_state["object_com"], HAND)
    to_goal, to_cube = (offset.abs().sum(-1) for offset in (cube - constant(spec.goal, cube), hand - cube))
    return Reward(
        terms={
            "object_distance": -transition.ops.clamp(to_goal, high=CAP),
            "hand_distance": -transition.ops.clamp(to_cube, high=CAP),
        },
        success=to_goal < CAUGHT,
        info={"object_distance": to_goal, "hand_distance": to_cube},
        task_state={"object_com": cube},
    )


def catch() -> TaskSpec:
    """The task CATCH."""
    return TaskSpec(
        name="catch",
        horizon=1200,
        robot=BodySpec(Disc((0.05, 0.36), 0.18), count=20000),
        objects=(BodySpec(Rectangle((-0.06, 0.16), (0.05, 0.05)), count=2000, mass=1.0),),
        mu=350.0,
        yield_stress=100.0,
        max_actuation=55.0,
        gravity=(0.0, -20.0),
        damping=0.999,
        window=Window(left=-0.5),
        view=(0.5, 0.4),
        patch_centre=(0.5, 0.4),
        obstacles=(side_walls(79), RIGHT_BLOCK, LEFT_BLOCK, floor(), ceiling(126)),
        goal=GOAL,
        split_limit=0.13,
        initial_task_state=initial_task_state,
        reward_fn=reward_fn,
        weights={"object_distance": 50.0, "hand_distance": 30.0, "split": 1.0, "action": 2e-4, "alive": 21.0},
    )
