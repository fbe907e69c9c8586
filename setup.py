"""What ``pyproject.toml`` cannot say: kernels compiled into a wheel, and links of the README for a package index.

Two environment variables, both empty by default:

- ``TORCHMPM_PROCESSORS``: classes of processors, such as ``x86-64-v3 x86-64-v4``, to compile the kernels for. Without
  them the wheel is the same for all machines, and kernels are compiled on first use.
- ``TORCHMPM_LINKS``: where the files of this version are shown, such as ``https://github.com/OWNER/NAME/blob/v0.1.0``.
"""

import os
import re
import runpy
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

library = runpy.run_path("torchmpm/native/library.py")
KERNELS = {
    "torchmpm/native/cpu/native.cpp": [[option] for option in library["REAL"].values()],
    "dittogym/picture.cpp": [["-ffp-contract=off"]],
}


class Kernel(Extension):
    """A library for ctypes, which does not depend on the version of Python."""

    def __init__(self, source: str, options: list[str], processor: str) -> None:
        path = library["compiled_path"](Path(source).resolve(), options, processor)
        super().__init__(str(path.relative_to(Path.cwd())), [source], extra_compile_args=options)
        self.processor = processor


class BuildKernels(build_ext):
    """Compiles with the flags of kernels that are compiled on first use; an editable install does without."""

    def finalize_options(self) -> None:
        super().finalize_options()
        self.parallel = self.parallel or True

    def run(self) -> None:
        if not self.editable_mode:
            super().run()

    def get_ext_fullpath(self, ext_name: str) -> str:
        return str(Path(self.build_lib, ext_name))

    def build_extension(self, ext: Kernel) -> None:
        out = Path(self.get_ext_fullpath(ext.name))
        out.parent.mkdir(parents=True, exist_ok=True)
        arguments = library["arguments"](Path(ext.sources[0]), ext.extra_compile_args, ext.processor)
        self.spawn([*library["find_compiler"](), *arguments, "-o", str(out)])


class AnyPython(bdist_wheel):
    """Names a wheel by its platform alone."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


def readme() -> str:
    """README.md, with absolute links to files and pictures."""
    text, links = Path("README.md").read_text(encoding="utf-8"), os.environ.get("TORCHMPM_LINKS")
    if not links:
        return text
    text = re.sub(r"(!\[[^]]*\]\()(?!https?:)([^)]+)\)", r"\1\2?raw=true)", text)
    return re.sub(r"\]\((?!https?:|#)", f"]({links}/", text)


setup(
    long_description=readme(),
    long_description_content_type="text/markdown",
    ext_modules=[
        Kernel(source, options, processor)
        for processor in os.environ.get("TORCHMPM_PROCESSORS", "").split()
        for source, variants in KERNELS.items()
        for options in variants
    ],
    cmdclass={"build_ext": BuildKernels, "bdist_wheel": AnyPython},
)
