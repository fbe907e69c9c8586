"""The substep as fused kernels: in C++ on the CPU (``cpu``) and in Triton on CUDA (``cuda``).

``kernels`` is what the solver calls, ``tables`` describes a solver to the kernels, ``operator`` makes them operators of
torch with an adjoint. Both sets of kernels use the names of ``torchmpm.materials`` and ``torchmpm.transfer``.
"""
