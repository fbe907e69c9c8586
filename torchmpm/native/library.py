"""C++ libraries for ctypes: how they are compiled, where they are kept, and the threads they compute with.

A wheel holds the libraries for usual processors. Elsewhere a library is compiled for the processor at hand on first
use and kept on disk. ``setup.py`` runs this file by itself, so nothing at its top imports torch or the rest of the
package.
"""

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
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

#: Headers that all libraries may include, and those for CPU and GPU that these include.
HEADERS = Path(__file__).resolve().parent / "cpu"
COMMON = HEADERS.parent / "common"
#: The physics, and the option of each dtype by its name.
NATIVE = HEADERS / "native.cpp"
REAL = {"float32": "-DTORCHMPM_REAL=float", "float64": "-DTORCHMPM_REAL=double"}
#: Not -ffast-math: it lets compilers assume that there is no NaN.
_FLAGS = (
    *("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fopenmp-simd", "-fPIC", "-shared", "-pthread"),
)
_X86_FLAGS = ("-mprefer-vector-width=512",)
#: Classes of x86 processors that a wheel has libraries for, by the names that torch gives to their vector instructions.
_FAMILIES = {"AVX2": "x86-64-v3", "AVX512": "x86-64-v4"}
#: Completes the message "backend 'native' ...".
NO_COMPILER = (
    "does not run on Windows, except in WSL: use 'eager'"
    if sys.platform == "win32"
    else "needs a C++ compiler (g++, clang++ or $CXX), found none: use 'eager'"
)
#: Members of ``struct Pool`` in ``team.hpp``.
POOL = ("pool_parallel", "pool_rank", "pool_team_size")
_logger = logging.getLogger(__name__)
_lock = threading.Lock()
#: Whether this process was forked and has not computed yet.
_forked = False


def find_compiler() -> tuple[str, ...] | None:
    """The C++ compiler as a command: ``$CXX`` or else g++, and clang++ where that is not installed."""
    if sys.platform == "win32":  # not the kernels' system; torch.compile looks for another compiler there
        return None
    for command in (os.environ.get("CXX") or "g++", "clang++"):
        try:
            words = tuple(shlex.split(command))
        except ValueError:  # a quotation that does not end
            continue
        if words and shutil.which(words[0]) is not None:
            return words
    return None


def flags(options: Sequence[str], processor: str) -> list[str]:
    """Flags of the compiler; ``processor`` is a value of ``-march``."""
    x86 = processor.startswith("x86-64") or (processor == "native" and os.uname().machine == "x86_64")
    return [*_FLAGS, *_X86_FLAGS * x86, f"-march={processor}", *options]


def arguments(source: Path, options: Sequence[str], processor: str) -> list[str]:
    """Arguments of the compiler up to the name of its output."""
    return [*flags(options, processor), f"-I{HEADERS}", str(source)]


def digest_of(source: Path, *facts: str) -> str:
    """Hash of the sources beside a file, the headers and some facts."""
    digest = hashlib.sha256("\n".join(facts).encode())
    for file in sorted(file for place in {source.resolve().parent, HEADERS, COMMON} for file in place.glob("*.[ch]pp")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def compiled_path(source: Path, options: Sequence[str], processor: str) -> Path:
    """Where a wheel has the library for a class of processors; the name changes with the sources and all flags."""
    digest = digest_of(source, *flags(options, processor))
    return source.with_name(f"{source.stem}-{processor}-{digest[:12]}.so")


def family() -> str | None:
    """The class of processors, as a value of ``-march``, that a wheel has libraries for; ``None`` for other processors.

    The environment variable ``ATEN_CPU_CAPABILITY=avx2`` lets a processor with AVX-512 pass for one without it.
    """
    import torch

    return "armv8-a" if platform.machine() == "aarch64" else _FAMILIES.get(torch.backends.cpu.get_cpu_capability())


def packaged(source: Path, *options: str) -> Path | None:
    """The library that the package holds for this processor; ``None`` if it holds none."""
    processors = family()
    path = processors and compiled_path(source, options, processors)
    return path if path and path.exists() else None


@functools.cache
def _packaged_kernels(processors: str | None) -> Path | None:
    """The physics of the package for the processors of :func:`family`; kept, as its name is a hash of all sources."""
    return packaged(NATIVE, REAL["float32"])


def provenance() -> Path | tuple[str, ...] | None:
    """Where the physics comes from: a library of the package, or else a compiler; ``None`` if there is neither."""
    return _packaged_kernels(family()) or find_compiler()


def load(dtype: Any) -> ctypes.CDLL:
    """The physics for a torch dtype, see :func:`build`."""
    return build(NATIVE, REAL[str(dtype).removeprefix("torch.")])


@functools.cache
def build(source: Path, *options: str) -> ctypes.CDLL:
    """Load the library of a C++ file, which may include :data:`HEADERS` and those in its own folder.

    Wheels contain it for usual processors. Otherwise the first call on a machine compiles it, which takes up to a
    minute; later processes find it in :func:`cache_folder`, if that can be written.

    Raises:
        ValueError: There is no compiler, or it failed; the message holds what it said.
    """
    ready = packaged(source, *options)
    if ready is not None:
        try:
            return ctypes.CDLL(str(ready))
        except OSError as error:  # for instance where the system's C library is too old
            _logger.info("the kernels of the package do not load (%s)", error)
    with _lock:  # or the threads of an evaluation would all compile it
        found = _compiled(source, options, cache_folder(), os.environ.get("CXX"), os.environ.get("PATH"))
    if isinstance(found, str):
        raise ValueError(f"backend 'native' {found}")
    return found


def cache_folder() -> str:
    """Where compiled libraries are kept: ``$XDG_CACHE_HOME/torchmpm``, else in the system's folder for caches."""
    usual = {"darwin": "~/Library/Caches", "win32": "~/AppData/Local"}.get(sys.platform, "~/.cache")
    return os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(usual), "torchmpm")


