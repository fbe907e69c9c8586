"""The CUDA kernel of the observation, on the imitation of a GPU that the tests of the physics have."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from test_native_picture import lost, scene
from tiny import TASKS, tiny
from torch import Tensor

import dittogym
from dittogym import cuda_picture
from dittogym.observation import cuda_drawing
from torchmpm.native.cuda import compiler
from torchmpm.native.cuda.compiler import FOLDERS
from torchmpm.native.cuda.driver import Launch
from torchmpm.native.library import build, find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
HERE = Path(__file__).resolve().parent
IMITATION = HERE.parent / "torchmpm" / "imitation"
SOURCE = Path(cuda_picture.Kernel.source)
CPU = torch.device("cpu")
THREADS = 32


@functools.cache
def library(kernel: cuda_picture.Kernel) -> ctypes.CDLL:
    folders = (*FOLDERS, IMITATION, SOURCE.parent)
    digest = hashlib.sha256(compiler.digest_of_sources(SOURCE.parent).encode())
    for file in sorted(IMITATION.glob("*.[ch]*")):
        digest.update(file.read_bytes())
    named = kernel.macros | {"TORCHMPM_THREADS": str(THREADS), "DIGEST": digest.hexdigest()[:16]}
    options = [*(f"-D{name}={value}" for name, value in named.items()), *(f"-I{folder}" for folder in folders)]
    return build(HERE / "picture_imitation.cpp", "-O1", *options)


@dataclass(frozen=True)
class Gpu:
    """A driver whose device is the CPU, with blocks of few threads, and what is broken about it."""

    seed: int = 0  # of the order of threads
    barrier: int = -1  # the one that is missing, and the operation that is not atomic, in the order of picture.cu
    atomic: int = -1

    def load(self, kernel: cuda_picture.Kernel, device: torch.device) -> ctypes.CDLL:
        return library(kernel)

    def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
        assert launch.shared_bytes <= 99 * 1024, "more than a block of an RTX 4090 has"
        missing = -1 if self.barrier < 0 else function.barriers() + self.barrier
        plain = -1 if self.atomic < 0 else function.atomics() + self.atomic
        size = ctypes.c_size_t(launch.shared_bytes), ctypes.c_uint64(self.seed)
        outcome = function.launch(ctypes.byref(arguments), launch.blocks, *size, missing, plain)
        assert outcome == 0, f"the launch ended with {outcome}"


def draw(env: dittogym.TorchEnv, gpu: Gpu | None = None) -> Tensor:
    """The present observation by the kernel."""
    state = env.env_state
    arrays = state.particles.x, state.particles.v, state.origin, state.centre
    return cuda_drawing(env.model.camera, env.dtype, CPU, gpu or Gpu())(*arrays)


@pytest.mark.parametrize("pixels", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_equals_torch(task: str, pixels: bool) -> None:
    """Sums are rounded elsewhere: in one of a thousand pixels a byte may be one off."""
    for dtype in ("float32", "float64") if task in ("run", "dig") else ("float32",):
        env = scene(task, pixels, dtype=dtype)
        state = env.env_state
        plain = env.model.camera.draw(state.particles.x, state.particles.v, state.origin, state.centre)
        difference = (draw(env).int() - plain.int()).abs()
        assert len(plain.unique()) > 20 and difference.max() <= 1
        assert (difference > 0).double().mean() <= 1e-3


@pytest.mark.parametrize("pixels", [False, True])
def test_what_is_not_drawn(pixels: bool) -> None:
    """A robot that is nowhere harms no other."""
    env = lost(scene("kick", pixels, 3))
    state = env.env_state
    state.centre[2] = math.nan
    plain = env.model.camera.draw(state.particles.x, state.particles.v, state.origin, state.centre)
    assert (draw(env)[:2].int() - plain[:2].int()).abs().max() <= 1


@pytest.mark.parametrize("pixels", [False, True])
def test_order_of_threads_makes_no_difference(pixels: bool) -> None:
    env = scene("dig", pixels, dtype="float32")
    first = draw(env)
    for seed in range(1, 4):
        assert torch.equal(draw(env, Gpu(seed)), first)


@pytest.mark.parametrize(
    "pixels, broken",
    [
        *((pixels, {"barrier": barrier}) for pixels in (False, True) for barrier in (0, 1)),
        *((False, {"atomic": 0}), (True, {"atomic": 1})),
    ],
)
def test_barriers_and_atomic_operations_are_needed(pixels: bool, broken: dict[str, int]) -> None:
    """Without one of them, some order of the threads draws something else."""
    env = scene("dig", pixels, dtype="float32")
    expected = draw(env)

    def noticed(seed: int) -> bool:
        try:
            return not torch.equal(draw(env, Gpu(seed, **broken)), expected)
        except ValueError:  # already when it was tried against torch
            return True

    assert any(map(noticed, range(20)))


@pytest.mark.skipif(importlib.util.find_spec("cuda") is None, reason="no cuda-core")
@pytest.mark.slow
@pytest.mark.parametrize("arch", ["sm_80", "sm_89", "sm_90", "sm_120"])
def test_it_compiles(arch: str) -> None:
    kernel = cuda_picture.Kernel.of(torch.float32)
    folder = compiler.path_of(kernel).parent
    binary = compiler.compile_source(compiler.source_of(kernel), arch, kernel.macros, folder=folder)
    assert binary.startswith(b"\x7fELF")


def test_a_kernel_that_draws_something_else_is_not_used() -> None:
    class Idle(Gpu):
        def launch(self, function: Any, launch: Launch, arguments: ctypes.Structure, device: torch.device) -> None:
            ctypes.memset(arguments.image, 0, 12288 * arguments.batch)

    camera = tiny("run").model.camera
    with pytest.raises(ValueError, match="a pixel differed by"):
        cuda_drawing(camera, torch.float32, CPU, Idle())


@pytest.mark.parametrize("changed", ["picture.cu", "picture.hpp"])
def test_a_change_of_a_source_makes_another_kernel(
    changed: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiled: list[Path] = []
    for name in ("picture.cu", "picture.hpp"):
        shutil.copy(SOURCE.with_name(name), tmp_path)
    monkeypatch.setattr(cuda_picture.Kernel, "source", str(tmp_path / "picture.cu"))
    monkeypatch.setattr(compiler, "compile_source", lambda *_, folder: compiled.append(folder) or b"binary")
    monkeypatch.setattr(compiler, "_versions", lambda: (1, 13, 0))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    kernel = cuda_picture.Kernel.of(torch.float32)
    for count in (1, 1, 2):
        if count == 2:
            with (tmp_path / changed).open("a") as file:
                file.write("// changed")
        compiler.compile_kernel(kernel, "sm_90")
        assert compiled == [tmp_path] * count
