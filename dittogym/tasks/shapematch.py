"""SHAPE MATCH: take the shape of a picture, without gravity."""

from dittogym.bodies.images import DrawingLike
from dittogym.bodies.shapes import Disc
from dittogym.copies import constant
from dittogym.geometry import ceiling, floor
from dittogym.rewards import Reward, Transition
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks.targets import load_target

#: Intersection over union that counts as success (our definition).
MATCH = 0.8


def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
    """Number of pixels in which silhouette and target differ; in the smooth form the number to expect."""
    silhouette = transition.ops.silhouette(transition.observation)
    numbers = silhouette.to(transition.now.com)
    differing = (numbers - constant(spec.target, numbers)).abs().sum((1, 2))
    occupied = silhouette >= 0.5
    target = constant(spec.target, occupied)
    iou = (occupied & target).sum((1, 2)).to(numbers) / (occupied | target).sum((1, 2))
    return Reward(terms={"mismatch": -differing}, success=iou >= MATCH, info={"iou": iou})


def shapematch(target: DrawingLike = "star", fit: bool = True) -> TaskSpec:
    """Return the task SHAPE MATCH; its arguments are options of the environments.

    Args:
        target: The shape to take, see :func:`dittogym.tasks.targets.load_target`.
        fit: Whether a drawing is scaled and moved to fit the robot, see :func:`dittogym.tasks.targets.load_target`.

    Raises:
        ValueError: As in :func:`dittogym.tasks.targets.load_target`.
    """
    return TaskSpec(
        name="shapematch",
        horizon=30,
        robot=BodySpec(Disc((0.4, 0.5), 0.17), count=16000),
        mu=500.0,
        yield_stress=62.0,
        max_actuation=82.0,
        obstacles=(floor(), ceiling(119)),
        coarse=32,
        fine=64,
        reward_fn=reward_fn,
        weights={"mismatch": 0.1, "alive": 23.0},
        target=load_target(target, fit),
    )
