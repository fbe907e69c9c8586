"""What a modular policy sees of a robot's segments, and how it acts through them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from baselines.modular.kmeans import adjacency, averages, squared_distances
from dittogym import TorchEnv
from dittogym.action import from_grid_indexing, patch_corner
from dittogym.spec import TaskSpec
from dittogym.window import centre_in_window
from torchmpm import checks

LENGTH, SPEED = 0.1, 0.5
"""Units of the features, m and m/s: most values lie within [-2, 2]."""
FLOOR = 20 / 128
"""Height of the floor, m."""
FASTEST = 100.0
"""Speed along an axis at which the view saturates, m/s."""
BEYOND = 1.0
"""Distance from the window beyond which matter is seen no farther away, m: what tears can fly off to 1e20."""
MOST = 4096
"""Segments at most."""
BITS = 16
"""Neighbours that one float32 of a node's row holds; whole numbers up to 2^24 are exact there."""


@dataclass(frozen=True)
class Nodes:
    """Segments as rows of numbers.

    A row holds, for its segment: the centre relative to the robot's (2), mean velocity (2), spread along x and y (2),
    share of the particles times K (1), height above the floor (1). Then what is there to know of the surroundings:
    how far the robot has come (2), the goal relative to the centre (2, in tasks with one), the object relative to the
    centre, in place and velocity (4, in tasks with one that moves visibly: not DIG's soil). With a graph, the
    segment's neighbours follow, packed by `pack`.

    Attributes:
        count: Segments K.
        graph: With neighbours.

    Raises:
        ValueError: Fewer segments than two or more than `MOST`, or no truth value.
    """

    count: int
    graph: bool

    def __post_init__(self) -> None:
        checks.whole("count", self.count, 2, MOST)
        checks.flag("graph", self.graph)

    def features(self, spec: TaskSpec) -> int:
        """Length D of a row without neighbours."""
        return 10 + 2 * (spec.goal is not None) + 4 * _has_object(spec)

    def columns(self, spec: TaskSpec) -> int:
        """Length of a row."""
        return self.features(spec) + (-(-self.count // BITS) if self.graph else 0)

    def __call__(self, env: TorchEnv, labels: Tensor) -> Tensor:
        """Rows (B, K, columns), float32, of the environment's present state with labels (B, N)."""
        state, robot = env.env_state, env.model.num_robot_particles
        x, v = places(env), state.particles.v[:, :robot].clamp(-FASTEST, FASTEST)
        com = x.mean(1)[:, None]
        offset = x - com
        means, sizes = averages(torch.cat((offset, offset.square(), v), -1), labels, self.count)
        centre, square, velocity = means.split(2, -1)
        spread = (square - centre.square()).clamp_min(0.0).sqrt()
        place = com + centre
        parts = [
            centre / LENGTH,
            velocity / SPEED,
            spread * self.count**0.5 / LENGTH,
            sizes[..., None] * (self.count / robot),
            (place[..., 1:] - FLOOR) / LENGTH,
            ((com - state.start.com[:, None]) / LENGTH).expand_as(centre),
        ]
        if env.spec.goal is not None:
            parts.append((place.new_tensor(env.spec.goal) - place) / LENGTH)
        if _has_object(env.spec):
            parts.append((state.particles.x[:, robot:].mean(1)[:, None] - place) / LENGTH)
            parts.append((state.particles.v[:, robot:].mean(1)[:, None] - velocity) / SPEED)
        if self.graph:
            parts.append(pack(adjacency(offset, centre)))
        return torch.cat([part.float() for part in parts], -1)

    def act(self, env: TorchEnv, labels: Tensor, values: Tensor) -> Tensor:
        """Actions (B, 2, P, P) for an environment whose action grid is its patch.

        Every node of the patch gets the value of the segment whose centre is nearest.

        Args:
            env: Before its step.
            labels: (B, N).
            values: (B, K, 2), in [-1, 1].

        Raises:
            ValueError: The environment has another action grid.
        """
        size, state = env.spec.patch, env.env_state
        if env.action_resolution != size:
            raise ValueError(f"env: got an action grid of {env.action_resolution}, allowed {size}, the task's patch")
        grid = env.model.solver.grid.resolution
        corner = patch_corner(centre_in_window(env.spec.reach, state.centre, state.origin), size, grid)
        along = torch.arange(size, device=env.device)
        nodes = torch.stack(torch.meshgrid(along, along, indexing="ij"), -1).flatten(0, 1)
        place = state.origin[:, None] + (corner[:, None] + nodes) / grid
        centres, _ = averages(places(env), labels, self.count)
        nearest = squared_distances(place.to(centres), centres).argmin(-1)
        field = values.to(centres).gather(1, nearest[..., None].expand(-1, -1, 2))
        return from_grid_indexing(field.transpose(1, 2).unflatten(2, (size, size)), env.action_layout)


def places(env: TorchEnv) -> Tensor:
    """Where the robot's particles are seen, (B, N, 2), m: at most `BEYOND` outside the window, which is 1 m wide."""
    state = env.env_state
    low = state.origin[:, None] - BEYOND
    return state.particles.x[:, : env.model.num_robot_particles].clamp(low, low + 1.0 + 2.0 * BEYOND)


def _has_object(spec: TaskSpec) -> bool:
    return not all(body.hidden_velocity for body in spec.objects)


def pack(edges: Tensor) -> Tensor:
    """Neighbours (B, K, K) bool as whole numbers in float32, 16 to each, (B, K, K / 16), for a replay memory."""
    padded = torch.nn.functional.pad(edges, (0, -edges.shape[-1] % BITS))
    weights = 2.0 ** torch.arange(BITS, device=edges.device)
    return (padded.unflatten(-1, (-1, BITS)) * weights).sum(-1)


def unpack(numbers: Tensor, count: int) -> Tensor:
    """Undo `pack`, to float32 (B, K, K)."""
    shifts = torch.arange(BITS, device=numbers.device)
    bits = (numbers.to(torch.int32)[..., None] >> shifts) & 1
    return bits.flatten(-2)[..., :count].float()
