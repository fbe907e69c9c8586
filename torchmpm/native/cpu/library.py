"""Loads the kernels that came with the package, or compiles them on first use and keeps them on disk."""

import ctypes
import functools
import logging
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import torch

from torchmpm.native.cpu import compiler

#: Completes the message "backend 'native' ...".
NO_COMPILER = (
    "does not run on Windows, except in WSL: use 'eager'"
    if sys.platform == "win32"
    else "needs a C++ compiler (g++, clang++ or $CXX), found none: use 'eager'"
)
#: Classes of x86 processors that a wheel has kernels for, by the names that torch gives to their vector instructions.
_FAMILIES = {"AVX2": "x86-64-v3", "AVX512": "x86-64-v4"}
_logger = logging.getLogger(__name__)
_lock = threading.Lock()
#: Members of ``struct Pool`` in ``team.hpp``.
POOL = ("pool_parallel", "pool_rank", "pool_team_size")


#: Whether this process was forked and has not computed yet.
_forked = False


@functools.cache
def _pool() -> dict[str, int]:
    functions = ("GOMP_parallel", "omp_get_thread_num", "omp_get_num_threads")
    program = ctypes.CDLL(None)
    if not all(hasattr(program, function) for function in functions):
        return {}
    addresses = [ctypes.cast(getattr(program, function), ctypes.c_void_p).value for function in functions]
    return {name: address for name, address in zip(POOL, addresses, strict=True) if address}


def thread_pool() -> dict[str, int]:
    """Addresses of the functions through which torch's OpenMP threads are reached; empty if it uses other threads."""
    leave_parent_threads()
    return _pool()


def leave_parent_threads() -> None:
    """In a forked process that is about to compute for the first time, compute with one thread from now on.

    The threads of its parent are not there, but GNU OpenMP would wait for them for ever. Forked processes that do not
    use this package keep their number of threads.
    """
    global _forked
    if _forked:
        _forked = False
        _pool().clear()
        torch.set_num_threads(1)


def _after_fork() -> None:
    global _forked, _lock
    _forked, _lock = True, threading.Lock()  # another thread may have held the lock


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)


def cache_folder() -> str:
    """Where compiled kernels are kept: ``$XDG_CACHE_HOME/torchmpm``, else in the system's folder for caches."""
    usual = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}.get(sys.platform, "~/.cache")
    return os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(usual), "torchmpm")


def provenance() -> Path | tuple[str, ...] | None:
    """Where the kernels come from: a library of the package, or else a compiler; ``None`` if there is neither."""
    return _own_kernels(family()) or compiler.find_compiler()


@functools.cache
def _own_kernels(processors: str | None) -> Path | None:
    """The library of the package for the processors of :func:`family`; kept, as its name is a hash of all sources."""
    return packaged(compiler.NATIVE, compiler.REAL["float32"])


def family() -> str | None:
    """The class of processors, as a value of ``-march``, that a wheel has kernels for; ``None`` for other processors.

    The environment variable ``ATEN_CPU_CAPABILITY=avx2`` lets a processor with AVX-512 pass for one without it.
    """
    return "armv8-a" if platform.machine() == "aarch64" else _FAMILIES.get(torch.backends.cpu.get_cpu_capability())


def packaged(source: Path, *options: str) -> Path | None:
    """The library that the package holds for this processor; ``None`` if it holds none."""
    processors = family()
    path = processors and compiler.compiled_path(source, options, processors)
    return path if path and path.exists() else None


def load(dtype: torch.dtype) -> ctypes.CDLL:
    """The compiled kernels for a dtype, see :func:`build`."""
    return build(compiler.NATIVE, compiler.REAL[str(dtype).removeprefix("torch.")])


@functools.cache
def build(source: Path, *options: str) -> ctypes.CDLL:
    """Load the library of a C++ file, which may include the headers of this folder and of its own.

    Wheels contain it for usual processors. Otherwise the first call on a machine compiles it, which takes up to a
    minute; later processes find it in :func:`cache_folder`, if that can be written. Raises a ValueError where there is
    no compiler, or it failed; the message holds what it said.
    """
    ready = packaged(source, *options)
    if ready is not None:
        try:
            return ctypes.CDLL(str(ready))
        except OSError as error:  # for instance where the system's C library is too old
            _logger.info("the kernels of the package do not load (%s)", error)
    with _lock:  # or the threads of an evaluation would all compile it
        found = _load(source, options, cache_folder(), os.environ.get("CXX"), os.environ.get("PATH"))
    if isinstance(found, str):
        raise ValueError(f"backend 'native' {found}")
    return found


@functools.cache
def _load(source: Path, options: tuple[str, ...], folder: str, *_: str | None) -> ctypes.CDLL | str:
    """Find or build the library; returns a failure as text, so that it is not tried again in this process."""
    program = compiler.find_compiler()
    if program is None:
        return NO_COMPILER
    command = [*program, *compiler.arguments(source, options, "native"), "-o"]
    key = _key([*program, *compiler.flags(options, "native")], source)  # does not depend on where the source is
    path = Path(folder) / f"{source.stem}-{key}.so"
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
        _logger.info("compiling %s with %s (once on this machine, some seconds)", source.name, program[0])
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


def _key(command: list[str], source: Path) -> str:
    """Hash of the sources, the command, the compiler and the processor it compiles for."""
    program = Path(shutil.which(command[0]) or command[0])
    facts = (*command, f"{program.resolve()} {program.stat().st_mtime_ns}", processor())
    return compiler.digest_of(source, *facts)[:24]


def processor() -> str:
    """Model and instruction sets, because kernels compiled for one processor may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    facts = {line.partition(":")[0].strip(): line for line in reversed(lines)}
    return "\n".join(facts.get(name, "") for name in ("model name", "flags", "Features"))
