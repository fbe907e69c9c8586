"""What the launcher asks of a GPU, recorded by drivers that launch nothing."""

import ctypes
import importlib.metadata
import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cuda_drivers import H100, RTX_4090, Recorded, Recorder, in_use
from device_operators import DeviceOperators
from scenes import lively, robot
from torch import Tensor

from torchmpm import Grid, ParticleState, Solver, backends
from torchmpm.native import kernels
from torchmpm.native.cuda import compiler, launcher, plan
from torchmpm.native.cuda.arguments import Arguments, Kernel
from torchmpm.native.cuda.driver import Card, Launch
from torchmpm.solver import kernels_fail


def window(count: int, **options: object) -> Solver:
    """A robot of some particles on as many nodes as in the tasks."""
    return robot(count, grid=Grid(128), backend="native", **options)


def launches(
    solver: Solver, batch: int = 1, *, dtype: torch.dtype = torch.float32, card: Card = H100, blocks: int = 1
) -> list[Recorded]:
    """Of a step with a field."""
    state, nodes = lively(solver.num_particles, batch).to(dtype), solver.grid.resolution
    with in_use(Recorder(card, blocks)) as driver, torch.no_grad():
        solver.step(state, torch.zeros(batch, 2, nodes, nodes, dtype=dtype), substeps=100)
    return driver.launches


#: Robots and their particles, a card, blocks that each of its multiprocessors can run; and what is launched: whether
#: nodes are in shared memory, the blocks, those that share a robot, and the particles that a thread keeps.
LAUNCHES = {
    "small robots take a block each, others a team": (
        64,
        2000,
        H100,
        1,
        [(True, 64, 1, 4), (False, 128, 2, 0)],
    ),
    "many robots take turns": (1024, 2000, H100, 1, [(True, 132, 1, 4), (False, 132, 2, 0)]),
    "many robots take turns on twice the blocks": (1024, 2000, H100, 2, [(True, 264, 1, 4), (False, 264, 2, 0)]),
    "a large robot takes all threads that it needs": (1, 22_000, H100, 1, [(False, 86, 86, 1)]),
    "many large robots take a block each": (64, 22_000, H100, 1, [(True, 64, 1, 0), (False, 132, 22, 0)]),
    "a robot with more particles than a card has threads": (1, 22_000, Card(16, 101_376), 1, [(False, 16, 16, 0)]),
}


@pytest.mark.parametrize(("batch", "count", "card", "blocks", "expected"), LAUNCHES.values(), ids=LAUNCHES)
def test_launches(batch: int, count: int, card: Card, blocks: int, expected: list[tuple[bool, int, int, int]]) -> None:
    """Blocks that share a robot are launched together, and find those that were given up in the status."""
    found = launches(window(count), batch, card=card, blocks=blocks)
    for one, (shared, all_blocks, team, per_thread) in zip(found, expected, strict=True):
        assert (one.kernel.shared, one.launch.cooperative) == (shared, not shared)
        assert (one.launch.blocks, one.arguments.team, one.kernel.per_thread) == (all_blocks, team, per_thread)
        rows, columns = one.arguments.rows, one.arguments.columns
        assert one.launch.threads == one.kernel.threads == (512 if shared else 256)
        assert one.launch.shared_bytes == one.kernel.shared_bytes(rows, columns, 1, 1) <= card.shared_bytes
        assert rows == columns and (plan.SMALLEST_WINDOW < rows if shared else rows == Grid(128).width)
    assert len({one.arguments.status for one in found}) == len({one.arguments.result for one in found}) == 1
    assert (found[0].arguments.status is None) == (len(found) == 1)


@pytest.mark.parametrize("card", [H100, RTX_4090])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_windows_are_as_large_as_the_memory_of_a_block(card: Card, dtype: torch.dtype) -> None:
    first, second = launches(window(2000), dtype=dtype, card=card)
    side, node = first.arguments.rows, first.kernel.node_bytes
    assert first.kernel.shared and not second.kernel.shared and first.arguments.columns == side
    assert first.launch.shared_bytes <= card.shared_bytes < first.launch.shared_bytes + 2 * (side + 1) * node


def test_a_card_that_cannot_run_a_block() -> None:
    with pytest.raises(ValueError, match="the card cannot run a block of 256 threads"):
        launches(window(22_000), card=Card(1, 100))


def test_kernels_are_those_of_the_scene() -> None:
    first, _ = launches(window(2000))
    assert (first.kernel.real, first.kernel.kinds, first.kernel.muscles) == ("float", 2, True)
    with in_use(Recorder()) as driver, torch.no_grad():
        window(2000).step(lively(2000), substeps=1)
    assert (driver.launches[0].kernel.real, driver.launches[0].kernel.muscles) == ("double", False)


def test_a_second_step_copies_nothing_to_the_device() -> None:
    """It only makes room for results and scratch memory, and sets counters to zero."""
    state, solver = lively(50), window(50)
    with in_use(Recorder()), torch.no_grad():
        solver.step(state)
        with DeviceOperators() as seen:
            solver.step(state)
    assert not seen.waits


