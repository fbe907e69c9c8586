"""The rules of the architecture, read from syntax trees: who imports whom, no hidden global state, safe loading."""

import ast
import pkgutil
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: A package may import itself and those to its left.
ORDER = ("torchmpm", "dittogym", "cfp", "baselines")
#: All that the physics may import besides itself; NVIDIA's packages only where the kernels are compiled and launched.
PHYSICS_IMPORTS = {"jaxtyping", "numpy", "torch", *sys.stdlib_module_names}
CUDA_KERNELS = Path("torchmpm/native/cuda")
#: Functions that change what the whole process shares, and those that draw from a shared generator unless given one.
GLOBAL_STATE = {"os.chdir"} | {
    f"torch.{name}"
    for name in "manual_seed seed set_rng_state set_default_device set_default_dtype cuda.set_device "
    "cuda.manual_seed cuda.manual_seed_all".split()
}
DRAWS = {f"torch.{name}" for name in "bernoulli multinomial normal rand randint randn randperm".split()}
DRAWING_METHODS = set("bernoulli_ cauchy_ exponential_ geometric_ log_normal_ normal_ random_ uniform_".split())
#: Loading these formats can run code from the file.
UNSAFE_MODULES = {"cloudpickle", "dill", "joblib", "marshal", "pickle", "shelve"}

SOURCES = {
    path.relative_to(ROOT): ast.parse(path.read_text())
    for package in ORDER
    for path in sorted((ROOT / package).rglob("*.py"))
}


def imported(tree: ast.AST) -> Iterator[str]:
    """Full name of every absolute import, also inside functions and through ``import_module("...")``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            if ast.unparse(node.func).split(".")[-1] in {"import_module", "__import__"}:
                yield str(node.args[0].value)


def calls(tree: ast.AST) -> Iterator[tuple[str, str, dict[str | None, str]]]:
    """Of every call its dotted name with import aliases written out, its last name, and its keyword arguments."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            aliases |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            aliases |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, dot, rest = ast.unparse(node.func).partition(".")
            keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            yield aliases.get(first, first) + dot + rest, rest.rpartition(".")[2], keywords


@pytest.mark.parametrize("package", ORDER)
def test_imports_run_one_way(package: str) -> None:
    allowed = ORDER[: ORDER.index(package) + 1]
    for path, tree in SOURCES.items():
        if path.parts[0] == package:
            tops = {name.split(".")[0] for name in imported(tree)}
            assert tops.isdisjoint(set(ORDER) - set(allowed)), path
            if package == "torchmpm":
                known = PHYSICS_IMPORTS | ({"cuda"} if path.is_relative_to(CUDA_KERNELS) else set())
                assert tops <= known | {"torchmpm"}, path


def test_no_import_circle() -> None:
    modules = {".".join(path.with_suffix("").parts).removesuffix(".__init__"): tree for path, tree in SOURCES.items()}

    def module_of(name: str) -> str:
        while name not in modules and name:
            name = name.rpartition(".")[0]
        return name

    graph = {name: {module_of(other) for other in imported(tree)} - {"", name} for name, tree in modules.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names a circle


def test_nothing_global_is_touched() -> None:
    seeding = Path("dittogym/render/recording.py")  # for a policy; the generators are restored
    for path, tree in SOURCES.items():
        if path.parts[0] in ("torchmpm", "dittogym") and path != seeding:
            for name, method, keywords in calls(tree):
                assert name not in GLOBAL_STATE, f"{path}: {name}"
                shared = name.startswith(("numpy.random.", "random.")) and name.rpartition(".")[2].islower()
                assert not shared or name == "numpy.random.default_rng", f"{path}: {name}"
                draws = name.removesuffix("_like") in DRAWS or method in DRAWING_METHODS
                assert not draws or "generator" in keywords, f"{path}: {name} without a generator"
                assert not name.endswith("SobolEngine") or "seed" in keywords, f"{path}: {name} without a seed"


def test_files_are_loaded_safely() -> None:
    for path, tree in SOURCES.items():
        for name, _, keywords in calls(tree):
            assert name.split(".")[0] not in UNSAFE_MODULES, f"{path}: {name}"
            assert name != "torch.load" or keywords.get("weights_only") == "True", f"{path}: torch.load"
            assert name != "numpy.load" or keywords.get("allow_pickle", "False") == "False", f"{path}: numpy.load"


@pytest.mark.parametrize("script", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_benchmarks_import_what_exists(script: Path) -> None:
    for name in imported(ast.parse(script.read_text())):
        if name.split(".")[0] in ORDER:
            pkgutil.resolve_name(name)
