"""The rules of the architecture, read from syntax trees: who imports whom, and no hidden global state."""

import ast
import runpy
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: A package may import itself and those to its left.
ORDER = ("torchmpm", "dittogym", "cfp", "baselines")
#: Everything that the physics may import besides itself.
PHYSICS_IMPORTS = {"jaxtyping", "numpy", "torch", *sys.stdlib_module_names}
#: The CUDA kernels are imported only where Triton is installed.
CUDA_KERNELS, CUDA_IMPORTS = Path("torchmpm/native/cuda"), {"triton"}
#: What the folders inside a package may not import: the method knows nothing of the programs around it.
FORBIDDEN = {
    "cfp.agent": ("cfp.experiment", "cfp.evaluation", "cfp.envs"),
    "cfp.envs": ("cfp.experiment", "cfp.evaluation", "cfp.agent"),
    "cfp.evaluation": ("cfp.experiment",),
    "dittogym.tasks": ("dittogym.core", "dittogym.torch_env"),
    "dittogym.observation": ("dittogym.core", "dittogym.tasks"),
    "baselines.common": ("baselines.compare", "baselines.registry"),
}
#: Packages that touch nothing that the whole process shares.
PURE = ("torchmpm", "dittogym")
#: Loading these formats can run code from the file; naming their errors is harmless.
UNSAFE_MODULES = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}
HARMLESS = {"PickleError", "PicklingError", "UnpicklingError"}