def test_too_little_memory_means_fewer_robots_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Down to one; if there is none for that, the error says what it needs."""
    free, empty = 10**8, torch.empty

    def limited(*shape: object, **options: object) -> Tensor:
        if options.get("dtype") is torch.uint8 and shape[0] > free:  # type: ignore[operator]
            raise torch.OutOfMemoryError("CUDA out of memory")
        return empty(*shape, **options)  # type: ignore[call-overload]

    solver, field = window(2000), torch.zeros(200, 2, 128, 128, requires_grad=True)
    with in_use(Recorder()) as driver:
        end = solver.step(lively(2000, 200).to(torch.float32), field, substeps=100)
        monkeypatch.setattr(launcher.torch, "empty", limited)
        torch.autograd.grad(end.x.sum(), field, retain_graph=True)
        for one in driver.launches[2:]:
            teams = one.launch.blocks // one.arguments.team
            assert 1 <= teams < 132 and teams * one.arguments.scratch_bytes <= free
        free = 10**6
        with pytest.raises(torch.OutOfMemoryError, match=r"backend 'native' is out of memory: a robot needs 0\.\d+ GB"):
            torch.autograd.grad(end.x.sum(), field)


needs_bindings = pytest.mark.skipif(importlib.util.find_spec("cuda") is None, reason="no cuda-core and cuda-bindings")

PROGRAM = """
import contextlib, types
import torch
from torchmpm.native.cuda.arguments import Arguments
from torchmpm.native.cuda.driver import Cuda, Launch

torch.cuda.device = lambda device: contextlib.nullcontext()
torch.cuda.current_stream = lambda device: types.SimpleNamespace(cuda_stream=0xABC)
driver, device = Cuda(), torch.device("cuda", 1)
print(*driver.card(device), flush=True)
function = driver.function(b"a binary", "torchmpm_forward", device)
print(driver.resident(function, 512, 65000, device), flush=True)
for launch in (Launch(6, 512, 65000), Launch(8, 256, 4096, cooperative=True), Launch(13, 512)):
    driver.launch(function, launch, Arguments(batch=5, particles=77), device)
"""


@needs_bindings
def test_what_reaches_the_driver_library(tmp_path: Path) -> None:
    """Through NVIDIA's bindings: sizes, attributes, the stream, the struct by value, and what an error becomes."""
    library, here = tmp_path / "libcuda.so.1", Path(__file__).parent
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, here / "libcuda.c", "-ldl"], check=True)
    path = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "LD_LIBRARY_PATH": str(tmp_path), "PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert done.stdout.splitlines() == [
        "132 232448",
        "load a binary",
        "kernel torchmpm_forward of 0x10",
        "attribute 8 of 0x20 on 1: 231424",
        "context 0x101",
        "occupancy of 0x20: 512, 65000",
        "264",
        "launch 0x20: 6 1 1, 512 1 1, 65000 bytes, stream 0xabc, batch 5, particles 77",
        "together 0x20: 8 1 1, 256 1 1, 4096 bytes, stream 0xabc, batch 5, particles 77",
        "launch 0x20: 13 1 1, 512 1 1, 0 bytes, stream 0xabc, batch 5, particles 77",
    ], done.stderr
    assert done.stderr.endswith("CUDA error: CUDA_ERROR_ILLEGAL_ADDRESS: an illegal memory access was encountered\n")


@pytest.mark.parametrize(
    ("cuda", "versions", "reason"),
    [
        (None, {}, "is not built for CUDA"),
        ("13.0", {}, "needs cuda-core, which is not installed: pip install 'torchmpm[cuda13]'"),
        ("12.8", {"cuda-core": "1"}, "needs cuda-bindings, which is not installed: pip install 'torchmpm[cuda12]'"),
        ("12.8", {"cuda-core": "1", "cuda-bindings": "13.0.1"}, "CUDA 12.8, but cuda-bindings is 13.0.1: pip install"),
        ("13.0", {"cuda-core": "1", "cuda-bindings": "13.0.1"}, None),
    ],
)
def test_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, cuda: str | None, versions: dict[str, str], reason: str | None
) -> None:
    def version(name: str) -> str:
        if name not in versions:
            raise importlib.metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(importlib.metadata, "version", version)
    found = compiler.missing(cuda)
    assert found is None if reason is None else reason in str(found)


KERNEL = Kernel(False, True, "float", 512, 4, 2, True)


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[str, str]]:
    """What NVRTC was asked for: architectures, and the precision."""
    asked: list[tuple[str, str]] = []

    def compile_source(text: str, arch: str, macros: dict[str, str], **_: object) -> bytes:
        asked.append((arch, macros["TORCHMPM_REAL"]))
        return f"binary {len(asked)}".encode()

    monkeypatch.setattr(compiler, "compile_source", compile_source)
    monkeypatch.setattr(compiler, "_versions", lambda: (1, 13, 0))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return asked


