"""The rules of the house, read from the syntax trees of the packages: who imports whom, and no hidden global state."""

import ast
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: A package may import itself and those to its left.
ORDER = ("torchmpm", "dittogym", "cfp", "baselines")
#: All that the physics may know besides itself.
PHYSICS_KNOWS = {"jaxtyping", "numpy", "torch", *sys.stdlib_module_names}
#: And the one place that may know more, because it is imported only where that is there.
CUDA_KERNELS, CUDA_KERNELS_KNOW = Path("torchmpm/native/cuda"), {"triton"}
#: Packages that keep their hands off everything the whole process shares.
PURE = ("torchmpm", "dittogym")
#: Loading these formats can run code from the file; to name their errors is harmless.
UNSAFE_MODULES = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
HARMLESS = {"PickleError", "PicklingError", "UnpicklingError"}

OWN_GENERATORS = {
    "numpy.random": {
        "BitGenerator",
        "Generator",
        "MT19937",
        "PCG64",
        "Philox",
        "RandomState",
        "SeedSequence",
        "default_rng",
    },
    "random": {"Random", "SystemRandom"},
}
GLOBAL_STATE = {
    "os.chdir",
    "torch.cuda.manual_seed",
    "torch.cuda.manual_seed_all",
    "torch.cuda.set_device",
    "torch.manual_seed",
    "torch.seed",
    "torch.set_default_device",
    "torch.set_default_dtype",
    "torch.set_rng_state",
}
#: Random unless they are given a generator of their own.
DRAWS = {f"torch.{name}" for name in ("bernoulli", "multinomial", "normal", "rand", "randint", "randn", "randperm")}
DRAWS |= {f"torch.{name}_like" for name in ("rand", "randint", "randn")}
DRAWING_METHODS = {
    "bernoulli_",
    "cauchy_",
    "exponential_",
    "geometric_",
    "log_normal_",
    "normal_",
    "random_",
    "uniform_",
}


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and full name of every absolute import, also inside functions and through ``import_module("...")``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            if ast.unparse(node.func).split(".")[-1] in {"import_module", "__import__"}:
                yield node.lineno, str(node.args[0].value)


