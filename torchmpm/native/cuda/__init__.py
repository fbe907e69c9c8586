"""The kernels in CUDA C++, for tensors on a GPU; ``launcher`` is what :mod:`torchmpm.native.kernels` calls there.

``forward.cu`` and ``adjoint.cu`` hold the kernels, with the formulas of ``native/common``, which the CPU compiles too.
``arguments`` is what they take, ``compiler`` compiles them with NVRTC, ``plan`` decides which are launched on how
many blocks, and ``launcher`` does it through ``driver``.

A block of threads takes one simulation through all substeps of a step in one launch: particles stay in registers, and
the nodes around them in shared memory. Simulations that do not fit there are taken by several blocks each, with the
nodes in global memory; so are a few large ones. Masses and momenta are added as integers, so that their order makes no
difference: forward results are the same in every run.
"""
