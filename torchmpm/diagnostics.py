"""What is in the window, and balances of a simulation: mass, momentum and energy.

All functions raise a TypeError for anything but a solver and a state, and a ValueError for a state with another number
of particles than the solver's bodies.
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
    """Which particles are in the window, whose lower left corner is at ``origin`` (B, 2), m, and move; (B, N) bool."""
    checks.instance("solver", solver, Solver)
    at = solver.check_arguments(state, None, origin)
    return solver.grid.takes_part(state.x[..., 0], state.x[..., 1], at)


def masses(solver: Solver, state: ParticleState) -> Tensor:
    """Mass of every particle, (B, N), kg."""
    _check(solver, state)
    return per_particle(solver.bodies, "mass", state.Jp) * torch.ones_like(state.Jp)


def mass(solver: Solver, state: ParticleState) -> Tensor:
    """Total mass, (B,), kg."""
    return masses(solver, state).sum(-1)


def momentum(solver: Solver, state: ParticleState) -> Tensor:
    """Linear momentum, (B, 2), kg m/s."""
    return (masses(solver, state)[..., None] * state.v).sum(1)


def angular_momentum(solver: Solver, state: ParticleState) -> Tensor:
    """Angular momentum about the world's origin, (B,), kg m^2/s, with the spin in the affine matrices (h^2/4 each)."""
    mass = masses(solver, state)
    orbit = state.x[..., 0] * state.v[..., 1] - state.x[..., 1] * state.v[..., 0]
    spin = 0.25 * solver.grid.h**2 * (state.C[..., 1, 0] - state.C[..., 0, 1])
    return (mass * (orbit + spin)).sum(-1)


def kinetic_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Energy of motion of the particles, without the affine part, (B,), J."""
    return 0.5 * (masses(solver, state) * state.v.square().sum(-1)).sum(-1)


def elastic_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Energy stored in deformation, (B,), J; muscles are not counted."""
    _check(solver, state)
    total = torch.zeros_like(state.Jp[:, 0])
    for body, part in slices(solver.bodies):
        (a, b, c, d), Jp = state.F[:, part].flatten(-2).unbind(-1), state.Jp[:, part]
        total = total + (broadcast_plane(body.volume, Jp, "volume") * body.material.energy((a, b, c, d), Jp)).sum(-1)
    return total


def potential_energy(solver: Solver, state: ParticleState) -> Tensor:
    """Energy of position under gravity relative to the world's origin, (B,), J."""
    mass = masses(solver, state)
    gravity = torch.as_tensor(solver.gravity, dtype=state.dtype, device=state.device).reshape(-1, 1, 2)
    return -(mass * (state.x * gravity).sum(-1)).sum(-1)


def impulses(
    solver: Solver, state: ParticleState, actuation: Tensor | None = None, origin: Tensor | None = None
) -> dict[str, Tensor]:
    """Momentum that each external influence adds in the substep that starts at ``state``.

    Args:
        solver: The solver.
        state: Where the substep starts.
        actuation: (B, 2, G, G), Pa, as in :meth:`torchmpm.Solver.step`.
        origin: (B, 2), m, as in :meth:`torchmpm.Solver.step`.

    Returns:
        ``"gravity"``, ``"damping"`` and ``"boundary"``, each (B, 2), kg m/s. Their sum is the change of
        :func:`momentum` over the substep while all particles are more than a cell from the ends of the window, but for
        the 1e-10 kg that are added to the mass of a node. Internal forces and muscles cancel.
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
