"""The CUDA kernels pass Triton's compiler, for GPUs that need not be there."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="no Triton")]

#: Runs programs on the CPU with a launch that only compiles, once for each variant, and prints what it compiled.
PROGRAM = """
import sys
from dataclasses import replace
sys.path.insert(0, "tests/torchmpm")
import torch, triton
from native_scenes import moving, solvers
from torchmpm.native import kernels, cuda
from torchmpm.native.cuda import programs
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

TYPES = {torch.float32: "*fp32", torch.float64: "*fp64", torch.int32: "*i32", torch.int64: "*i64"}
seen = set()

def compile_only(kernel, count, *arguments, **constants):
    constants["BLOCK"] = programs.BLOCK
    types = [TYPES[a.dtype] if isinstance(a, torch.Tensor) else "i32" for a in arguments]
    signature = dict(zip(kernel.arg_names, types)) | dict.fromkeys(constants, "constexpr")
    key = (kernel.fn.__name__, tuple(signature.items()), tuple(constants.items()))
    if key not in seen:
        seen.add(key)
        source = ASTSource(kernel, {n: signature[n] for n in kernel.arg_names}, constants)
        options = {"num_warps": programs.BLOCK // 32, "enable_fp_fusion": True}
        done = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options)
        assert done.asm["cubin"]
        print(kernel.fn.__name__, flush=True)

programs.launch = compile_only
for name, dtype in (("tensor values", torch.float32), ("soil", torch.float64), ("von Mises", torch.float64)):
    calls = []
    kernels.native_step = lambda *arguments: calls.append(arguments) or arguments[0]
    state, field, origin = (t.to(dtype) for t in moving(6, 2))
    solver = replace(solvers(6, 2)[name], backend="native")
    solver.step(state, field, substeps=3, origin=origin)
    ((*tensors, handle, substeps),) = calls
    cuda.forward(*tensors, handle, substeps)
    cuda.backward(*tensors, tensors[0], handle, substeps, True, name == "tensor values")
"""


def test_every_kernel_compiles(tmp_path: Path) -> None:
    """In single precision, and but for elastic bodies in double."""
    root = Path(__file__).resolve().parents[2]
    environment = {
        **os.environ,
        "TRITON_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(root), *sys.path]),
    }
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    kernels = {"rule_codes", "particles_pass", "node_velocities", "begin_adjoint", "node_adjoint", "finish_adjoint"}
    assert set(done.stdout.split()) == kernels
