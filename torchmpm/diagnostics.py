"""Which particles are simulated, and mass, momentum and energy of each simulation.

Sums run over all N particles of a simulation, also those outside the window. All functions raise a TypeError if
``solver`` is not a :class:`torchmpm.Solver` or ``state`` not a :class:`torchmpm.ParticleState`, and a ValueError if the
state has another number of particles than the solver's bodies, or the solver's gravity another B than the state.
"""

import torch
from torch import Tensor

from torchmpm import checks
from torchmpm.materials.base import broadcast_plane
from torchmpm.materials.body import per_particle, slices
from torchmpm.solver import Solver
from torchmpm.state import ParticleState
from torchmpm.substep import free_velocity, grid_velocity, particles_to_grid


def inside(solver: Solver, state: ParticleState, origin: Tensor | None = None) -> Tensor:
    """Return which particles lie in the window and are simulated.

    Args:
        solver: The solver.
        state: The state.
        origin: (B, 2) lower left corner of the window in the world, m; ``None`` stands for (0, 0).

    Returns:
        (B, N) bool.

    Raises:
        ValueError: ``origin`` has another shape, dtype or device than goes with the state.
        TypeError: ``origin`` is not a tensor.
    """
    checks.instance("solver", solver, Solver)
    at = solver.check_arguments(state, None, origin)
    return solver.grid.takes_part(state.x[..., 0], state.x[..., 1], at)


def masses(solver: Solver, state: ParticleState) -> Tensor:
    """Return the mass of every particle, (B, N), kg."""
    _check(solver, state)
    return per_particle(solver.bodies, "mass", state.Jp) * torch.ones_like(state.Jp)


def mass(solver: Solver, state: ParticleState) -> Tensor:
    """Return the total mass of each simulation, (B,), kg."""
    return masses(solver, state).sum(-1)


def momentum(solver: Solver, state: ParticleState) -> Tensor:
    """Return the linear momentum, the sum of ``m v`` over the particles, (B, 2), kg m/s."""
    return (masses(solver, state)[..., None] * state.v).sum(1)


def angular_momentum(solver: Solver, state: ParticleState) -> Tensor:
    """Return the angular momentum about the world's origin, (B,), kg m^2/s, positive counterclockwise.

    It is the sum of ``m (x v_y - y v_x + h^2/4 (C_yx - C_xy))`` over the particles: APIC keeps a spin in the affine
    matrices, in which h^2/4 is the moment of quadratic B-splines (Jiang et al., 2015).
    """
    mass = masses(solver, state)
    orbit = state.x[..., 0] * state.v[..., 1] - state.x[..., 1] * state.v[..., 0]
    spin = 0.25 * solver.grid.h**2 * (state.C[..., 1, 0] - state.C[..., 0, 1])
    return (mass * (orbit + spin)).sum(-1)


def kinetic_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Return the kinetic energy, the sum of ``m |v|^2 / 2`` over the particles, (B,), J; C does not count."""
    return 0.5 * (masses(solver, state) * state.v.square().sum(-1)).sum(-1)


def elastic_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Return the energy stored in elastic deformation, (B,), J.

    It is the sum of :meth:`torchmpm.Material.energy` times the undeformed volume over the particles; muscles do not
    count.
    """
    _check(solver, state)
    total = torch.zeros_like(state.Jp[:, 0])
    for body, part in slices(solver.bodies):
        (a, b, c, d), Jp = state.F[:, part].flatten(-2).unbind(-1), state.Jp[:, part]
        total = total + (broadcast_plane(body.volume, Jp, "volume") * body.material.energy((a, b, c, d), Jp)).sum(-1)
    return total


def potential_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Return the potential energy under gravity g, the sum of ``-m g . x`` over the particles, (B,), J."""
    mass = masses(solver, state)
    gravity = torch.as_tensor(solver.gravity, dtype=state.dtype, device=state.device).reshape(-1, 1, 2)
    return -(mass * (state.x * gravity).sum(-1)).sum(-1)


def impulses(
    solver: Solver, state: ParticleState, actuation: Tensor | None = None, origin: Tensor | None = None
) -> dict[str, Tensor]:
    """Return the momentum that each external influence adds in one substep.

    Args:
        solver: The solver.
        state: The state at the start of the substep.
        actuation: (B, 2, G, G) muscle stress, Pa, as in :meth:`torchmpm.Solver.step`.
        origin: (B, 2) lower left corner of the window, m, as in :meth:`torchmpm.Solver.step`.

    Returns:
        Momenta ``"gravity"``, ``"damping"`` and ``"boundary"``, (B, 2) each, kg m/s. While all particles are more than
        a cell away from the ends of the window, their sum is the change of :func:`momentum` over the substep, except
        for the effect of the 1e-10 kg that are added to the mass of each node. Internal forces and muscles cancel out.

    Raises:
        ValueError: ``actuation`` or ``origin`` has another shape, dtype or device than goes with the state.
        TypeError: ``actuation`` or ``origin`` is not a tensor.
    """
    checks.instance("solver", solver, Solver)
    scene = solver.scene(state, actuation, solver.check_arguments(state, actuation, origin))
    momentum = particles_to_grid(scene, state.components()).momentum
    before, damped = free_velocity(scene, momentum), grid_velocity(scene, momentum)
    accelerated, after = before + scene.gravity, solver.boundary(scene, damped)
    stages = {"gravity": (before, accelerated), "damping": (accelerated, damped), "boundary": (damped, after)}
    return {name: (momentum[0] * (new - old)).sum(-1).T for name, (old, new) in stages.items()}


def _check(solver: Solver, state: ParticleState) -> None:
    checks.instance("solver", solver, Solver)
    solver.check_state(state)
