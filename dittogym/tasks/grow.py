"""GROW: reach a point above, past two beams."""

from dittogym.bodies.shapes import Lattice
from dittogym.copies import constant
from dittogym.geometry import Obstacle, Window, ceiling, floor, nodes, side_walls
from dittogym.rewards import Reward, TaskState, Transition, count_of, distance, drop_widest, pick
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import VelocityRule

GOAL = (0.0, 0.5)
#: The episode ends, in success, with the tip this near to the goal, m.
REACHED = 0.04
#: It ends, in failure, with the tip this far away, m.
LOST = 0.28
#: In a smooth reward the bonus sets in over this distance, m.
BONUS_WIDTH = 0.005
#: Fraction of the robot's particles that are its tip: 2,000 of 19,600.
TIP = 2000 / 19600

RIGHT_BEAM = Obstacle(
    "right beam",
    (nodes(15, 32, 38, 41),),
    rules=(
        VelocityRule("+x", (15, 16), (38, 41)),
        VelocityRule("-x", (30, 31), (38, 41)),
        VelocityRule("-y", (15, 32), (41, 41)),
        VelocityRule("+y", (15, 32), (38, 38)),
    ),
    observed=(nodes(15, 31, 38, 41),),
)
LEFT_BEAM = Obstacle(
    "left beam",
    (nodes(-30, 2, 54, 57),),
    rules=(
        VelocityRule("+x", (-30, -29), (54, 57)),
        VelocityRule("-x", (1, 2), (54, 57)),
        VelocityRule("-y", (-30, 2), (56, 57)),
        VelocityRule("+y", (-30, 2), (54, 54)),
    ),
)


def initial_task_state(transition: Transition, spec: TaskSpec) -> TaskState:
    """The tip: the highest particles at the start; of equally high ones the first (undefined in the reference)."""
    x = transition.robot_x.detach()
    highest = x[..., 1].argsort(dim=1, descending=True, stable=True)[:, : count_of(TIP, x)]
    return {"tip": drop_widest(highest, x)}


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Mean distance of the tip from the goal, under a square root."""
    tip = pick(transition.particles.x, transition.task_state["tip"])
    gap = distance(tip, constant([spec.goal], tip)).mean(1)
    reached = gap < REACHED
    return Reward(
        terms={"distance": -gap.sqrt(), "success": transition.ops.heaviside(REACHED - gap, BONUS_WIDTH)},
        terminated=reached | (gap > LOST),
        success=reached,
        info={"distance": gap},
    )


def grow() -> TaskSpec:
    """The task GROW."""
    return TaskSpec(
        name="grow",
        horizon=600,
        robot=BodySpec(Lattice((-0.06, 0.16), (0.16, 0.16)), count=19600),
        mu=400.0,
        yield_stress=50.0,
        max_actuation=30.0,
        gravity=(0.0, -9.0),
        damping=0.999,
        window=Window(left=-0.5),
        view=(0.5, 0.4),
        patch_centre=(0.5, 0.4),
        obstacles=(side_walls(39), floor(), ceiling(126), RIGHT_BEAM, LEFT_BEAM),
        goal=GOAL,
        split_limit=0.16,
        initial_task_state=initial_task_state,
        reward_fn=reward_fn,
        weights={"distance": 40.0, "success": 200.0, "split": 1.0, "action": 2e-4, "alive": 23.0},
    )
