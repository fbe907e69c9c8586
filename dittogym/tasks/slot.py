"""SLOT: get through a low passage and knock a cap off its shelf on the far side."""

import math
from typing import Literal

from torch import Tensor

from dittogym.bodies.shapes import Disc, Rectangle
from dittogym.geometry import Obstacle, Window, ceiling, floor, nodes
from dittogym.rewards import Reward, TaskState, Transition, distance, signed_quadratic
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import VelocityRule, fixed

#: Below this height the cap has fallen, and the episode ends, m.
FALLEN = 0.24
#: Right of this it fell on the far side, which is success, m.
FAR_SIDE = 0.67
#: In a smooth reward falling and reaching the far side set in over this distance, m.
FALL_WIDTH = 0.01
#: Where the cap rests at the start, m.
CAP_START = 0.585
#: The episode ends when the robot's centre gets behind this, m.
REAR_LIMIT = -0.05
#: Fraction of the robot's particles that reach for the cap: 2,000 of 20,000.
FRONT = 2000 / 20000
#: (mu, yield stress, muscle limit), Pa: of the registered environment, and of the published training run.
VARIANTS = {"registered": (500.0, 85.0, 40.0), "published": (650.0, 90.0, 45.0)}

BLOCK = Obstacle(
    "hanging block",
    (nodes(32, 45, 36),),
    rules=(
        VelocityRule("+x", (32, 34), (36, None)),
        VelocityRule("-x", (44, 45), (36, None)),
        VelocityRule("+y", (32, 45), (35, 36)),
    ),
)
SHELF = Obstacle(
    "shelf",
    (nodes(45, 70, 38, 40, closed=True),),
    rules=(
        VelocityRule("+x", (45, 46), (40, 40)),
        VelocityRule("-x", (69, 70), (40, 40)),
        VelocityRule("-y", (45, 70), (40, 40), friction=math.inf),
        VelocityRule("+y", (45, 70), (40, 40)),
    ),
)
POST = Obstacle(
    "post",
    (nodes(81, 85, top=40, closed=True),),
    rules=(
        VelocityRule("+x", (81, 82), (None, 39)),
        VelocityRule("-x", (84, 85), (None, 39)),
        VelocityRule("-y", (82, 85), (40, 40), friction=math.inf),
    ),
)
# Moves with the robot: a wall behind it and one ahead.
FRAME = Obstacle(
    "frame",
    rules=tuple(
        rule for end in ((0, 0), (127, 127)) for rule in (*fixed(i=end, frame="window"), *fixed(j=end, frame="window"))
    ),
)


def front_distance(transition: Transition) -> Tensor:
    """Mean distance of the robot's front from the cap's centre, (B,), m."""
    x, cap = transition.robot_x, transition.object_com
    return transition.ops.mean_over_nearest(distance(x, cap)[..., None], x, cap, FRONT)[:, 0]


def initial_task_state(transition: Transition, spec: TaskSpec) -> TaskState:
    """The distance at the start, against which progress is measured."""
    return {"front_distance": front_distance(transition)}


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Approach to the cap, displacement of the cap, where it falls, and speed in both directions."""
    cap, front, ops = transition.object_com, front_distance(transition), transition.ops
    approached = transition.task_state["front_distance"] - front
    fallen, far = cap[:, 1] < FALLEN, cap[:, 0] >= FAR_SIDE
    side = 2.0 * ops.heaviside(cap[:, 0] - FAR_SIDE, FALL_WIDTH) - 1.0
    return Reward(
        terms={
            "approach": ops.clamp(signed_quadratic(4.0 * approached, 5.0), -20.0, 50.0),
            "object_location": 200.0 * (cap[:, 0] - CAP_START),
            "fall": 100.0 * side * ops.heaviside(FALLEN - cap[:, 1], FALL_WIDTH),
            "velocity": ops.clamp(signed_quadratic(transition.now.velocity, 10.0), -20.0, 20.0).sum(1),
        },
        terminated=fallen | (transition.now.com[:, 0] < REAR_LIMIT),
        success=fallen & far,
        info={"distance": front},
    )


def slot(variant: Literal["registered", "published"] = "registered") -> TaskSpec:
    """Return the task SLOT; its argument is an option of the environments.

    Args:
        variant: ``"registered"`` for the material of the reference implementation's registered environment, or
            ``"published"`` for that of the published training run.

    Raises:
        ValueError: There is no such variant.
    """
    if variant not in tuple(VARIANTS):
        raise ValueError(f"variant must be one of {tuple(VARIANTS)}, got {variant!r}")
    mu, yield_stress, max_actuation = VARIANTS[variant]
    return TaskSpec(
        name="slot",
        horizon=1500,
        robot=BodySpec(Disc((0.0, 0.16), 0.16), count=20000),
        objects=(BodySpec(Rectangle((0.52, 0.322), (0.13, 0.03)), count=2000),),
        mu=mu,
        yield_stress=yield_stress,
        max_actuation=max_actuation,
        gravity=(0.0, -20.0),
        window=Window(follow=0.25),
        view=(None, 0.28),
        patch_centre=(None, 0.28),
        obstacles=(BLOCK, SHELF, POST, floor(), ceiling(119), FRAME),
        split_limit=0.12,
        initial_task_state=initial_task_state,
        reward_fn=reward_fn,
        weights={
            "approach": 2.0,
            "object_location": 2.0,
            "fall": 2.0,
            "velocity": 6.0,
            "split": 1.0,
            "action": 2e-4,
            "alive": 3.0,
        },
    )
