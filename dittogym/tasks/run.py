"""RUN: run to the right, as far and as fast as possible."""

from dataclasses import dataclass

from dittogym.bodies.shapes import Disc
from dittogym.geometry import Obstacle, Window, ceiling, floor, nodes
from dittogym.rewards import Reward, Transition, signed_quadratic
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import VelocityRule

#: Displacement from which the location term no longer grows, m; reaching it counts as success (our definition).
GOAL = 1.70
#: The episode ends when the robot's centre gets behind this, m.
REAR_LIMIT = -0.2

# The observation does not show it.
HANGING_BLOCK = Obstacle(
    "hanging block",
    (nodes(32, 47, 59),),
    rules=(
        VelocityRule("+x", (32, 34), (61, None)),
        VelocityRule("-x", (46, 47), (61, None)),
        VelocityRule("+y", (33, 46), (59, 60)),
    ),
    observed=(),
)


@dataclass(frozen=True)
class Forward:
    """Displacement from the start and present speed to the right, both saturating; OBSTACLE uses it too."""

    goal: float  # Displacement that counts as success, m

    def __call__(self, transition: Transition, spec: TaskSpec) -> Reward:
        """Displacement, speed and end of the episode."""
        travelled = transition.now.com[:, 0] - transition.start.com[:, 0]
        values = (travelled, transition.now.velocity[:, 0])
        location, velocity = (transition.ops.clamp(signed_quadratic(z, 5.0), -20.0, 20.0) for z in values)
        return Reward(
            terms={"location": location, "velocity": velocity},
            terminated=transition.now.com[:, 0] < REAR_LIMIT,
            success=travelled >= self.goal,
            info={"displacement": travelled},
        )


def run() -> TaskSpec:
    """The task RUN."""
    return TaskSpec(
        name="run",
        horizon=800,
        robot=BodySpec(Disc((0.0, 0.16), 0.18), count=22000),
        mu=650.0,
        yield_stress=90.0,
        max_actuation=45.0,
        gravity=(0.0, -9.0),
        damping=0.999,
        window=Window(follow=0.4),
        view=(None, 0.28),
        patch_centre=(None, 0.28),
        obstacles=(HANGING_BLOCK, floor(), ceiling(119)),
        split_limit=0.10,
        reward_fn=Forward(GOAL),
        weights={"location": 1.0, "velocity": 4.0, "split": 1.0, "action": 2e-4, "alive": 3.0},
    )
