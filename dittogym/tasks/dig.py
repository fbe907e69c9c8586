"""DIG: get through loose soil to a point in it."""

from dittogym.bodies.shapes import Disc, Rectangle
from dittogym.copies import constant
from dittogym.geometry import Window, ceiling, floor, side_walls
from dittogym.rewards import Reward, Transition, signed_quadratic
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import Snow, lame

GOAL = (0.2, 0.17)
#: Mean distance of the robot's particles (|x| + |y|) from the goal that counts as success (our definition), m.
REACHED = 0.1
SNOW = Snow(*lame(5000.0, 0.2))
SOIL_PLACE = Rectangle((-0.25, 0.16), (0.5, 0.33), draws=2)
SOIL = BodySpec(SOIL_PLACE, count=8000, lite=3400, material=SNOW, hidden_velocity=True)


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Mean distance of all particles from the goal, under a square root; speed to the right and downwards."""
    x = transition.robot_x
    distance = (x - constant(spec.goal, x)).abs().sum(-1).mean(1)
    right, up = transition.now.velocity.unbind(1)
    rightwards, downwards = (transition.ops.clamp(signed_quadratic(v, 5.0), -20.0, 20.0) for v in (right, -up))
    return Reward(
        terms={"distance": -distance.sqrt(), "velocity": rightwards + downwards},
        success=distance < REACHED,
        info={"distance": distance},
    )


def dig() -> TaskSpec:
    """The task DIG."""
    return TaskSpec(
        name="dig",
        horizon=1000,
        robot=BodySpec(Disc((-0.2, 0.5), 0.14), count=12000),
        objects=(SOIL,),
        mu=400.0,
        yield_stress=65.0,
        max_actuation=50.0,
        gravity=(0.0, -19.0),
        window=Window(left=-0.5),
        view=(0.5, 0.4),
        patch=32,
        obstacles=(side_walls(None), floor(friction=0.0), ceiling(126)),
        goal=GOAL,
        split_limit=0.12,
        reward_fn=reward_fn,
        weights={"distance": 20.0, "velocity": 5.0, "split": 1.0, "action": 2e-4, "alive": 15.0},
    )
