"""The substep as fused kernels: in C++ on the CPU (``cpu``) and in CUDA C++ on a GPU (``cuda``).

``kernels`` is what the solver calls, with operators of torch and their adjoint, ``tables`` describes a solver to the
kernels. Both sets of kernels use the names of ``torchmpm.materials`` and ``torchmpm.transfer``.
"""