@functools.cache
def _compiled(source: Path, options: tuple[str, ...], folder: str, *_: str | None) -> ctypes.CDLL | str:
    """Find or compile a library; returns a failure as text, so that it is not tried again in this process."""
    program = find_compiler()
    if program is None:
        return NO_COMPILER
    command = [*program, *arguments(source, options, "native"), "-o"]
    name = f"{source.stem}-{_key(program, options, source)}"
    with suppress(OSError):  # it does not load, for instance where the system's C library is too old
        if (ready := find_kept(name, ".so")) is not None:
            return ctypes.CDLL(str(ready))
    try:
        with tempfile.TemporaryDirectory() as scratch:
            fresh = Path(scratch) / "fresh.so"
            _logger.info("compiling %s with %s (once on this machine, some seconds)", source.name, program[0])
            done = subprocess.run([*command, str(fresh)], capture_output=True, text=True, errors="replace", check=False)
            if done.returncode != 0:
                failure = f"{shlex.join(command)} failed with code {done.returncode}:\n{done.stderr[-4000:]}"
                return f"could not be built: {failure}"
            return ctypes.CDLL(str(keep(name, ".so", fresh.read_bytes()) or fresh))
    except OSError as error:  # such as no folder that can be written, or a compiler that cannot be started
        return f"could not be built with {program[0]}: {error}"


def find_kept(name: str, suffix: str) -> Path | None:
    """What :func:`keep` has written for this name, if it is still whole; a library that is not would kill the process.

    Like :func:`keep` it looks in :func:`cache_folder`.
    """
    for path in Path(cache_folder()).glob(f"{name}-*{suffix}"):
        with suppress(OSError):
            if path.stem == f"{name}-{_hash(path.read_bytes())}":
                return path
    return None


def keep(name: str, suffix: str, content: bytes) -> Path | None:
    """Write a file for later processes; its name ends with a hash of the content. ``None`` if it cannot be written."""
    path = Path(cache_folder()) / f"{name}-{_hash(content)}{suffix}"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            fresh = Path(scratch) / path.name
            fresh.write_bytes(content)
            os.replace(fresh, path)  # atomic: another process may write it at the same time
        return path
    except OSError as error:
        _logger.info("compiled kernels cannot be kept in %s (%s)", path.parent, error)
        return None


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _key(program: Sequence[str], options: Sequence[str], source: Path) -> str:
    """Hash of the sources, wherever they are, the flags, the compiler and the processor it compiles for."""
    path = Path(shutil.which(program[0]) or program[0])
    compiler = f"{path.resolve()} {path.stat().st_mtime_ns}"
    return digest_of(source, *program, *flags(options, "native"), compiler, processor())[:24]


def processor() -> str:
    """Model and instruction sets, because a library compiled for one processor may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    facts = {line.partition(":")[0].strip(): line for line in reversed(lines)}
    return "\n".join(facts.get(name, "") for name in ("model name", "flags", "Features"))


def thread_pool() -> dict[str, int]:
    """Addresses of the functions through which torch's OpenMP threads are reached; empty if it uses other threads."""
    leave_parent_threads()
    return _pool()


@functools.cache
def _pool() -> dict[str, int]:
    functions = ("GOMP_parallel", "omp_get_thread_num", "omp_get_num_threads")
    program = ctypes.CDLL(None)
    if not all(hasattr(program, function) for function in functions):
        return {}
    addresses = [ctypes.cast(getattr(program, function), ctypes.c_void_p).value for function in functions]
    return {name: address for name, address in zip(POOL, addresses, strict=True) if address}


def leave_parent_threads() -> None:
    """In a forked process that is about to compute for the first time, compute with one thread from now on.

    The threads of its parent are not there, but GNU OpenMP would wait for them forever. Forked processes that do not
    use this package keep their number of threads.
    """
    global _forked
    if _forked:
        import torch

        _forked = False
        _pool().clear()
        torch.set_num_threads(1)


def _after_fork() -> None:
    global _forked, _lock
    _forked, _lock = True, threading.Lock()  # another thread may have held the lock


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)
