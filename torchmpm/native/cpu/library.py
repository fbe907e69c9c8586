"""Compiles the kernels on first use, keeps them on disk, and loads them."""

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

_SOURCES = Path(__file__).parent
#: Not -ffast-math: it lets compilers assume that there is no NaN.
_FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fopenmp-simd", "-fPIC", "-shared", "-pthread"),
)
_X86_FLAGS = ("-mprefer-vector-width=512",)
_REAL = {torch.float32: "float", torch.float64: "double"}
#: Completes the message "backend 'native' ...".
NO_COMPILER = "needs a C++ compiler (g++, clang++ or $CXX), found none: use 'eager'"
_logger = logging.getLogger(__name__)
#: Members of ``struct Pool`` in ``team.hpp``.
POOL = ("pool_parallel", "pool_rank", "pool_team_size")


@functools.cache
def thread_pool() -> dict[str, int]:
    """Addresses of the functions through which torch's OpenMP threads are reached; empty if it uses other threads."""
    functions = ("GOMP_parallel", "omp_get_thread_num", "omp_get_num_threads")
    program = ctypes.CDLL(None)
    if not all(hasattr(program, function) for function in functions):
        return {}
    addresses = [ctypes.cast(getattr(program, function), ctypes.c_void_p).value for function in functions]
    return {name: address for name, address in zip(POOL, addresses, strict=True) if address}


def _after_fork() -> None:
    """Reach no threads in a forked process: those of its parent are not there, and waiting for them would never end."""
    thread_pool().clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)


def find_compiler() -> tuple[str, ...] | None:
    """The C++ compiler as a command: ``$CXX`` or else g++, and clang++ where that is not installed."""
    for command in (os.environ.get("CXX") or "g++", "clang++"):
        try:
            words = tuple(shlex.split(command))
        except ValueError:  # a quotation that does not end
            continue
        if words and shutil.which(words[0]) is not None:
            return words
    return None


def cache_folder() -> str:
    """Where compiled kernels are kept: ``$XDG_CACHE_HOME/torchmpm``, else in the system's folder for caches."""
    usual = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}.get(sys.platform, "~/.cache")
    return os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(usual), "torchmpm")


def load(dtype: torch.dtype) -> ctypes.CDLL:
    """The compiled kernels for a dtype, see :func:`build`."""
    return build(_SOURCES / "native.cpp", f"-DTORCHMPM_REAL={_REAL[dtype]}")


@functools.cache
def build(source: Path, *options: str) -> ctypes.CDLL:
    """Compile a C++ file, which may include the headers of this folder and of its own, and load it.

    The first call on a machine takes some seconds; later processes find the library in :func:`cache_folder`, if that
    can be written. Raises a ValueError where there is no compiler, or it failed; the message holds what it said.
    """
    found = _load(source, options, cache_folder(), os.environ.get("CXX"), os.environ.get("PATH"))
    if isinstance(found, str):
        raise ValueError(f"backend 'native' {found}")
    return found


@functools.cache
def _load(source: Path, options: tuple[str, ...], folder: str, *_: str | None) -> ctypes.CDLL | str:
    """Find or build the library; returns a failure as text, so that it is not tried again in this process."""
    compiler = find_compiler()
    if compiler is None:
        return NO_COMPILER
    flags = [*_FLAGS, *(_X86_FLAGS if platform.machine() in ("x86_64", "AMD64") else ()), *options, f"-I{_SOURCES}"]
    command = [*compiler, *flags, str(source), "-o"]
    path = Path(folder) / f"{source.stem}-{_key(command, source.parent)}.so"
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        pass  # not there yet, or damaged
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        scratch = tempfile.TemporaryDirectory(dir=path.parent)
    except OSError as error:
        _logger.info("compiled kernels cannot be kept in %s (%s)", folder, error)
        path, scratch = Path(), tempfile.TemporaryDirectory()
    with scratch:
        fresh = Path(scratch.name) / "fresh.so"
        _logger.info("compiling %s with %s (once on this machine, some seconds)", source.name, compiler[0])
        done = subprocess.run([*command, str(fresh)], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            failure = f"{shlex.join(command)} failed with code {done.returncode}:\n{done.stderr[-4000:]}"
            return f"could not be built: {failure}"
        if path.name:
            os.replace(fresh, path)  # atomic: another process may build at the same time
            fresh = path
        try:
            return ctypes.CDLL(str(fresh))
        except OSError as error:
            return f"could not be built: the compiled library does not load: {error}"


def _key(command: list[str], folder: Path) -> str:
    """Hash of the sources, the command, the compiler and the processor it compiles for."""
    compiler = Path(shutil.which(command[0]) or command[0])
    facts = [*command[:-2], f"{compiler.resolve()} {compiler.stat().st_mtime_ns}", processor()]
    digest = hashlib.sha256("\n".join(facts).encode())
    for source in sorted(file for place in {folder, _SOURCES} for file in place.glob("*.[ch]pp")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:24]


def processor() -> str:
    """Model and instruction sets, because kernels compiled for one processor may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    facts = {line.partition(":")[0].strip(): line for line in reversed(lines)}
    return "\n".join(facts.get(name, "") for name in ("model name", "flags", "Features"))
