"""Rewards: what a task's reward function gets and returns, and the operations that it is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import softplus

from dittogym.copies import constant
from dittogym.observation import silhouette, soft_silhouette
from torchmpm import ParticleState, tree
from torchmpm.materials.linalg import safe_sqrt

#: The radius of gyration of a torn robot is not counted beyond this, m.
SPLIT_CAP = 0.2
#: Width of a smooth step, as a fraction of the limit.
RELATIVE_WIDTH = 0.05
#: Distance over which the weight of a particle falls off where the choice of the nearest is smooth, m.
SELECTION_WIDTH = 0.005

#: What a task remembers during an episode: tensors by name, with a leading B.
TaskState: TypeAlias = Mapping[str, Tensor]


@tree.register
@dataclass(frozen=True, eq=False)
class Features:
    """Averages over the bodies of a state.

    Attributes:
        com: (B, 2) mean position of the robot's particles in the world, m.
        velocity: (B, 2) their mean velocity, m/s.
        radius_of_gyration: (B,) spread of the robot, sqrt(Var x + Var y), m.
        object_com: (B, 2) mean position of the object's particles, m; ``None`` in tasks without an object.
        object_velocity: (B, 2) their mean velocity, m/s.
    """

    com: Tensor
    velocity: Tensor
    radius_of_gyration: Tensor
    object_com: Tensor | None = None
    object_velocity: Tensor | None = None


def features_of(particles: ParticleState, num_robot_particles: int) -> Features:
    """Averages over the robot, whose particles come first, and over the object if there is one."""
    x, v = particles.x, particles.v
    robot, other = slice(None, num_robot_particles), slice(num_robot_particles, None)
    com = x[:, robot].mean(1)
    variance = (x[:, robot] - com[:, None]).square().mean(1).sum(-1)  # several times faster than Tensor.var
    radius = safe_sqrt(variance)
    if num_robot_particles == x.shape[1]:
        return Features(com, v[:, robot].mean(1), radius)
    return Features(com, v[:, robot].mean(1), radius, x[:, other].mean(1), v[:, other].mean(1))


class Transition(NamedTuple):
    """What a reward function may look at after a step. Do not change its tensors in place: they belong to the state.

    Attributes:
        particles: The state of all particles.
        num_robot_particles: The robot's particles come first.
        now: Averages after the step.
        start: Averages right after the reset.
        observation: (B, 3, 64, 64) uint8, or for a smooth reward that of :func:`dittogym.core.soft_observation`.
        task_state: What the task remembers, tensors with a leading B.
        ops: Operations that have a smooth form, see :class:`RewardOps`.
    """

    particles: ParticleState
    num_robot_particles: int
    now: Features
    start: Features
    observation: Tensor
    task_state: TaskState
    ops: RewardOps

    @property
    def robot_x(self) -> Tensor:
        """Positions (B, n, 2) of the robot's particles, m."""
        return self.particles.x[:, : self.num_robot_particles]

    @property
    def object_com(self) -> Tensor:
        """Mean position (B, 2) of the object's particles, m.

        Raises:
            ValueError: The task has no object.
        """
        if self.now.object_com is None:
            raise ValueError("object_com needs a task with an object, got one without")
        return self.now.object_com


class Reward(NamedTuple):
    """What a reward function returns.

    Attributes:
        terms: Reward terms (B,) by name. The environment multiplies each by its weight in ``TaskSpec.weights`` and adds
            the terms ``split``, ``action``, ``alive`` and ``failure``.
        terminated: (B,) bool, the task's own reasons to end the episode; ``None`` if there are none.
        success: (B,) bool; ``None`` where success is not defined.
        info: Further quantities for ``info``, with a leading B.
        task_state: Replaces the task's state, leading B, with the same names and shapes; ``None`` keeps it. Tensors of
            int64 of shape (B, K) hold particle indices, in place of which planners with fewer particles keep their own
            from the start of the episode.
    """

    terms: Mapping[str, Tensor]
    terminated: Tensor | None = None
    success: Tensor | None = None
    info: Mapping[str, Tensor] | None = None
    task_state: TaskState | None = None


