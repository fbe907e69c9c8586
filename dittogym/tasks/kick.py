"""KICK: drive a cube to the right and stay behind it."""

from __future__ import annotations

from dittogym.bodies.shapes import Disc, Rectangle
from dittogym.geometry import ceiling, floor
from dittogym.rewards import limited, signed_quadratic
from dittogym.spec import Body, Moment, Outcome, TaskSpec, Weights, Window

#: Displacement of the cube that counts as success (our definition), m.
GOAL = 1.0
#: The episode ends when the robot's centre gets behind this, m.
REAR_LIMIT = -0.2
#: Cost of the distance between robot and cube per metre, and the distance from which it no longer grows, m.
GAP_COST, GAP_CAP = 10.0, 0.3


def judge(moment: Moment, weights: Weights) -> Outcome:
    """Displacement and speed of cube and robot, and the distance between them."""
    now, start = moment.now, moment.start
    assert now.object_com is not None and now.object_velocity is not None and start.object_com is not None
    kicked = now.object_com[:, 0] - start.object_com[:, 0]
    travelled = now.com[:, 0] - start.com[:, 0]
    soft = moment.soft
    ahead, along = (limited(signed_quadratic(z, 4.0), -20.0, 30.0, soft=soft) for z in (kicked, travelled))
    speeds = (now.velocity[:, 0], now.object_velocity[:, 0])
    velocity, object_velocity = (limited(signed_quadratic(v, 5.0), -20.0, 20.0, soft=soft) for v in speeds)
    gap = (now.com[:, 0] - now.object_com[:, 0]).abs()
    return Outcome(
        terms={
            "object_location": weights.location * ahead,
            "location": weights.location * along,
            "gap": -weights.location * GAP_COST * limited(gap, high=GAP_CAP, soft=soft),
            "velocity": weights.velocity * velocity,
            "object_velocity": weights.velocity * object_velocity,
        },
        terminated=now.com[:, 0] < REAR_LIMIT,
        success=kicked >= GOAL,
        info={"displacement": travelled, "object_displacement": kicked, "gap": gap},
    )


def kick() -> TaskSpec:
    """The task KICK."""
    return TaskSpec(
        name="kick",
        horizon=500,
        robot=Body(Disc((0.0, 0.16), 0.18), count=24400),
        objects=(Body(Rectangle((0.3, 0.16), (0.05, 0.05)), count=2000, mass=5.0),),
        mu=600.0,
        yield_stress=90.0,
        max_actuation=50.0,
        gravity=(0.0, -12.0),
        damping=0.999,
        window=Window(follow=0.3),
        view=(None, 0.28),
        reach=(None, 0.28),
        obstacles=(floor(), ceiling(126)),
        split_limit=0.11,
        judge=judge,
        weights=Weights(location=1.0, velocity=6.0, split=1.0, action=2e-4, alive=4.0),
    )
