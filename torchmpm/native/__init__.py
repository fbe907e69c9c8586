"""The substep as fused kernels: in C++ on the CPU (``cpu``), in CUDA C++ on a GPU (``cuda``).

``kernels`` is what the solver calls, with its adjoint, ``tables`` describes a solver to the kernels, and ``library``
compiles and loads C++. All kernels use the names of ``torchmpm.materials`` and ``torchmpm.transfer``.

Both compile the formulas of one particle and one node, and their derivatives, from ``common``. The files of the CPU, in
the order in which they build on each other: ``simd``, ``team``, ``scene``, ``transfer``, ``grid``, ``workspace``,
``step``; the adjoint: ``grid_adjoint``, ``adjoint_block``, ``adjoint``; ``native.cpp`` is the C interface.

There a simulation's particles are cut into blocks of 64, each of one body. One pass over the blocks reads velocities
from the nodes, moves and deforms the particles, and adds mass and momentum to the nodes for the next substep. The sums
of a few groups of blocks are kept apart and added in one order, so results do not depend on the number of threads, nor
on what else is in the batch. The adjoint replays a step from its start onto a tape, then goes back with these passes.
"""
