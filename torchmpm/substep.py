"""One substep of MLS-MPM (Hu et al., 2018) with APIC transfers (Jiang et al., 2015), on the components of a state.

:func:`substep` reads like the algorithm in those papers: particles to grid, grid velocities, boundary, grid to
particles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchmpm import transfer, tree
from torchmpm.boundary import Face
from torchmpm.grid import Grid
from torchmpm.materials.base import broadcast_plane
from torchmpm.materials.body import Body, slices
from torchmpm.materials.linalg import Mat2, Sym2, matmul
from torchmpm.transfer import Stencil

#: Added to the mass of a node before the division, kg, so that an empty node has velocity zero.
MASS_EPSILON = 1e-10

#: The 13 components of a state, (B, N) each, see :meth:`torchmpm.ParticleState.components`.
Components = tuple[Tensor, ...]


@tree.register
@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same during one step, in the form that a substep needs; see :meth:`torchmpm.Solver.scene`.

    Values on nodes are in the order of :meth:`torchmpm.Grid.nodes`, with a leading 1 instead of B where they are the
    same in all simulations.

    Attributes:
        grid: The grid of the solver.
        bodies: Its bodies.
        dt: Duration of a substep, s.
        origin: (B, 2) lower left corner of the window in the world, m.
        mass: (1 or B, N) masses of the particles, kg.
        exists: (1, cells) 1 on the nodes of the window, 0 on the padding.
        gravity: (2, 1 or B, cells) velocity that the nodes gain by gravity in a substep, m/s.
        damping: Factor on the velocities of the nodes in a substep.
        faces: The velocity rules as masks over the nodes, by direction.
        actuation: (2, B, cells) muscle stress on the nodes, Pa; ``None`` without actuation.
    """

    grid: Grid
    bodies: tuple[Body, ...]
    dt: float
    origin: Tensor
    mass: Tensor
    exists: Tensor
    gravity: Tensor
    damping: float
    faces: tuple[Face, ...]
    actuation: Tensor | None


class Scattered(NamedTuple):
    """Result of the first half of a substep."""

    stencil: Stencil
    inside: Tensor  # (B, N) which particles take part
    F: Mat2  # (B, N) each, the returned deformation gradient
    Jp: Tensor  # (B, N) plastic volume ratio
    momentum: Tensor  # (3, B, cells) mass (kg) and momentum (kg m/s) on the nodes


def substep(scene: Scene, state: Components, boundary: Callable[[Scene, Tensor], Tensor]) -> Components:
    """Advance all particles by one substep of MLS-MPM (Hu et al., 2018) with APIC transfers (Jiang et al., 2015).

    This is the substep of the eager backend: deform the particles, evaluate their stress, collect mass and momentum on
    the nodes, apply gravity, damping and the boundary there, and interpolate velocities back to the particles.

    Args:
        scene: What the substeps share, see :meth:`torchmpm.Solver.scene`.
        state: The 13 components of a :class:`torchmpm.ParticleState`, (B, N) each: x, v, C and F, row by row, and Jp.
        boundary: What the surroundings do to the velocities of the nodes, see :meth:`torchmpm.Solver.boundary`.

    Returns:
        The 13 components after the substep, (B, N) each.
    """
    state = _detach_unresolved(scene, state)
    scattered = particles_to_grid(scene, state)
    velocity = boundary(scene, grid_velocity(scene, scattered.momentum))
    v, C = transfer.grid_to_particles(scene.grid, scattered.stencil, velocity)
    x, y = state[:2]
    moved = (x + scene.dt * v[0], y + scene.dt * v[1], *v, *C, *scattered.F, scattered.Jp)
    return tuple(torch.where(scattered.inside, new, old) for new, old in zip(moved, state, strict=True))


def particles_to_grid(scene: Scene, state: Components) -> Scattered:
    """First half of a substep: deform the particles, evaluate their stress, collect mass and momentum on the nodes."""
    x, y, *others = state
    dt, grid = scene.dt, scene.grid
    inside = grid.takes_part(x, y, scene.origin)
    stencil = transfer.stencil(grid, x, y, scene.origin)
    # Particles outside get neutral values: zero times NaN would reach the derivatives of constants that all share.
    neutral = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0)  # v, C, F and Jp at rest
    still = (torch.where(inside, component, number) for component, number in zip(others, neutral, strict=True))
    vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, Jp = still
    trial = matmul((1.0 + dt * c0, dt * c1, dt * c2, 1.0 + dt * c3), (f0, f1, f2, f3))
    F, Jp, stress_momentum = _deform(scene, stencil, inside, trial, Jp)
    momentum = transfer.particles_to_grid(
        grid, stencil, inside.to(x.dtype), (vx, vy), (c0, c1, c2, c3), scene.mass, stress_momentum
    )
    return Scattered(stencil, inside, F, Jp, momentum)


