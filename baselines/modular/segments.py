"""A robot's segments, the nodes of a modular policy: how they are found, what is seen of them, and how they act.

Particles are segmented by k-means. An episode begins with `fit`; every later step starts from the labels of the one
before, so that segments stay the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from scipy.sparse.csgraph import minimum_spanning_tree
from torch import Tensor
from torch.nn.functional import pad

from cfp.errors import ConfigError
from dittogym import TorchEnv
from dittogym.action import from_grid_layout, patch_corner
from dittogym.copies import to_device
from dittogym.geometry import FLOOR_NODE, NODES, centre_in_window
from dittogym.spec import TaskSpec
from dittogym.torch_env import find_mask
from torchmpm import checks, tree

#: Iterations of Lloyd's algorithm in every step: the inertia stays within 1 % of a converged clustering.
LLOYD_ITERATIONS = 2
#: Distance from the line half-way between two centres within which a particle is at their border, m (3/4 of a cell).
BORDER = 0.75 / NODES
#: Particles at the border, on each side, from which on two segments are neighbours.
MIN_BORDER_PARTICLES = 3
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


def fit(x: Tensor, count: int) -> Tensor:
    """Segment particles (B, N, 2), m, from scratch by scikit-learn's k-means; returns labels (B, N), int64."""
    from sklearn.cluster import KMeans  # takes a second to import, which other algorithms need not wait for

    if x.shape[1] < count:
        raise ConfigError(f"particles of the robot must be at least {count}, one per segment, got {x.shape[1]}")
    kmeans = KMeans(count, n_init=1, random_state=0)
    labels = [kmeans.fit(each).labels_ for each in x.double().cpu().numpy()]
    return torch.from_numpy(np.stack(labels).astype(np.int64)).to(x.device)


def update(x: Tensor, labels: Tensor, count: int) -> Tensor:
    """Segment particles (B, N, 2), m, that have moved, by Lloyd's algorithm from the previous labels (B, N)."""
    for _ in range(LLOYD_ITERATIONS):
        distance, labels = squared_distances(x, segment_means(x, labels, count)[0]).min(-1)
        sizes = x.new_zeros(len(x), count).scatter_add_(1, labels, torch.ones_like(labels).to(x))
        for element, empty in (sizes == 0).nonzero().tolist():  # gets the particle farthest from its centre
            farthest = int(distance[element].argmax())
            labels[element, farthest], distance[element, farthest] = empty, 0.0
    return labels


def segment(x: Tensor, labels: Tensor, count: int, mask: Tensor) -> Tensor:
    """Labels (B, N) in which the elements of a mask (B,), with particles at x (B, N, 2), are segmented anew."""
    labels = labels.clone()
    if bool(mask.any()):
        labels[mask] = fit(x[mask], count)
    return labels


