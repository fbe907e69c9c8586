"""The robot's particles in segments, by k-means, and which segments touch.

The first segmentation of an episode is scikit-learn's, seeded. Every later one starts from the labels of the one
before: segments keep their particles while matter moves, so their identity lasts.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cfp.errors import ConfigError

LLOYD = 2
"""Iterations of Lloyd's algorithm in every step: the inertia stays within 1 % of a converged clustering."""
BORDER = 0.75 / 128
"""Distance from the line half-way between two centres within which a particle is at their border, m (3/4 of a cell)."""
TOUCHING = 3
"""Particles at the border, on each side, from which on two segments touch."""


def begin(x: Tensor, count: int, seed: int = 0) -> Tensor:
    """Segment particles anew, by scikit-learn's k-means.

    Args:
        x: (B, N, 2) positions, m.
        count: Segments K.
        seed: Of the first centres (k-means++).

    Returns:
        Labels (B, N), int64.

    Raises:
        ConfigError: There are fewer particles than segments.
    """
    from sklearn.cluster import KMeans  # takes a second to import, which other algorithms need not wait for

    if x.shape[1] < count:
        raise ConfigError(f"particles: got {x.shape[1]} of the robot, allowed {count} (one for each segment) or more")
    kmeans = KMeans(count, n_init=1, random_state=seed)
    labels = [kmeans.fit(each).labels_ for each in x.double().cpu().numpy()]
    return torch.from_numpy(np.stack(labels).astype(np.int64)).to(x.device)


def averages(values: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Means (B, K, C) of particle values (B, N, C) over segments, and the particles (B, K) in each."""
    columns = torch.cat((values, torch.ones_like(values[..., :1])), -1)
    sums = columns.new_zeros(len(values), count, columns.shape[-1])
    sums.scatter_add_(1, labels[..., None].expand_as(columns), columns)
    return sums[..., :-1] / sums[..., -1:].clamp_min(1.0), sums[..., -1]


def squared_distances(x: Tensor, centres: Tensor) -> Tensor:
    """From points (B, N, 2) to centres (B, K, 2), (B, N, K), m²."""
    middle = centres.mean(1, keepdim=True)  # far from the origin the differences below lose their digits
    x, centres = x - middle, centres - middle
    square = x.square().sum(-1)[..., None] + centres.square().sum(-1)[:, None]
    return torch.baddbmm(square, x, centres.transpose(1, 2), alpha=-2.0).clamp_min_(0.0)


def follow(x: Tensor, labels: Tensor, count: int) -> Tensor:
    """Segment particles that have moved: some iterations of Lloyd's algorithm from the labels before.

    A segment that is left without particles gets the one that is farthest from its centre.

    Args:
        x: (B, N, 2) positions, m.
        labels: (B, N) of the segmentation before.
        count: Segments K.
    """
    for _ in range(LLOYD):
        distance, labels = squared_distances(x, averages(x, labels, count)[0]).min(-1)
        sizes = torch.zeros(len(x), count, device=x.device).scatter_add_(1, labels, torch.ones_like(labels).to(x))
        for element, empty in (sizes == 0).nonzero().tolist():
            far = int(distance[element].argmax())
            labels[element, far], distance[element, far] = empty, 0.0
    return labels


def adjacency(x: Tensor, centres: Tensor) -> Tensor:
    """Which segments touch, (B, K, K) bool, symmetric; the graph is connected.

    Two segments touch where particles of each, at least three, have the other as their second nearest and lie at the
    border between the two. Parts without contact are then linked by the shortest edges between centres.

    Args:
        x: (B, N, 2) positions, m.
        centres: (B, K, 2), m.
    """
    batch, count = centres.shape[:2]
    (first, second), (own, other) = (t.unbind(-1) for t in squared_distances(x, centres).topk(2, largest=False))
    pick = (t[..., None].expand(-1, -1, 2) for t in (own, other))
    apart = torch.stack([centres.gather(1, index) for index in pick]).diff(dim=0)[0].norm(dim=-1)
    border = (second - first) / (2.0 * apart).clamp_min(1e-9) < BORDER
    counts = torch.zeros(batch, count * count, device=x.device)
    counts.scatter_add_(1, own * count + other, border.to(counts))
    sides = counts.view(batch, count, count) >= TOUCHING
    return connected(sides & sides.transpose(1, 2), torch.cdist(centres, centres))


def connected(edges: Tensor, distance: Tensor) -> Tensor:
    """Edges (B, K, K) with the shortest ones added, by distance (B, K, K), that link what is not linked."""
    batch, count, _ = edges.shape
    edges, every = edges.clone(), torch.arange(batch, device=edges.device)
    while True:
        gap, pair = torch.where(_reachable(edges), torch.inf, distance).flatten(1).min(1)
        if not bool(gap.isfinite().any()):
            return edges
        one, two, missing = pair // count, pair % count, gap.isfinite()
        edges[every, one, two] |= missing
        edges[every, two, one] |= missing


def _reachable(edges: Tensor) -> Tensor:
    """Which nodes a path joins, (B, K, K) bool."""
    paths = (edges | torch.eye(edges.shape[-1], dtype=torch.bool, device=edges.device)).float()
    for _ in range((edges.shape[-1] - 1).bit_length()):
        paths = (paths @ paths).clamp_(max=1.0)
    return paths > 0
