"""Batched, differentiable two-dimensional material point method in PyTorch.

State goes in, state comes out: :class:`ParticleState` holds everything that moves, :class:`Solver` (a frozen
description of grid, bodies and boundary) advances it, and no function keeps a tensor behind.
"""

from torchmpm import diagnostics, sampling, tree
from torchmpm.boundary import VelocityRule, fixed
from torchmpm.grid import Grid
from torchmpm.material import Elastic, Material, Soil, VonMises, lame
from torchmpm.memory import estimate_memory, segment_for
from torchmpm.rollout import repeated, trajectory
from torchmpm.solver import Body, Solver
from torchmpm.state import ParticleState

__version__ = "0.1.0"

__all__ = [
    "Body",
    "Elastic",
    "Grid",
    "Material",
    "ParticleState",
    "Soil",
    "Solver",
    "VelocityRule",
    "VonMises",
    "diagnostics",
    "estimate_memory",
    "fixed",
    "lame",
    "repeated",
    "sampling",
    "segment_for",
    "trajectory",
    "tree",
]
