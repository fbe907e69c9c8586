"""Compiles CUDA kernels with NVRTC, which needs neither a GPU nor a compiler, and keeps them on disk."""

import functools
import hashlib
import importlib.metadata
import io
import logging
import threading
from collections.abc import Mapping
from pathlib import Path

import torch

from torchmpm.native.cuda.arguments import Kernel
from torchmpm.native.library import find_kept, keep

#: The kernels, and the headers that they share with those of the CPU.
FOLDERS = (Path(__file__).resolve().parent, Path(__file__).resolve().parents[1] / "common")
#: Roots and divisions are rounded as on the CPU, and small numbers are kept: a strain whose square were flushed to zero
#: would have a derivative that is divided by zero.
_ROUNDING = {"ftz": False, "prec_sqrt": True, "prec_div": True, "fma": True}
#: The oldest cards that the kernels are compiled for, by their compute capability.
OLDEST = (8, 0)
_logger = logging.getLogger(__name__)
_lock = threading.Lock()


@functools.cache
def unavailable(device: torch.device) -> str | None:
    """Why the kernels cannot run on a CUDA device, or ``None``."""
    reason = missing(torch.version.cuda)
    if reason is None and (capability := torch.cuda.get_device_capability(device)) < OLDEST:
        found, least = (".".join(map(str, version)) for version in (capability, OLDEST))
        reason = f"on CUDA it needs a card of compute capability {least} or newer, {device} has {found}"
    return reason


def missing(cuda: str | None) -> str | None:
    """Why nothing can be compiled for a torch that was built for this version of CUDA, or ``None``."""
    if cuda is None:
        return f"torch {torch.__version__} is not built for CUDA"
    major = cuda.partition(".")[0]
    install = f"pip install 'torchmpm[cuda{major}]'"
    try:
        found = {name: importlib.metadata.version(name) for name in ("cuda-core", "cuda-bindings")}
    except importlib.metadata.PackageNotFoundError as error:
        return f"on CUDA it needs {error.name}, which is not installed: {install}"
    if found["cuda-bindings"].partition(".")[0] != major:
        return f"torch is built for CUDA {cuda}, but cuda-bindings is {found['cuda-bindings']}: {install}"
    return None


def compile_kernel(kernel: Kernel, arch: str) -> bytes:
    """The binary of a kernel for an architecture such as ``sm_90``, from the disk if it was compiled before.

    Raises:
        ValueError: It cannot be compiled; the message holds what NVRTC said.
    """
    name = f"{kernel.name}-{arch}-{_key(kernel, arch)}"
    with _lock:
        if (path := find_kept(name, ".cubin")) is not None:
            return path.read_bytes()
        _logger.info("compiling %s for %s (once on this machine, some seconds)", kernel.name, arch)
        binary = compile_source(source_of(kernel), arch, kernel.macros, folder=path_of(kernel).parent)
        keep(name, ".cubin", binary)
    return binary


def source_of(kernel: Kernel) -> str:
    """The source code of a kernel."""
    return path_of(kernel).read_text(encoding="utf-8")


def path_of(kernel: Kernel) -> Path:
    """The file of a kernel; those of other packages have absolute paths."""
    return FOLDERS[0] / kernel.source


def compile_source(
    text: str, arch: str, macros: Mapping[str, str], log: io.StringIO | None = None, folder: Path = FOLDERS[0]
) -> bytes:
    """The binary of a source that may include headers of :data:`FOLDERS` and its own; see :func:`compile_kernel`.

    With a ``log``, what the assembler says of registers and memory is written to it.
    """
    try:
        from cuda.core import Program, ProgramOptions

        options = ProgramOptions(
            arch=arch,
            std="c++17",
            include_path=list(map(str, dict.fromkeys((folder, *FOLDERS)))),
            define_macro=list(macros.items()) or None,
            ptxas_options="-v" if log else None,
            **_ROUNDING,
        )
        return bytes(Program(text, "c++", options).compile("cubin", logs=log).code)
    except Exception as error:  # of cuda.core, whose own type has no public name, or NVRTC is not found
        raise ValueError(f"its CUDA kernels cannot be compiled for {arch}: {str(error)[:4000]}") from error


def _key(kernel: Kernel, arch: str) -> str:
    """Hash of everything that a binary depends on."""
    sources = digest_of_sources(path_of(kernel).parent)
    facts = f"{kernel} {arch} {sorted(_ROUNDING.items())} {_versions()} {sources}"
    return hashlib.sha256(facts.encode()).hexdigest()[:24]


def digest_of_sources(folder: Path = FOLDERS[0]) -> str:
    """Hash of everything that the kernels in a folder are compiled from."""
    digest, files = hashlib.sha256(), (file for each in {folder, *FOLDERS} for file in each.iterdir())
    for file in sorted(file for file in files if file.suffix in (".cu", ".cuh", ".hpp")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


@functools.cache
def _versions() -> tuple[object, ...]:
    from cuda.bindings import nvrtc

    return importlib.metadata.version("cuda-core"), *nvrtc.nvrtcVersion()
