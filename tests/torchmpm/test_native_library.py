"""Compiling the kernels: once per machine, safely, and with clear words where it cannot be done."""

import ctypes
import os
import runpy
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from scenes import assert_identical, lively, robot

from torchmpm.backends import warn_eager
from torchmpm.native import library


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """An empty cache, and a process that has not loaded anything."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    forget()
    yield
    forget()


def forget() -> None:
    """As in the next process."""
    library._compiled.cache_clear()
    library.build.cache_clear()


def script(tmp_path: Path, body: str) -> str:
    """A stand-in for a compiler that counts its runs and then does ``body``; ``$last`` is where its output belongs."""
    path = tmp_path / "c++"
    path.write_text(f'#!/bin/sh\necho run >> "{tmp_path}/runs"\nfor last; do :; done\n{body}\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def runs(tmp_path: Path) -> int:
    """How often the stand-in was called."""
    log = tmp_path / "runs"
    return len(log.read_text().splitlines()) if log.exists() else 0


@pytest.fixture
def quick_compiler(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A compiler that hands out some shared library that exists anyway."""
    monkeypatch.setenv("CXX", script(tmp_path, f'cp "{torch._C.__file__}" "$last"'))


def test_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    assert library.find_compiler() is None
    with pytest.raises(ValueError, match="compiler"):
        robot(5, backend="native")
    with pytest.raises(ValueError, match="compiler"):
        library.load(torch.float32)


def test_failing_compiler_is_quoted_and_not_asked_twice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It may write any bytes, as in a language whose letters are not in UTF-8."""
    monkeypatch.setenv("CXX", script(tmp_path, r"printf 'no room on device \374\n' >&2; exit 3"))
    for _ in range(2):
        with pytest.raises(ValueError, match="no room on device"):
            robot(5, backend="native").step(lively(5))
    assert runs(tmp_path) == 1
    assert list((tmp_path / "cache").rglob("*.so")) == []


@pytest.mark.parametrize(
    "compiler",
    ["#!/no/such/interpreter\n", "\0 not a program", None],
    ids=["no interpreter", "no program", "no folder"],
)
def test_what_cannot_be_built_runs_eagerly(
    compiler: str | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """And says why: a compiler that cannot be started, or file systems that cannot be written."""
    if compiler is not None:
        monkeypatch.setenv("CXX", script(tmp_path, ""))
        (tmp_path / "c++").write_text(compiler)
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    warn_eager.cache_clear()
    monkeypatch.setattr(library, "family", lambda: None)
    assert_identical(*(robot(5, backend=name).step(lively(5)) for name in ("auto", "eager")))
    assert "could not be built" in caplog.text
    with pytest.raises(ValueError, match="backend 'native' could not be built"):
        library.load(torch.float32)


def test_an_interrupted_build_is_tried_again(
    quick_compiler: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Unlike one that fails."""

    def interrupted(*_: object, **__: object) -> None:  # a real signal might arrive before the compiler runs
        raise KeyboardInterrupt

    with monkeypatch.context() as during, pytest.raises(KeyboardInterrupt):
        during.setattr(library.subprocess, "run", interrupted)
        library.load(torch.float32)
    assert isinstance(library.load(torch.float32), ctypes.CDLL)
    assert runs(tmp_path) == 1