def test_a_kernel_is_compiled_once(
    compiled: list[tuple[str, str]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """For each architecture, each variant, each version of the compiler and each state of the sources."""
    for _ in range(2):
        assert compiler.compile_kernel(KERNEL, "sm_90") == b"binary 1"
        assert compiler.compile_kernel(KERNEL, "sm_80") == b"binary 2"
        assert compiler.compile_kernel(KERNEL._replace(real="double"), "sm_90") == b"binary 3"
    monkeypatch.setattr(compiler, "_versions", lambda: (1, 13, 1))
    assert compiler.compile_kernel(KERNEL, "sm_90") == b"binary 4"
    monkeypatch.setattr(compiler, "digest_of_sources", lambda folder: "others")
    assert compiler.compile_kernel(KERNEL, "sm_90") == b"binary 5"
    assert len(list((tmp_path / "torchmpm").glob("torchmpm_forward-sm_*.cubin"))) == 5
    assert len(list((tmp_path / "torchmpm").iterdir())) == 5


def test_a_damaged_kernel_is_compiled_again(compiled: list[tuple[str, str]], tmp_path: Path) -> None:
    assert compiler.compile_kernel(KERNEL, "sm_90") == b"binary 1"
    (file,) = (tmp_path / "torchmpm").iterdir()
    file.write_bytes(b"bin")
    assert [compiler.compile_kernel(KERNEL, "sm_90") for _ in range(2)] == [b"binary 2"] * 2


@needs_bindings
def test_an_error_of_the_compiler_is_shown() -> None:
    with pytest.raises(ValueError, match=r"(?s)cannot be compiled for sm_90: .*broken"):
        compiler.compile_source("broken", "sm_90", {})


@needs_bindings
@pytest.mark.slow
@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("adjoint", [False, True])
def test_kernels_compile(adjoint: bool, shared: bool) -> None:
    """For the oldest card; `make cuda-kernels` compiles all for all."""
    kernel = Kernel(adjoint, shared, "float", 256, 2, 7, True)
    assert compiler.compile_source(compiler.source_of(kernel), "sm_80", kernel.macros).startswith(b"\x7fELF")


def test_an_old_card(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "missing", lambda cuda: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (7, 5))
    compiler.unavailable.cache_clear()
    reason = compiler.unavailable(torch.device("cuda", 0))
    compiler.unavailable.cache_clear()
    assert reason == "on CUDA it needs a card of compute capability 8.0 or newer, cuda:0 has 7.5"


def test_kernels_that_differ_or_fail_are_not_chosen() -> None:
    """The check of a device says which number differed, or what went wrong; here nothing is computed at all."""
    device = torch.device("cpu")
    kernels_fail.cache_clear()
    assert kernels_fail(device) is None  # the kernels of the CPU
    kernels_fail.cache_clear()
    with in_use(Zeros()):
        reason = kernels_fail(device)
    assert reason == "its kernels were tried on cpu, and x differed by 1.0e+00 from that of eager"
    kernels_fail.cache_clear()
    with in_use(Recorder(Card(1, 100))):
        assert "and failed: the card cannot run a block" in str(kernels_fail(device))
    kernels_fail.cache_clear()


class Zeros(Recorder):
    """Writes zeros as results."""

    def launch(self, function: Kernel, launch: Launch, arguments: Arguments, device: torch.device) -> None:
        if arguments.result:
            ctypes.memset(arguments.result, 0, 4 * 13 * arguments.batch * arguments.particles)


@pytest.mark.parametrize("reason", [None, "x differed"])
def test_auto_on_a_gpu_follows_the_check(
    reason: str | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """And says why it is eager; whoever asks for the kernels gets them without it."""
    asked: list[tuple[torch.device, torch.dtype]] = []
    monkeypatch.setattr(ParticleState, "device", torch.device("cuda", 0))
    monkeypatch.setattr(kernels, "unavailable", lambda device: None)
    monkeypatch.setattr("torchmpm.solver.kernels_fail", lambda *of: asked.append(of) or reason)
    backends.warn_eager.cache_clear()
    state, solver = lively(5), robot(5, backend="auto")
    assert replace(solver, backend="native").runs_native(state) and not asked
    assert solver.runs_native(state) == (reason is None) and asked == [(torch.device("cuda", 0), torch.float64)]
    said = [record.message for record in caplog.records if record.name == "torchmpm.backends"]
    assert not said if reason is None else "operator by operator" in said[0] and reason in said[0]


def test_an_unavailable_gpu_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ParticleState, "device", torch.device("cuda", 0))
    monkeypatch.setattr(kernels, "unavailable", lambda device: "on CUDA it needs cuda-core")
    with pytest.raises(ValueError, match="backend 'native' cannot run this: on CUDA it needs cuda-core; use 'eager'"):
        robot(5, backend="native").runs_native(lively(5))
