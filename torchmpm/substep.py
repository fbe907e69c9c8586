"""One substep of MLS-MPM (Hu et al., 2018) with APIC transfers (Jiang et al., 2015), on component planes.

``substep`` reads like the algorithm in those papers: particles to grid, grid velocities, boundary, grid to particles.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchmpm import transfer, tree
from torchmpm.boundary import Face, constrain
from torchmpm.grid import Grid
from torchmpm.materials.base import broadcast_plane, check_returned
from torchmpm.materials.body import Body, slices
from torchmpm.materials.linalg import Mat2, Sym2, matmul
from torchmpm.materials.muscle import muscle_stress
from torchmpm.materials.resolved import detach_unresolved, resolved_stress
from torchmpm.spline import Stencil, stencil

#: Added to the mass of a node before the division, kg, so that an empty node has velocity zero.
MASS_EPSILON = 1e-10

#: The 13 component planes of a state, (B, N) each, see :meth:`torchmpm.ParticleState.planes`.
Planes = tuple[Tensor, ...]


@tree.register
@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same during one step, in the form that a substep needs."""

    grid: Grid
    bodies: tuple[Body, ...]
    dt: float  # s
    origin: Tensor  # (B, 2) lower left corner of the window, m
    mass: Tensor  # (B or 1, N) kg
    exists: Tensor  # (1, cells) 1 on nodes that exist, 0 on the padding
    gravity: Tensor  # (2, B or 1, cells) velocity gained by gravity in a substep, m/s
    damping: float  # factor on node velocities in a substep
    faces: tuple[Face, ...]  # velocity rules as masks
    actuation: Tensor | None  # (2, B, cells) on the nodes, Pa


class Scattered(NamedTuple):
    """Result of the first half of a substep."""

    nodes: Stencil
    inside: Tensor  # (B, N) which particles take part
    F: Mat2  # planes (B, N) of the returned deformation gradient
    Jp: Tensor  # (B, N) plastic volume ratio
    momentum: Tensor  # (3, B, cells) mass (kg) and momentum (kg m/s) on the nodes


def substep(scene: Scene, planes: Planes) -> Planes:
    """Advance all particles by one substep: from planes (B, N) to planes (B, N)."""
    planes = detach_unresolved(scene.bodies, planes, scene.dt)
    scattered = particles_to_grid(scene, planes)
    velocity = grid_velocity(scene, scattered.momentum)
    velocity = constrain(scene.faces, velocity)
    v, C = transfer.grid_to_particles(scene.grid, scattered.nodes, velocity)
    x, y = planes[:2]
    moved = (x + scene.dt * v[0], y + scene.dt * v[1], *v, *C, *scattered.F, scattered.Jp)
    return tuple(torch.where(scattered.inside, new, old) for new, old in zip(moved, planes, strict=True))


def particles_to_grid(scene: Scene, planes: Planes) -> Scattered:
    """First half of a substep: deform the particles, evaluate their stress, collect mass and momentum on the nodes."""
    x, y, *others = planes
    dt, grid = scene.dt, scene.grid
    inside = takes_part(grid, x, y, scene.origin)
    nodes = stencil(grid, x, y, scene.origin)
    # Particles outside get neutral values: zero times NaN would reach the derivatives of constants that all share.
    neutral = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0)  # v, C, F and Jp at rest
    still = (torch.where(inside, plane, number) for plane, number in zip(others, neutral, strict=True))
    vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, Jp = still
    trial = matmul((1.0 + dt * c0, dt * c1, dt * c2, 1.0 + dt * c3), (f0, f1, f2, f3))
    F, Jp, stress_momentum = _deform(scene, nodes, inside, trial, Jp)
    momentum = transfer.particles_to_grid(
        grid, nodes, inside.to(x.dtype), (vx, vy), (c0, c1, c2, c3), scene.mass, stress_momentum
    )
    return Scattered(nodes, inside, F, Jp, momentum)


def takes_part(grid: Grid, x: Tensor, y: Tensor, origin: Tensor) -> Tensor:
    """Which particles at (x, y), (B, N) each, m, move: those in the window at origin (B, 2), m."""
    height = (y - origin[:, 1:2]) * (1.0 / grid.h)
    return grid.contains(x, origin[:, 0:1]) & (height >= 0.0) & (height <= grid.resolution)


def _deform(scene: Scene, nodes: Stencil, inside: Tensor, trial: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor, Sym2]:
    """Returned deformation gradient, plastic volume ratio and ``-dt V 4/h^2 tau`` of all bodies."""
    parts: list[tuple[Tensor, ...]] = []
    for body, part in slices(scene.bodies):
        a, b, c, d = trial
        before = Jp[:, part]
        returned = body.material.return_map((a[:, part], b[:, part], c[:, part], d[:, part]), before)
        F, after = check_returned(body.material, returned, before)
        tau = resolved_stress(body, F, before, scene.grid.h, scene.dt)
        if body.muscle and scene.actuation is not None:
            pulls = transfer.interpolate(nodes.part(part), scene.actuation)
            ax, ay = (torch.where(inside[:, part], pull, 0.0) for pull in pulls)
            active = muscle_stress(F, (ax, ay))
            tau = (tau[0] + active[0], tau[1] + active[1], tau[2] + active[2])
        factor = -scene.dt * (4.0 / scene.grid.h**2) * broadcast_plane(body.volume, before, "volume")
        parts.append((*F, after, *(factor * component for component in tau)))
    planes = zip(*parts, strict=True)
    f0, f1, f2, f3, Jp, xx, xy, yy = (p[0] if len(p) == 1 else torch.cat(p, dim=1) for p in planes)
    return (f0, f1, f2, f3), Jp, (xx, xy, yy)


def grid_velocity(scene: Scene, momentum: Tensor) -> Tensor:
    """Velocity (2, B, cells), m/s, of the nodes before the boundary; zero on the padding."""
    velocity = free_velocity(scene, momentum) + scene.gravity
    return velocity * scene.damping if scene.damping != 1.0 else velocity


def free_velocity(scene: Scene, momentum: Tensor) -> Tensor:
    """Velocity of the nodes before gravity, (2, B, cells), m/s, from mass and momentum (3, B, cells)."""
    return momentum[1:] * (scene.exists / (momentum[0] + MASS_EPSILON))
