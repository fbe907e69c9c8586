"""How the kernels are compiled: for one processor on first use, or for classes of processors when a wheel is built.

``setup.py`` runs this file by itself, so it imports neither torch nor the rest of the package.
"""

import hashlib
import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

#: Headers that all kernels may include, and those for CPU and GPU that these include.
HEADERS = Path(__file__).resolve().parent
COMMON = HEADERS.parent / "common"
#: Not -ffast-math: it lets compilers assume that there is no NaN.
_FLAGS = (
    *("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
    *("-fopenmp-simd", "-fPIC", "-shared", "-pthread"),
)
_X86_FLAGS = ("-mprefer-vector-width=512",)
NATIVE = HEADERS / "native.cpp"
#: Options of the kernels by the dtype's name.
REAL = {"float32": "-DTORCHMPM_REAL=float", "float64": "-DTORCHMPM_REAL=double"}


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


def compiled_path(source: Path, options: Sequence[str], processor: str) -> Path:
    """Where a wheel has the library for a class of processors; the name changes with the sources and all flags."""
    digest = digest_of(source, *flags(options, processor))
    return source.with_name(f"{source.stem}-{processor}-{digest[:12]}.so")


def digest_of(source: Path, *facts: str) -> str:
    """Hash of the sources beside a file, the headers and some facts."""
    digest = hashlib.sha256("\n".join(facts).encode())
    for file in sorted(file for place in {source.resolve().parent, HEADERS, COMMON} for file in place.glob("*.[ch]pp")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