def segment_means(values: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Means (B, K, C) of particle values (B, N, C) over segments, and the number of particles (B, K) in each."""
    columns = torch.cat((values, torch.ones_like(values[..., :1])), -1)
    sums = columns.new_zeros(len(values), count, columns.shape[-1])
    sums.scatter_add_(1, labels[..., None].expand_as(columns), columns)
    return sums[..., :-1] / sums[..., -1:].clamp_min(1.0), sums[..., -1]


def squared_distances(x: Tensor, centres: Tensor) -> Tensor:
    """Squared distances (B, N, K), m², from points (B, N, 2) to centres (B, K, 2)."""
    middle = centres.mean(1, keepdim=True)  # far from the origin the differences below lose their digits
    x, centres = x - middle, centres - middle
    square = x.square().sum(-1)[..., None] + centres.square().sum(-1)[:, None]
    return torch.baddbmm(square, x, centres.transpose(1, 2), alpha=-2.0).clamp_min_(0.0)


def adjacency(x: Tensor, centres: Tensor) -> Tensor:
    """Which segments of particles (B, N, 2) with centres (B, K, 2), m, are neighbours: (B, K, K) bool, connected.

    Two segments are neighbours if at least three particles of each have the other as their second nearest and lie at
    the border between the two. Components without contact are then joined by the shortest edges between centres.
    """
    batch, count = centres.shape[:2]
    (first, second), (own, other) = (t.unbind(-1) for t in squared_distances(x, centres).topk(2, largest=False))
    own_centre, other_centre = (centres.gather(1, t[..., None].expand(-1, -1, 2)) for t in (own, other))
    gap = (other_centre - own_centre).norm(dim=-1)
    at_border = (second - first) / (2.0 * gap).clamp_min(1e-9) < BORDER
    counts = torch.zeros(batch, count * count, device=x.device)
    counts.scatter_add_(1, own * count + other, at_border.to(counts))
    sides = counts.view(batch, count, count) >= MIN_BORDER_PARTICLES
    return connect(sides & sides.transpose(1, 2), torch.cdist(centres, centres))


def connect(edges: Tensor, distance: Tensor) -> Tensor:
    """Add the shortest edges, by distance (B, K, K), that make the graph of edges (B, K, K) connected."""
    # To scipy a weight of zero is no edge. Present edges weigh less than any other, so the tree adds only what lacks.
    weights = torch.where(edges, 1e-6, distance.double() + 1e-5).cpu().numpy()
    trees = torch.from_numpy(np.stack([minimum_spanning_tree(each).toarray() > 0 for each in weights]))
    trees = trees.to(edges.device)
    return edges | trees | trees.transpose(1, 2)


@dataclass(frozen=True)
class Nodes:
    """What a modular policy reads of the K segments of a robot, and how it writes actions of segments to the grid.

    A segment is read as a row of numbers: its centre relative to the robot's (2), its mean velocity (2), the standard
    deviations of its x and y (2), its share of the particles times K (1), and its height above the floor (1); then the
    robot's displacement since the reset (2), the goal relative to the segment's centre (2, in tasks with a goal), and
    position and velocity of the object relative to the segment's (4, in tasks with an object other than DIG's soil).
    Lengths are in units of 0.1 m, velocities in units of 0.5 m/s. With a graph, the segment's neighbours follow, as
    bits of whole numbers.

    Attributes:
        count: K, the number of segments, from 2 to 4096.
        graph: Whether rows hold the neighbours.

    Raises:
        ValueError: ``count`` is out of range, or ``graph`` is not a bool.
    """

    count: int
    graph: bool

    def __post_init__(self) -> None:
        checks.whole("count", self.count, 2, MAX_SEGMENTS)
        checks.flag("graph", self.graph)

    def num_features(self, spec: TaskSpec) -> int:
        """Return the length of a row without neighbours in a task."""
        return 10 + 2 * (spec.goal is not None) + 4 * _has_object(spec)

    def num_columns(self, spec: TaskSpec) -> int:
        """Return the length of a row in a task."""
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


class SegmentedState(NamedTuple):
    """All that the episodes of a `SegmentedEnv` need to continue."""

    simulation: Any
    labels: Tensor  # (B, N)
    observation: Tensor  # the last one, (B, K, columns)

    @property
    def steps(self) -> Tensor:
        """Control steps of the episodes (B,)."""
        steps: Tensor = self.simulation.steps
        return steps


class SegmentedEnv:
    """Observes rows of `Nodes` and takes actions of segments; for `cfp.envs.vec_env.TorchVecEnv`.

    A simulation that is not finite keeps its last observation; its episode ends there. ``labels`` (B, N) are the
    segments of the robot's particles.
    """

    def __init__(self, env: TorchEnv, nodes: Nodes) -> None:
        self.env, self.nodes = env, nodes
        self.num_envs, self.device = env.num_envs, env.device
        self.labels = torch.zeros(env.num_envs, env.model.num_robot_particles, dtype=torch.int64, device=env.device)
        shape = env.num_envs, nodes.count, nodes.num_columns(env.spec)
        self._observation = torch.zeros(shape, dtype=torch.float32, device=env.device)

    @property
    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Spaces of observations (K, columns) and actions (K, 2)."""
        shape = tuple(self._observation.shape[1:])
        return spaces.Box(-np.inf, np.inf, shape, np.float32), spaces.Box(-1.0, 1.0, (self.nodes.count, 2), np.float32)

    @property
    def spec(self) -> TaskSpec:
        """The task."""
        return self.env.spec

    @property
    def env_state(self) -> SegmentedState:
        """State of the simulation, labels and last observation."""
        return SegmentedState(self.env.env_state, self.labels, self._observation)

    @env_state.setter
    def env_state(self, value: SegmentedState) -> None:
        self.env.env_state, self.labels, self._observation = value

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """See `dittogym.TorchEnv.generators`."""
        return self.env.generators

    @generators.setter
    def generators(self, states: dict[int, dict[str, Tensor]]) -> None:
        self.env.generators = states

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes, see `dittogym.TorchEnv.reset`; returns rows (B, K, columns) and info."""
        _, info = self.env.reset(seed=seed, options=options)
        mask = to_device(find_mask("reset_mask", (options or {}).get("reset_mask"), self.num_envs), self.device)
        self.labels = segment(visible_positions(self.env), self.labels, self.nodes.count, mask)
        return self._observe(mask), info

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step, see `dittogym.TorchEnv.step`, with actions (B, K, 2)."""
        field = self.nodes.to_grid(self.env, self.labels, action)
        _, reward, terminated, truncated, info = self.env.step(from_grid_layout(field, self.env.action_layout))
        labels = update(visible_positions(self.env), self.labels, self.nodes.count)
        self.labels = tree.where(info["finite"], labels, self.labels)
        return self._observe(info["finite"]), reward, terminated, truncated, info

    def _observe(self, mask: Tensor) -> Tensor:
        self._observation = tree.where(mask, self.nodes.observe(self.env, self.labels), self._observation)
        return self._observation
