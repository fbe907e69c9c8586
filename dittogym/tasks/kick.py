"""KICK: drive a cube to the right and stay behind it."""

from dittogym.bodies.shapes import Disc, Rectangle
from dittogym.geometry import Window, ceiling, floor
from dittogym.rewards import Reward, Transition, signed_quadratic
from dittogym.spec import BodySpec, TaskSpec

#: Displacement of the cube that counts as success (our definition), m.
GOAL = 1.0
#: The episode ends when the robot's centre gets behind this, m.
REAR_LIMIT = -0.2
#: Distance between robot and cube from which its cost no longer grows, m.
GAP_CAP = 0.3


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Displacement and speed of cube and robot, and the distance between them."""
    now, start = transition.now, transition.start
    assert now.object_velocity is not None and start.object_com is not None
    kicked = transition.object_com[:, 0] - start.object_com[:, 0]
    travelled = now.com[:, 0] - start.com[:, 0]
    clamp = transition.ops.clamp
    object_location, location = (clamp(signed_quadratic(z, 4.0), -20.0, 30.0) for z in (kicked, travelled))
    speeds = (now.velocity[:, 0], now.object_velocity[:, 0])
    velocity, object_velocity = (clamp(signed_quadratic(v, 5.0), -20.0, 20.0) for v in speeds)
    gap = (now.com[:, 0] - transition.object_com[:, 0]).abs()
    return Reward(
        terms={
            "object_location": object_location,
            "location": location,
            "gap": -clamp(gap, high=GAP_CAP),
            "velocity": velocity,
            "object_velocity": object_velocity,
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
        robot=BodySpec(Disc((0.0, 0.16), 0.18), count=24400),
        objects=(BodySpec(Rectangle((0.3, 0.16), (0.05, 0.05)), count=2000, mass=5.0),),
        mu=600.0,
        yield_stress=90.0,
        max_actuation=50.0,
        gravity=(0.0, -12.0),
        damping=0.999,
        window=Window(follow=0.3),
        view=(None, 0.28),
        patch_centre=(None, 0.28),
        obstacles=(floor(), ceiling(126)),
        split_limit=0.11,
        reward_fn=reward_fn,
        weights={
            "object_location": 1.0,
            "location": 1.0,
            "gap": 10.0,
            "velocity": 6.0,
            "object_velocity": 6.0,
            "split": 1.0,
            "action": 2e-4,
            "alive": 4.0,
        },
    )