def used(tree: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Every dotted name with import aliases written out: ``np.random.rand`` as numpy.random.rand."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                first = alias.name.split(".")[0]
                aliases[alias.asname or first] = alias.name if alias.asname else first
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            aliases |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        parts, inner = [], node
        while isinstance(inner, ast.Attribute):
            parts.append(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name) and inner.id in aliases and isinstance(node, ast.expr):
            yield node, ".".join([aliases[inner.id], *reversed(parts)])


def direction_faults(source: str, path: Path) -> list[str]:
    """Imports that run against the order of the packages, or reach out of the physics."""
    faults, package = [], path.parts[0]
    known = PHYSICS_KNOWS | (CUDA_KERNELS_KNOW if path.is_relative_to(CUDA_KERNELS) else set())
    for line, name in imported(ast.parse(source)):
        top = name.split(".")[0]
        if top in ORDER:
            if ORDER.index(top) > ORDER.index(package):
                faults.append(f"{line}: {package} imports {name}")
        elif package == "torchmpm" and top not in known:
            faults.append(f"{line}: torchmpm imports {name}")
    return faults


def global_state_faults(source: str) -> list[str]:
    """Uses of random generators and settings that the whole process shares."""
    tree = ast.parse(source)
    faults = []
    for node, name in used(tree):
        module, _, leaf = name.rpartition(".")
        if name in GLOBAL_STATE or (module in OWN_GENERATORS and leaf not in OWN_GENERATORS[module]):
            faults.append(f"{node.lineno}: {name}")
    names = {id(node): name for node, name in used(tree)}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        name = names.get(id(call.func), "")
        method = call.func.attr if isinstance(call.func, ast.Attribute) else ""
        given = {keyword.arg for keyword in call.keywords}
        if (name in DRAWS or method in DRAWING_METHODS) and "generator" not in given:
            faults.append(f"{call.lineno}: {name or method} without a generator")
        if name == "torch.quasirandom.SobolEngine" and "seed" not in given:
            faults.append(f"{call.lineno}: {name} without a seed")
    return faults


def unsafe_loading_faults(source: str) -> list[str]:
    """Ways of reading a file that could run code from it."""
    tree = ast.parse(source)
    mentions = {*imported(tree), *((node.lineno, name) for node, name in used(tree))}
    faults = []
    for line, name in sorted(mentions):
        module, _, leaf = name.partition(".")
        if module in UNSAFE_MODULES and leaf and leaf not in HARMLESS:
            faults.append(f"{line}: {name}")
    names = {id(node): name for node, name in used(tree)}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
        name = names.get(id(call.func), "")
        if name == "torch.load" and arguments.get("weights_only") != "True":
            faults.append(f"{call.lineno}: torch.load without weights_only=True")
        if name == "numpy.load" and arguments.get("allow_pickle", "False") != "False":
            faults.append(f"{call.lineno}: numpy.load with allow_pickle")
    return faults


def modules(*packages: str) -> list[Path]:
    return [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_every_package_is_walked() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in modules(*ORDER)} == set(ORDER)


@pytest.mark.parametrize("path", modules(*ORDER), ids=label)
def test_imports_run_one_way(path: Path) -> None:
    assert direction_faults(path.read_text(), path.relative_to(ROOT)) == []


@pytest.mark.parametrize("package", ORDER)
def test_the_picture_of_the_house_shows_every_file(package: str) -> None:
    house = runpy.run_path(str(ROOT / "docs/house.py"))
    floor, below = house["survey"](package), ORDER[: ORDER.index(package)]
    assert house["PACKAGES"] == ORDER[::-1]
    assert set(floor.own) <= set(below) and (not below or floor.own)
    files = {path.stem for path in (ROOT / package).glob("*.py")} - {"__init__"}
    assert {room for room in floor.rooms if not room.endswith("/")} == files
    assert all(floor.rooms.values()), "a module without a docstring"


@pytest.mark.parametrize("path", modules(*PURE), ids=label)
def test_nothing_global_is_touched(path: Path) -> None:
    assert global_state_faults(path.read_text()) == []


@pytest.mark.parametrize("path", modules(*ORDER), ids=label)
def test_files_are_loaded_safely(path: Path) -> None:
    assert unsafe_loading_faults(path.read_text()) == []


@pytest.mark.parametrize(
    ("source", "package", "faults"),
    [
        ("import torch\nfrom torchmpm.grid import Grid\nfrom . import grid", "torchmpm", []),
        ("def f():\n    from dittogym import TorchEnv", "torchmpm", ["2: torchmpm imports dittogym.TorchEnv"]),
        ("import gymnasium", "torchmpm", ["1: torchmpm imports gymnasium"]),
        ("import importlib\nimportlib.import_module('cv2')", "torchmpm", ["2: torchmpm imports cv2"]),
        ("import triton", "torchmpm/native", ["1: torchmpm imports triton"]),
        ("import triton", "torchmpm/native/cuda", []),
        ("import cv2, torchmpm", "dittogym", []),
        ("import cfp.train as t", "dittogym", ["1: dittogym imports cfp.train"]),
        ("import baselines", "cfp", ["1: cfp imports baselines"]),
        ("import cfp, dittogym, torchmpm", "baselines", []),
    ],
)
def test_direction_checker(source: str, package: str, faults: list[str]) -> None:
    assert direction_faults(source, Path(package)) == faults


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("import numpy as np\nnp.random.seed(0)", ["2: numpy.random.seed"]),
        ("from numpy import random as r\nr.rand(3)", ["2: numpy.random.rand"]),
        ("from numpy.random import rand\nrand(3)", ["2: numpy.random.rand"]),
        ("import numpy as np\nrng: np.random.Generator = np.random.default_rng(0)\nrng.random(3)", []),
        ("import random\nrandom.shuffle([])", ["2: random.shuffle"]),
        ("import torch\ntorch.manual_seed(0)", ["2: torch.manual_seed"]),
        ("import torch\ntorch.rand(3)", ["2: torch.rand without a generator"]),
        ("import torch\ntorch.rand(3, generator=torch.Generator().manual_seed(0))", []),
        ("import torch\nx = torch.empty(3)\nx.uniform_()", ["3: uniform_ without a generator"]),
        ("import torch\ntorch.set_default_device('cuda')", ["2: torch.set_default_device"]),
        (
            "from torch.quasirandom import SobolEngine\nSobolEngine(2, scramble=True)",
            ["2: torch.quasirandom.SobolEngine without a seed"],
        ),
    ],
)
def test_global_state_checker(source: str, faults: list[str]) -> None:
    assert global_state_faults(source) == faults


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("import pickle as p\np.loads(b'')", ["2: pickle.loads"]),
        ("from cloudpickle import loads", ["1: cloudpickle.loads"]),
        ("import pickle\npickle.UnpicklingError", []),
        ("import torch\ntorch.load('a', weights_only=True)", []),
        ("import torch\ntorch.load('a')", ["2: torch.load without weights_only=True"]),
        ("import numpy as np\nnp.load('a', allow_pickle=True)", ["2: numpy.load with allow_pickle"]),
        ("import numpy as np\nnp.load('a')", []),
    ],
)
def test_unsafe_loading_checker(source: str, faults: list[str]) -> None:
    assert unsafe_loading_faults(source) == faults