def _deform(scene: Scene, stencil: Stencil, inside: Tensor, trial: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor, Sym2]:
    """Returned deformation gradient, plastic volume ratio and ``-dt V 4/h^2 tau`` of all bodies."""
    parts: list[tuple[Tensor, ...]] = []
    for body, part in slices(scene.bodies):
        a, b, c, d = trial
        before = Jp[:, part]
        F, after = body.material.return_map((a[:, part], b[:, part], c[:, part], d[:, part]), before)
        tau = _stress(scene, body, F, before)
        if body.muscle and scene.actuation is not None:
            pulls = transfer.interpolate(stencil.part(part), scene.actuation)
            ax, ay = (torch.where(inside[:, part], pull, 0.0) for pull in pulls)
            active = muscle_stress(F, (ax, ay))
            tau = (tau[0] + active[0], tau[1] + active[1], tau[2] + active[2])
        factor = -scene.dt * (4.0 / scene.grid.h**2) * broadcast_plane(body.volume, before, "volume")
        parts.append((*F, after, *(factor * component for component in tau)))
    components = zip(*parts, strict=True)
    f0, f1, f2, f3, Jp, xx, xy, yy = (p[0] if len(p) == 1 else torch.cat(p, dim=1) for p in components)
    return (f0, f1, f2, f3), Jp, (xx, xy, yy)


def muscle_stress(F: Mat2, actuation: tuple[Tensor, Tensor]) -> Sym2:
    """Kirchhoff stress F diag(a) F^T (DittoGym, Huang et al., 2024, section 3), (B, N) each, Pa.

    Positive actuation a, Pa, contracts. Its directions turn and stretch with the material.
    """
    a, b, c, d = F
    ax, ay = actuation
    return ax * a * a + ay * b * b, ax * a * c + ay * b * d, ax * c * c + ay * d * d


def grid_velocity(scene: Scene, momentum: Tensor) -> Tensor:
    """Velocity (2, B, cells), m/s, of the nodes before the boundary; zero on the padding."""
    velocity = free_velocity(scene, momentum) + scene.gravity
    return velocity * scene.damping if scene.damping != 1.0 else velocity


def free_velocity(scene: Scene, momentum: Tensor) -> Tensor:
    """Velocity of the nodes before gravity, (2, B, cells), m/s, from mass and momentum (3, B, cells)."""
    return momentum[1:] * (scene.exists / (momentum[0] + MASS_EPSILON))


def _stress(scene: Scene, body: Body, F: Mat2, Jp: Tensor) -> Sym2:
    """Stress of a body's material, whose derivative the material may limit to what a substep resolves."""
    limited = getattr(body.material, "resolved_stress", None)
    if limited is None:
        return body.material.stress(F, Jp)
    with torch.no_grad():
        mass, volume = (broadcast_plane(getattr(body, name), Jp, name) for name in ("mass", "volume"))
        stable = (scene.grid.h / scene.dt) ** 2 * mass / volume
    tau: Sym2 = limited(F, Jp, stable)
    return tau


def _detach_unresolved(scene: Scene, state: Components) -> Components:
    """The same state, cut from the graph where the motion of a material is faster than a substep resolves."""
    masks = []
    for body, part in slices(scene.bodies):
        unresolved = getattr(body.material, "unresolved", None)
        mask = None if unresolved is None else unresolved(tuple(c[:, part].detach() for c in state[4:8]), scene.dt)
        masks.append(mask)
    if all(mask is None for mask in masks):
        return state
    none = [torch.zeros_like(state[0][:, part], dtype=torch.bool) for _, part in slices(scene.bodies)]
    cut = torch.cat([other if mask is None else mask for mask, other in zip(masks, none, strict=True)], dim=1)
    return tuple(torch.where(cut, component.detach(), component) for component in state)