@dataclass(frozen=True)
class RewardOps:
    """Operations that rewards need and that have no useful derivative, each in an exact and a smooth form.

    Attributes:
        smooth: Whether these are the smooth forms, for gradients, or the exact ones, as the task defines them.
    """

    smooth: bool

    def clamp(
        self, z: Tensor, low: float | None = None, high: float | None = None, *, width: float | None = None
    ) -> Tensor:
        """Bring ``z`` into [low, high].

        The smooth form subtracts ``w ln(1 + exp((z - high) / w))``, at most w ln 2 at the limit, and adds the
        corresponding term at ``low``.

        Args:
            z: Of any shape.
            low: Least value; ``None``: unbounded.
            high: Largest value; ``None``: unbounded.
            width: w, in units of ``z``; ``None``: a twentieth of the limit's size, for a limit of 0 of the other's.

        Raises:
            ValueError: ``width`` is not positive, or is not given and all limits are 0, or ``low`` is above ``high``.
        """
        if low is not None and high is not None and low > high:
            raise ValueError(f"low must be at most high, {high}, got {low}")
        limits = [(limit, sign) for limit, sign in ((high, 1.0), (low, -1.0)) if limit is not None]
        largest = max((abs(limit) for limit, _ in limits), default=0.0)
        if width is not None and not width > 0:
            raise ValueError(f"width must be positive, got {width!r}")
        if width is None and limits and not largest:
            raise ValueError(f"width must be given where all limits are 0, got None with low {low}, high {high}")
        if not self.smooth:
            return z.clamp(low, high) if limits else z
        for limit, sign in limits:
            w = width or RELATIVE_WIDTH * (abs(limit) or largest)
            z = z - sign * w * softplus(sign * (z - limit) / w)
        return z

    def heaviside(self, z: Tensor, width: float) -> Tensor:
        """1 where ``z`` is positive, else 0; smooth, the sigmoid of ``z / width``, with a positive ``width``."""
        if not width > 0:
            raise ValueError(f"width must be positive, got {width!r}")
        return torch.sigmoid(z / width) if self.smooth else (z > 0).to(z.dtype)

    def split_penalty(self, radius: Tensor, limit: float) -> Tensor:
        """Penalty ``-(20 r)^2``, (B,), once the radius of gyration r (B,), m, exceeds ``limit``.

        The exact form counts r up to :data:`SPLIT_CAP` only. The smooth form sets in over a width of ``limit / 20`` and
        keeps growing.
        """
        counted = radius if self.smooth else radius.clamp_max(SPLIT_CAP)
        return -(20.0 * counted).square() * self.heaviside(radius - limit, RELATIVE_WIDTH * limit)

    def mean_over_nearest(self, values: Tensor, x: Tensor, point: Tensor, fraction: float) -> Tensor:
        """Mean of ``values`` over the particles nearest to a point, those that :func:`nearest` chooses.

        In the smooth form all particles count, with weights that fall off around the distance within which there are
        as many, over :data:`SELECTION_WIDTH`.

        Args:
            values: (B, N, K).
            x: (B, N, 2) positions of the particles, m.
            point: (B, 2), m.
            fraction: How many to choose, as a fraction of all, above 0 and at most 1.

        Returns:
            (B, K).

        Raises:
            ValueError: ``fraction`` is out of range.
        """
        if not 0 < fraction <= 1:
            raise ValueError(f"fraction must be above 0 and at most 1, got {fraction!r}")
        if not self.smooth:
            return pick(values, nearest(x.detach(), point.detach(), fraction)).mean(1)
        squared = _squared_distance(x, point)
        edge = squared.topk(count_of(fraction, x), largest=False).values[:, -1:]
        width = 2.0 * SELECTION_WIDTH * edge.clamp_min(SELECTION_WIDTH**2).sqrt()
        weight = torch.sigmoid((edge - squared) / width)[..., None]
        return (weight * values).sum(1) / weight.sum(1)

    def silhouette(self, observation: Tensor) -> Tensor:
        """Pixels (B, 64, 64) in which an observation shows matter: bool, or probabilities in the smooth form."""
        return soft_silhouette(observation) if self.smooth else silhouette(observation)


EXACT, SMOOTH = RewardOps(smooth=False), RewardOps(smooth=True)


def signed_quadratic(z: Tensor, k: float) -> Tensor:
    """``sign(z) (2 z)^2 + k z``: linear for small, quadratic for large deviations."""
    return 4.0 * z * z.abs() + k * z


def distance(x: Tensor, point: Tensor | Sequence[float]) -> Tensor:
    """Distances from a point, m, whose derivative is 0 where they coincide.

    Args:
        x: (B, N, 2), or (B, 2) for one position in each simulation, m.
        point: (B, 2), or two numbers for the same point in all simulations, m.

    Returns:
        (B, N) or (B,).

    Raises:
        ValueError: The point has another number of coordinates.
    """
    point = point if isinstance(point, Tensor) else constant(point, x)
    if point.ndim == 0 or point.shape[-1] != 2:
        raise ValueError(f"point must be two numbers or of shape (B, 2), got shape {tuple(point.shape)}")
    return safe_sqrt(_squared_distance(x, point))


def _squared_distance(x: Tensor, point: Tensor) -> Tensor:
    # By component: a state keeps components apart, and Tensor.norm over its last axis takes a hundred times as long.
    px, py = point[..., 0], point[..., 1]
    if x.ndim == 3 and point.ndim == 2:
        px, py = px[:, None], py[:, None]
    return (x[..., 0] - px).square() + (x[..., 1] - py).square()


def nearest(x: Tensor, point: Tensor, fraction: float) -> Tensor:
    """Indices (B, K) of a fraction of ``x`` (B, N, 2) nearest to ``point`` (B, 2), but for the largest absolute x."""
    return drop_widest(_squared_distance(x, point).topk(count_of(fraction, x), largest=False).indices, x)


def count_of(fraction: float, x: Tensor) -> int:
    """How many of the particles ``x`` (B, N, 2) a fraction is, at least one."""
    return max(1, round(fraction * x.shape[1]))


def drop_widest(index: Tensor, x: Tensor) -> Tensor:
    """Remove the particle with the largest absolute x from ``index`` (B, K), unless it is the only one: (B, K - 1)."""
    batch, count = index.shape
    if count == 1:
        return index
    widest = x[..., 0].abs().gather(1, index).argmax(1, keepdim=True)
    others = torch.arange(count - 1, device=index.device).expand(batch, -1)
    return index.gather(1, others + (others >= widest))


def pick(x: Tensor, index: Tensor) -> Tensor:
    """Values (B, K, D) of the particles ``index`` (B, K) among ``x`` (B, N, D)."""
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[2]))


def action_cost(actuation: Tensor) -> Tensor:
    """Sum over both muscle directions of the Frobenius norm of the actuation on the patch (B, 2, P, P); (B,)."""
    return safe_sqrt(actuation.flatten(2).square().sum(2)).sum(1)  # Tensor.norm has no second derivative at 0
