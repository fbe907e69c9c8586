"""Features and actions of a robot's segments, the nodes of a modular policy."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from baselines.modular.kmeans import adjacency, segment_means, squared_distances
from dittogym import TorchEnv
from dittogym.action import patch_corner
from dittogym.geometry import FLOOR_NODE, NODES, centre_in_window
from dittogym.spec import TaskSpec
from torchmpm import checks

#: Units of the features, m and m/s: most values lie within [-2, 2].
LENGTH_SCALE, SPEED_SCALE = 0.1, 0.5
#: Height of the floor, m.
FLOOR = (FLOOR_NODE + 1) / NODES
#: Speed along an axis at which the feature saturates, m/s.
MAX_SPEED = 100.0
#: Distance from the window at which positions saturate, m: torn-off matter can fly as far as 1e20.
MAX_DISTANCE = 1.0
#: Largest number of segments.
MAX_SEGMENTS = 4096
#: Neighbours packed into one float32 of a node's row; integers up to 2^24 are exact there.
BITS = 16


@dataclass(frozen=True)
class Nodes:
    """Reads a robot's segments as rows of numbers, and writes values of segments to the action grid.

    A row holds, for its segment: the centre relative to the robot's (2), mean velocity (2), standard deviation of x and
    y (2), share of the particles times K (1), height above the floor (1). Then the surroundings: the robot's
    displacement since the reset (2), the goal relative to the centre (2, in tasks with one), position and velocity of
    the object relative to the segment's (4, in tasks with one that is drawn as a body: not DIG's snow). With a graph,
    the segment's neighbours follow, packed by `pack`.

    Attributes:
        count: Number of segments K.
        graph: Whether rows hold neighbours.

    Raises:
        ValueError: ``count`` is below 2 or above `MAX_SEGMENTS`, or ``graph`` is not a bool.
    """

    count: int
    graph: bool

    def __post_init__(self) -> None:
        checks.whole("count", self.count, 2, MAX_SEGMENTS)
        checks.flag("graph", self.graph)

    def num_features(self, spec: TaskSpec) -> int:
        """Length of a row without neighbours in a task."""
        return 10 + 2 * (spec.goal is not None) + 4 * _has_object(spec)

    def num_columns(self, spec: TaskSpec) -> int:
        """Length of a row in a task."""
        return self.num_features(spec) + (-(-self.count // BITS) if self.graph else 0)

    def observe(self, env: TorchEnv, labels: Tensor) -> Tensor:
        """Rows (B, K, columns), float32, of the environment's present state with labels (B, N)."""
        state, robot = env.env_state, env.model.num_robot_particles
        x, v = visible_positions(env), state.particles.v[:, :robot].clamp(-MAX_SPEED, MAX_SPEED)
        com = x.mean(1)[:, None]
        offset = x - com
        means, sizes = segment_means(torch.cat((offset, offset.square(), v), -1), labels, self.count)
        centre, square, velocity = means.split(2, -1)
        std = (square - centre.square()).clamp_min(0.0).sqrt()
        position = com + centre
        parts = [
            centre / LENGTH_SCALE,
            velocity / SPEED_SCALE,
            std * self.count**0.5 / LENGTH_SCALE,
            sizes[..., None] * (self.count / robot),
            (position[..., 1:] - FLOOR) / LENGTH_SCALE,
            ((com - state.start.com[:, None]) / LENGTH_SCALE).expand_as(centre),
        ]
        if env.spec.goal is not None:
            parts.append((position.new_tensor(env.spec.goal) - position) / LENGTH_SCALE)
        if _has_object(env.spec):
            parts.append((state.particles.x[:, robot:].mean(1)[:, None] - position) / LENGTH_SCALE)
            parts.append((state.particles.v[:, robot:].mean(1)[:, None] - velocity) / SPEED_SCALE)
        if self.graph:
            parts.append(pack(adjacency(offset, centre)))
        return torch.cat([part.float() for part in parts], -1)

    def to_grid(self, env: TorchEnv, labels: Tensor, values: Tensor) -> Tensor:
        """Muscles (B, 2, P, P) in which every node of the patch has the value of the segment with the nearest centre.

        Labels are (B, N), values (B, K, 2) in [-1, 1], and nodes are indexed (x rightwards, y upwards). The action grid
        of ``env`` must be its patch.
        """
        size, state = env.spec.patch, env.env_state
        grid = env.model.solver.grid.resolution
        corner = patch_corner(centre_in_window(env.spec.patch_centre, state.centre, state.origin), size, grid)
        index = torch.arange(size, device=env.device)
        indices = torch.stack(torch.meshgrid(index, index, indexing="ij"), -1).flatten(0, 1)
        position = state.origin[:, None] + (corner[:, None] + indices) / grid
        centres, _ = segment_means(visible_positions(env), labels, self.count)
        nearest = squared_distances(position.to(centres), centres).argmin(-1)
        field = values.to(centres).gather(1, nearest[..., None].expand(-1, -1, 2))
        return field.transpose(1, 2).unflatten(2, (size, size))


def visible_positions(env: TorchEnv) -> Tensor:
    """Positions (B, N, 2), m, of the robot's particles, cut at `MAX_DISTANCE` from the window, which is 1 m wide."""
    state = env.env_state
    low = state.origin[:, None] - MAX_DISTANCE
    return state.particles.x[:, : env.model.num_robot_particles].clamp(low, low + 1.0 + 2.0 * MAX_DISTANCE)


def _has_object(spec: TaskSpec) -> bool:
    return not all(body.hidden_velocity for body in spec.objects)


def pack(edges: Tensor) -> Tensor:
    """Pack neighbours (B, K, K) bool as integers in float32, 16 in each, (B, K, K / 16), for a replay buffer."""
    padded = pad(edges, (0, -edges.shape[-1] % BITS))
    weights = 2.0 ** torch.arange(BITS, device=edges.device)
    return (padded.unflatten(-1, (-1, BITS)) * weights).sum(-1)


def unpack(numbers: Tensor, count: int) -> Tensor:
    """Unpack what `pack` made of the neighbours of ``count`` nodes, to float32 (B, K, K)."""
    shifts = torch.arange(BITS, device=numbers.device)
    bits = (numbers.to(torch.int32)[..., None] >> shifts) & 1
    return bits.flatten(-2)[..., :count].float()
