"""OBSTACLE: run to the right, over a staircase."""

from dittogym.bodies.shapes import Lattice
from dittogym.geometry import Obstacle, Window, ceiling, floor, nodes
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks.run import Forward
from torchmpm import VelocityRule

#: Displacement that brings the robot past the stairs and counts as success (our definition), m.
GOAL = 0.5


def stair(k: int) -> Obstacle:
    """Column k of six, each one node lower than the one on its left."""
    left, right, top = 30 + 3 * k, 33 + 3 * k, 26 - k
    rules = (
        VelocityRule("+x", (left, right - 1), (None, top)),
        VelocityRule("-x", (left + 1, right), (None, top)),
        # Without friction, and before the floor: inside the columns the floor does not stick.
        VelocityRule("-y", (left, right), (None, top)),
    )
    return Obstacle(f"stair {k}", (nodes(left, right, top=top, closed=True),), rules=rules)


def obstacle() -> TaskSpec:
    """The task OBSTACLE."""
    return TaskSpec(
        name="obstacle",
        horizon=800,
        robot=BodySpec(Lattice((0.0, 0.16), (0.16, 0.16)), count=14400),
        mu=700.0,
        yield_stress=75.0,
        max_actuation=45.0,
        gravity=(0.0, -5.0),
        window=Window(follow=0.4),
        view=(None, 0.28),
        patch_centre=(None, 0.28),
        obstacles=(*map(stair, range(6)), floor(), ceiling(119)),
        split_limit=0.10,
        reward_fn=Forward(GOAL),
        weights={"location": 2.0, "velocity": 6.0, "split": 1.0, "action": 2e-4, "alive": 3.0},
    )
