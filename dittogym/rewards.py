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
    """Averages over the robot and over the object of a task.

    Attributes:
        com: (B, 2) mean position of the robot's particles in the world, m.
        velocity: (B, 2) mean velocity of the robot's particles, m/s.
        radius_of_gyration: (B,) spread of the robot, ``sqrt(Var x + Var y)`` over its particles, m.
        object_com: (B, 2) mean position of the object's particles, m; ``None`` in tasks without an object.
        object_velocity: (B, 2) mean velocity of the object's particles, m/s; ``None`` in tasks without an object.
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
    """What a reward function gets after a step. Do not change its tensors in place: they belong to the state.

    Attributes:
        particles: The state of all particles.
        num_robot_particles: Number of the robot's particles, which come first.
        now: Averages after the step.
        start: Averages right after the reset.
        observation: (B, 3, 64, 64) uint8; for a smooth reward, that of :func:`dittogym.core.soft_observation`.
        task_state: What the task remembers, tensors by name with a leading B.
        ops: Operations in an exact or in a smooth form, whichever the reward is to have.
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
        """Positions (B, n, 2) of the robot's n particles in the world, m."""
        return self.particles.x[:, : self.num_robot_particles]

    @property
    def object_com(self) -> Tensor:
        """Mean position (B, 2) of the object's particles in the world, m.

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
            its own terms ``split``, ``action``, ``alive`` and ``failure``.
        terminated: (B,) bool, whether the task ends the episode; ``None`` if it never does.
        success: (B,) bool, whether the task is solved now; ``None`` where success is not defined.
        info: Further quantities for ``info``, tensors by name with a leading B; ``None`` for none.
        task_state: What the task remembers from now on, with the names and shapes of ``initial_task_state``; ``None``
            keeps what it remembers. A tensor of int64 of shape (B, K) is taken for indices of particles: planners that
            simulate fewer particles keep their own indices from the start of the episode instead.

    Examples:
        >>> import dittogym
        >>> def reward_fn(transition, spec):
        ...     height = transition.now.com[:, 1] - transition.start.com[:, 1]
        ...     return dittogym.Reward({"height": height}, success=height > 0.03)
    """

    terms: Mapping[str, Tensor]
    terminated: Tensor | None = None
    success: Tensor | None = None
    info: Mapping[str, Tensor] | None = None
    task_state: TaskState | None = None


@dataclass(frozen=True)
class RewardOps:
    """Operations of rewards that have no useful derivative, each in an exact and in a smooth form.

    Attributes:
        smooth: True for the smooth forms, for gradients; False for the exact ones, as the task defines them.
    """

    smooth: bool

    def clamp(
        self, z: Tensor, low: float | None = None, high: float | None = None, *, width: float | None = None
    ) -> Tensor:
        """Bring ``z`` into [low, high].

        The smooth form subtracts ``w ln(1 + exp((z - high) / w))``, at most w ln 2 at the limit, and adds the
        corresponding term at ``low``.

        Args:
            z: A tensor of any shape.
            low: Least value; ``None`` for no bound.
            high: Largest value; ``None`` for no bound.
            width: w, in the unit of ``z``; ``None`` stands for a twentieth of the magnitude of the limit or, at a limit
                of 0, of the other limit.

        Returns:
            A tensor of the shape of ``z``.

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
        """Return 1 where ``z`` is positive and 0 elsewhere; in the smooth form, the sigmoid of ``z / width``.

        Args:
            z: A tensor of any shape.
            width: Width of the smooth step, in the unit of ``z``.

        Returns:
            A tensor of the shape and dtype of ``z``.

        Raises:
            ValueError: ``width`` is not positive.
        """
        if not width > 0:
            raise ValueError(f"width must be positive, got {width!r}")
        return torch.sigmoid(z / width) if self.smooth else (z > 0).to(z.dtype)

    def split_penalty(self, radius: Tensor, limit: float) -> Tensor:
        """Return the penalty ``-(20 r)^2`` of a robot whose radius of gyration r exceeds a limit, else 0.

        In the exact form, r counts up to 0.2 m only. The smooth form sets in over a width of ``limit / 20``, and keeps
        growing.

        Args:
            radius: (B,) r, m.
            limit: The limit, m.

        Returns:
            (B,).
        """
        counted = radius if self.smooth else radius.clamp_max(SPLIT_CAP)
        return -(20.0 * counted).square() * self.heaviside(radius - limit, RELATIVE_WIDTH * limit)

    def mean_over_nearest(self, values: Tensor, x: Tensor, point: Tensor, fraction: float) -> Tensor:
        """Return the mean of values over the particles nearest to a point.

        The exact form leaves out the one of these particles that has the largest absolute x, as the reference
        implementation does. In the smooth form all particles count, with weights that fall off around the distance
        within which the chosen fraction lies, over a width of 0.005 m.

        Args:
            values: (B, N, K) values of the particles.
            x: (B, N, 2) positions of the particles, m.
            point: (B, 2) the point, m.
            fraction: Fraction of the particles to choose, above 0 and at most 1.

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
        """Return the pixels in which an observation shows matter.

        Args:
            observation: (B, 3, 64, 64), as in :class:`dittogym.Transition`.

        Returns:
            (B, 64, 64) bool, see :func:`dittogym.observation.silhouette`; in the smooth form probabilities, see
            :func:`dittogym.observation.soft_silhouette`.
        """
        return soft_silhouette(observation) if self.smooth else silhouette(observation)


EXACT, SMOOTH = RewardOps(smooth=False), RewardOps(smooth=True)


def signed_quadratic(z: Tensor, k: float) -> Tensor:
    """``sign(z) (2 z)^2 + k z``: linear for small, quadratic for large deviations."""
    return 4.0 * z * z.abs() + k * z


def distance(x: Tensor, point: Tensor | Sequence[float]) -> Tensor:
    """Return distances from a point; where a distance is 0, its derivative is 0 and not NaN.

    Args:
        x: (B, N, 2) positions, or (B, 2) for one position in each simulation, m.
        point: (B, 2), or two numbers for the same point in all simulations, m.

    Returns:
        (B, N) or (B,), m.

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
