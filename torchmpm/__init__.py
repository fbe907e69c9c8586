"""Batched, differentiable two-dimensional material point method in PyTorch.

:class:`torchmpm.ParticleState` holds everything that moves. :meth:`torchmpm.Solver.step` takes a state and returns a
new one; the solver is a frozen description of grid, bodies and boundary. ``torchmpm.substep`` is the algorithm,
``torchmpm.materials`` holds the constitutive laws, and ``torchmpm.native`` the same substep as fused kernels. This
package imports torch, NumPy and jaxtyping, and NVIDIA's cuda-core for the kernels on a GPU.
"""

from torchmpm import diagnostics, sampling, tree
from torchmpm.boundary import VelocityRule, fixed
from torchmpm.grid import Grid
from torchmpm.materials import Body, Elastic, Material, Snow, VonMises, lame
from torchmpm.rollout import repeated, trajectory
from torchmpm.solver import Solver
from torchmpm.state import ParticleState

__version__ = "0.1.0"

__all__ = [
    "Body",
    "Elastic",
    "Grid",
    "Material",
    "ParticleState",
    "Snow",
    "Solver",
    "VelocityRule",
    "VonMises",
    "diagnostics",
    "fixed",
    "lame",
    "repeated",
    "sampling",
    "trajectory",
    "tree",
]