def test_kept_on_disk(quick_compiler: None, tmp_path: Path) -> None:
    first = library.load(torch.float32)
    assert library.load(torch.float32) is first
    forget()
    assert isinstance(library.load(torch.float32), ctypes.CDLL)
    assert runs(tmp_path) == 1
    library.load(torch.float64)
    assert runs(tmp_path) == 2
    files = list((tmp_path / "cache" / "torchmpm").iterdir())
    assert len(files) == 2 and all(file.suffix == ".so" for file in files)


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "text": lambda content: b"half a library",
    "half": lambda content: content[: len(content) // 2],
    "zeroed tail": lambda content: content[:-9000].ljust(len(content), b"\0"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_damaged_file_is_replaced(
    damage: Callable[[bytes], bytes], quick_compiler: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It would kill the process that loads it."""
    library.load(torch.float32)
    (file,) = (tmp_path / "cache" / "torchmpm").iterdir()
    damaged = tmp_path / "other" / "torchmpm" / file.name
    damaged.parent.mkdir(parents=True)
    damaged.write_bytes(damage(file.read_bytes()))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    forget()
    library.load(torch.float32)
    assert runs(tmp_path) == 2
    assert damaged.read_bytes() == file.read_bytes()


def test_threads_compile_once(quick_compiler: None, tmp_path: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        libraries = list(pool.map(library.load, [torch.float32] * 4))
    assert runs(tmp_path) == 1 and len(set(map(id, libraries))) == 1


def test_what_makes_another_file(quick_compiler: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Other sources, headers, options, flags and processors; not the folder that they lie in."""
    first, second = tmp_path / "one", tmp_path / "two"
    for folder in (first, second):
        folder.mkdir()
        (folder / "a.cpp").write_text("// the same")

    def runs_after_building(*options: str, folder: Path = first) -> int:
        forget()
        library.build(folder / "a.cpp", *options)
        return runs(tmp_path)

    assert runs_after_building("-DA") == runs_after_building("-DA", folder=second) == 1
    (first / "a.cpp").write_text("// another")
    assert runs_after_building("-DA") == 2
    (first / "b.hpp").write_text("// included")
    assert runs_after_building("-DA") == 3
    assert runs_after_building("-DB") == 4
    monkeypatch.setattr(library, "processor", lambda: "another processor")
    assert runs_after_building("-DB") == 5
    monkeypatch.setattr(library, "_FLAGS", ("-O0",))
    assert runs_after_building("-DB") == 6


def test_folder_that_cannot_be_written(quick_compiler: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Then each process compiles for itself and leaves nothing behind."""
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert isinstance(library.load(torch.float32), ctypes.CDLL)
    forget()
    library.load(torch.float32)
    assert runs(tmp_path) == 2


@pytest.mark.skipif(library.family() is None, reason="no wheel has kernels for this processor")
def test_kernels_of_the_package_come_first(
    quick_compiler: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """They need no compiler; one that does not load, or is of other sources, is not used."""
    source = tmp_path / "package" / "some.cpp"
    source.parent.mkdir()
    source.write_text("// nothing")
    path = library.compiled_path(source, ["-DA"], str(library.family()))
    path.write_bytes(b"of another system")
    library.build(source, "-DA")
    assert runs(tmp_path) == 1
    forget()
    path.write_bytes(Path(torch._C.__file__).read_bytes())
    library.build(source, "-DA")
    assert runs(tmp_path) == 1 and library.packaged(source, "-DA") == path
    assert library.packaged(source, "-DB") is None
    source.write_text("// changed")
    assert library.packaged(source, "-DA") is None
    monkeypatch.setattr(library, "family", lambda: None)
    assert library.packaged(source, "-DA") is None


def test_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the package imports and runs on the eager backend; the native one says what it needs."""
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(os, "register_at_fork")
    monkeypatch.delattr(os, "uname")
    there = runpy.run_path(library.__file__)
    assert there["find_compiler"]() is None and there["NO_COMPILER"].startswith("does not run on Windows")
    monkeypatch.setattr(library, "family", lambda: None)
    assert_identical(*(robot(5, backend=name).step(lively(5)) for name in ("auto", "eager")))
    with pytest.raises(ValueError, match="backend 'native'"):
        robot(5, backend="native")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_forked_process_keeps_its_threads_until_it_simulates() -> None:
    """Then it has a single thread, see ``tests/dittogym/test_concurrency.py``."""
    torch.set_num_threads(3)
    child = os.fork()
    if not child:
        before = torch.get_num_threads()
        library.leave_parent_threads()
        os._exit(10 * before + torch.get_num_threads())
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 31