OWN_GENERATORS = {
    "numpy.random": set("BitGenerator Generator MT19937 PCG64 Philox RandomState SeedSequence default_rng".split()),
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
    f"{name}_" for name in "bernoulli cauchy exponential geometric log_normal normal random uniform".split()
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
    """Imports that run against the order of the packages or of their folders, or out of the physics."""
    faults, package = [], path.parts[0]
    folder = ".".join(path.parts[:2])
    known = PHYSICS_IMPORTS | (CUDA_IMPORTS if path.is_relative_to(CUDA_KERNELS) else set())
    for line, name in imported(ast.parse(source)):
        top = name.split(".")[0]
        if top in ORDER:
            backwards = ORDER.index(top) > ORDER.index(package)
            if backwards or f"{name}.".startswith(tuple(f"{other}." for other in FORBIDDEN.get(folder, ()))):
                faults.append(f"{line}: {folder if not backwards else package} imports {name}")
        elif package == "torchmpm" and top not in known:
            faults.append(f"{line}: torchmpm imports {name}")
    return faults


def import_graph(sources: dict[str, str]) -> dict[str, set[str]]:
    """Modules that each module imports anywhere, in functions and for types too; a package's name is its __init__."""

    def module_of(name: str) -> str | None:
        while name and name not in sources:
            name = name.rpartition(".")[0]
        return name or None

    return {
        name: {found for _, other in imported(ast.parse(source)) if (found := module_of(other)) not in (None, name)}
        for name, source in sources.items()
    }


def circle(sources: dict[str, str]) -> list[str]:
    """Modules of one import circle; empty if there is none."""
    try:
        TopologicalSorter(import_graph(sources)).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def global_state_faults(source: str) -> list[str]:
    """Uses of random generators and settings that the whole process shares."""
    tree = ast.parse(source)
    faults, uses = [], list(used(tree))
    for node, name in uses:
        module, _, leaf = name.rpartition(".")
        if name in GLOBAL_STATE or (module in OWN_GENERATORS and leaf not in OWN_GENERATORS[module]):
            faults.append(f"{node.lineno}: {name}")
    names = {id(node): name for node, name in uses}
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
    uses = list(used(tree))
    mentions = {*imported(tree), *((node.lineno, name) for node, name in uses)}
    faults = []
    for line, name in sorted(mentions):
        module, _, leaf = name.partition(".")
        if module in UNSAFE_MODULES and leaf and leaf not in HARMLESS:
            faults.append(f"{line}: {name}")
    names = {id(node): name for node, name in uses}
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
        name = names.get(id(call.func), "")
        if name == "torch.load" and arguments.get("weights_only") != "True":
            faults.append(f"{call.lineno}: torch.load without weights_only=True")
        if name == "numpy.load" and arguments.get("allow_pickle", "False") != "False":
            faults.append(f"{call.lineno}: numpy.load with allow_pickle")
    return faults


def files(*packages: str) -> list[Path]:
    return [path.relative_to(ROOT) for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


def module_name(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def faults_of(check, *packages: str) -> dict[str, list[str]]:
    found = {str(path): check((ROOT / path).read_text()) for path in files(*packages)}
    return {path: faults for path, faults in found.items() if faults}


def test_imports_run_one_way() -> None:
    assert {path.parts[0] for path in files(*ORDER)} == set(ORDER)
    found = {str(path): direction_faults((ROOT / path).read_text(), path) for path in files(*ORDER)}
    assert {path: faults for path, faults in found.items() if faults} == {}


def test_no_import_circle() -> None:
    assert circle({module_name(path): (ROOT / path).read_text() for path in files(*ORDER)}) == []


def test_nothing_global_is_touched() -> None:
    found = faults_of(global_state_faults, *PURE)
    (seeding,) = found.pop("dittogym/render/recording.py")  # for a policy; torch's generators are then restored
    assert seeding.endswith("torch.cuda.manual_seed_all") and found == {}


def test_files_are_loaded_safely() -> None:
    assert faults_of(unsafe_loading_faults, *ORDER) == {}


@pytest.mark.parametrize("package", ORDER)
def test_the_diagram_shows_every_module(package: str) -> None:
    architecture = runpy.run_path(str(ROOT / "docs/architecture.py"))
    shown, below = architecture["read_package"](package), ORDER[: ORDER.index(package)]
    assert architecture["PACKAGES"] == ORDER[::-1]
    assert set(shown.internal) <= set(below) and (not below or shown.internal)
    modules = {f"{folder.path}/{name}.py" for folder in shown.folders for name in folder.modules}
    assert modules == {str(path) for path in files(package) if path.name != "__init__.py"}
    assert all(folder.summary for folder in shown.folders)


@pytest.mark.parametrize(
    ("source", "path", "faults"),
    [
        ("import torch\nfrom torchmpm.grid import Grid\nfrom . import grid", "torchmpm/a.py", []),
        ("def f():\n    from dittogym import TorchEnv", "torchmpm/a.py", ["2: torchmpm imports dittogym.TorchEnv"]),
        ("import importlib\nimportlib.import_module('cv2')", "torchmpm/a.py", ["2: torchmpm imports cv2"]),
        ("import triton", "torchmpm/native/a.py", ["1: torchmpm imports triton"]),
        ("import triton", "torchmpm/native/cuda/a.py", []),
        ("import cfp.train as t", "dittogym/a.py", ["1: dittogym imports cfp.train"]),
        ("import cfp, dittogym, torchmpm", "baselines/a.py", []),
        ("from cfp import experiment", "cfp/agent/a.py", ["1: cfp.agent imports cfp.experiment"]),
        ("from cfp import experiments", "cfp/agent/a.py", []),
    ],
)
def test_direction_checker(source: str, path: str, faults: list[str]) -> None:
    assert direction_faults(source, Path(path)) == faults


def test_circle_checker() -> None:
    lazy = {"a": "from b import f", "b": "def f():\n    import a"}
    assert set(circle(lazy)) == {"a", "b"}
    types = {
        "p": "",
        "p.a": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p.b import B",
        "p.b": "import p.a",
    }
    assert set(circle(types)) == {"p.a", "p.b"}
    assert set(circle({"p": "from p.a import A", "p.a": "from p import A"})) == {"p", "p.a"}
    assert circle({"p": "from p.a import A", "p.a": "import p.b", "p.b": "import numpy"}) == []


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("import numpy as np\nnp.random.seed(0)", ["2: numpy.random.seed"]),
        ("from numpy import random as r\nr.rand(3)", ["2: numpy.random.rand"]),
        ("import numpy as np\nrng: np.random.Generator = np.random.default_rng(0)\nrng.random(3)", []),
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
        ("import pickle\npickle.UnpicklingError", []),
        ("import torch\ntorch.load('a', weights_only=True)", []),
        ("import torch\ntorch.load('a')", ["2: torch.load without weights_only=True"]),
        ("import numpy as np\nnp.load('a', allow_pickle=True)", ["2: numpy.load with allow_pickle"]),
        ("import numpy as np\nnp.load('a')", []),
    ],
)
def test_unsafe_loading_checker(source: str, faults: list[str]) -> None:
    assert unsafe_loading_faults(source) == faults


@pytest.mark.parametrize("script", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_import_what_exists(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.delitem(sys.modules, "test_solver", raising=False)  # scaling.py imports the one beside it
    runpy.run_path(str(script), run_name="imported")
