"""Segmentation of the robot's particles by k-means, and which segments are neighbours.

An episode begins with `fit`; every later step starts from the labels of the one before, so segments stay the same.
"""

import numpy as np
import torch
from scipy.sparse.csgraph import minimum_spanning_tree
from torch import Tensor

from cfp.errors import ConfigError
from dittogym.geometry import NODES

#: Iterations of Lloyd's algorithm in every step: the inertia stays within 1 % of a converged clustering.
LLOYD_ITERATIONS = 2
#: Distance from the line half-way between two centres within which a particle is at their border, m (3/4 of a cell).
BORDER = 0.75 / NODES
#: Particles at the border, on each side, from which on two segments are neighbours.
MIN_BORDER_PARTICLES = 3


def fit(x: Tensor, count: int, seed: int = 0) -> Tensor:
    """Segment particles (B, N, 2), m, from scratch by scikit-learn's k-means; returns labels (B, N), int64."""
    from sklearn.cluster import KMeans  # takes a second to import, which other algorithms need not wait for

    if x.shape[1] < count:
        raise ConfigError(f"particles of the robot must be at least {count}, one per segment, got {x.shape[1]}")
    kmeans = KMeans(count, n_init=1, random_state=seed)
    labels = [kmeans.fit(each).labels_ for each in x.double().cpu().numpy()]
    return torch.from_numpy(np.stack(labels).astype(np.int64)).to(x.device)


def update(x: Tensor, labels: Tensor, count: int) -> Tensor:
    """Segment particles (B, N, 2), m, that have moved, by Lloyd's algorithm from the previous labels (B, N)."""
    for _ in range(LLOYD_ITERATIONS):
        distance, labels = squared_distances(x, segment_means(x, labels, count)[0]).min(-1)
        sizes = torch.zeros(len(x), count, device=x.device).scatter_add_(1, labels, torch.ones_like(labels).to(x))
        for element, empty in (sizes == 0).nonzero().tolist():  # gets the particle farthest from its centre
            farthest = int(distance[element].argmax())
            labels[element, farthest], distance[element, farthest] = empty, 0.0
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
