"""What is kept of steps on CUDA: programs that run again, and graphs of them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from cuda_kernels import DEVICE, cuda, interpreted
from native_scenes import moving, solvers
from scenes import lively, normal, robot, robot_and_ball
from test_native_adjoint import assert_gradients_close, gradients, state_leaves
from torch import Tensor

from torchmpm import Body, VonMises, tree
from torchmpm.backends import compiler_found
from torchmpm.native import kernels
from torchmpm.native.tables import Inputs

pytestmark = [
    pytest.mark.skipif(not compiler_found(), reason="no C++ compiler"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # of numpy, which computes in the interpreter
]
graphs, programs = cuda.graphs, cuda.programs


def operator_calls(run: Callable[[], object]) -> list[tuple[object, ...]]:
    """Arguments with which the operator is called."""
    calls, step = [], kernels.native_step
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr(kernels, "native_step", lambda *arguments: calls.append(arguments) or step(*arguments))
        run()
    return calls


def program(seed: int, adjoint: bool) -> programs.Program:
    """Two substeps of three bodies from one of several states of the same shapes, or their adjoint."""
    state, field, origin = (t.to(DEVICE) for t in moving(12, 2))
    state, solver = replace(state, v=seed * state.v), replace(solvers(12, 2)["three bodies"], backend="native")
    calls = operator_calls(lambda: solver.step(state, seed * field, substeps=2, origin=origin))
    ((*tensors, handle, substeps),) = calls
    tables = cuda.tables.device_tables(handle, torch.float64, tensors[0].device)
    if not adjoint:
        return programs.Forward(Inputs(*tensors), tables, substeps)
    bars = normal(*tensors[0].shape, seed=seed).to(DEVICE)
    return programs.Backward(Inputs(*tensors, bars), tables, substeps, True, True)


@pytest.mark.parametrize("adjoint", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_program_runs_again(adjoint: bool) -> None:
    """With other inputs it gives what a new one gives: every run leaves the nodes as it found them."""
    used, new = program(1, adjoint), program(2, adjoint)
    with interpreted():
        used.run()
        before = [t.clone() for t in used.results]
        for own, given in zip(tree.leaves(used.inputs), tree.leaves(new.inputs), strict=True):
            own.copy_(given)
        used.run()
        new.run()
    for again, once, other in zip(used.results, new.results, before, strict=True):
        torch.testing.assert_close(again, once, rtol=0, atol=1e-10 * once.abs().max().item())
        assert not torch.equal(again, other)


class Adder(programs.Program):
    """Stands for a program: adds one."""

    built = 0

    def __init__(self, inputs: Inputs) -> None:
        Adder.built += 1
        self.inputs, self.sum = inputs, torch.empty_like(inputs.components)
        self.results = (self.sum,)

    def run(self) -> None:
        self.sum.copy_(self.inputs.components + 1)


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What happens to graphs, where there is no GPU to keep them."""
    happened: list[str] = []
    run = Adder.run
    monkeypatch.setattr(Adder, "built", 0)

    class Graph:
        def replay(self) -> None:
            happened.append("replay")
            run(self.program)

    @contextmanager
    def record(graph: Graph, **_: object) -> Iterator[None]:
        happened.append("record")
        recording.append(graph)
        try:
            yield
        finally:
            recording.clear()

    recording: list[Graph] = []

    def keep(self: Adder) -> None:
        happened.append("launch")
        if recording:
            recording.pop().program = self
        else:
            run(self)

    monkeypatch.setattr(Adder, "run", keep)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", record)
    return happened


def add_one(cache: graphs.Cache, key: object, value: float, size: int = 4, most: float = 1e9) -> float:
    """Run the adder once."""
    planes = torch.full((size,), value)
    (result,) = cache.run(key, Adder, Inputs(planes, None, planes, planes, planes, planes), most)
    return float(result[0])


def test_second_call_is_recorded_and_later_ones_played(events: list[str]) -> None:
    cache = graphs.Cache()
    assert [add_one(cache, "a", value) for value in (1.0, 2.0, 3.0, 4.0)] == [2.0, 3.0, 4.0, 5.0]
    assert events == ["launch", "record", "launch", "replay", "replay", "replay"]
    assert Adder.built == 1


def test_results_are_not_overwritten_by_the_next_call(events: list[str]) -> None:
    cache = graphs.Cache()
    planes = torch.ones(3)
    inputs = [Inputs(k * planes, None, planes, planes, planes, planes) for k in range(3)]
    results = [cache.run("a", Adder, given, 1e9)[0] for given in inputs]
    assert [float(r[0]) for r in results] == [1.0, 2.0, 3.0]


def test_what_is_kept_has_bounds(events: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """In number and in bytes; the longest unused go first, and what alone is too large is not kept at all."""
    cache = graphs.Cache()
    monkeypatch.setattr(graphs, "KEPT_GRAPHS", 2)
    for key in "abac":
        add_one(cache, key, 1.0)
    assert list(cache._kept) == ["a", "c"]
    most = cache.size()
    add_one(cache, "large", 1.0, size=1000, most=most)
    assert list(cache._kept) == ["a", "c"]
    add_one(cache, "d", 1.0, size=5, most=most)
    assert list(cache._kept) == ["d"] and cache.size() <= most
    cache.clear()
    assert not cache._kept


def test_what_fails_is_forgotten(events: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    cache = graphs.Cache()
    add_one(cache, "a", 1.0)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="out of luck"):
        patch.setattr(Adder, "run", raiser)
        add_one(cache, "a", 1.0)
    assert not cache._kept
    assert add_one(cache, "a", 2.0) == 3.0


def raiser(self: Adder) -> None:
    """Stands for a kernel that cannot be launched."""
    raise RuntimeError("out of luck")


def test_buffers_made_in_inference_mode_serve_outside_of_it(events: list[str]) -> None:
    cache = graphs.Cache()
    with torch.inference_mode():
        add_one(cache, "a", 1.0)
    assert add_one(cache, "a", 2.0) == 3.0


def compared(run: Callable[[], Tensor], times: int = 4) -> list[Tensor]:
    """Results of the first calls, of which some are launched and some played from a graph."""
    cuda.cache.clear()
    results = [run() for _ in range(times)]
    assert cuda.cache.size() > 0
    return results


@pytest.mark.cuda
def test_replay_equals_launches() -> None:
    state, field = lively(300, 2).to("cuda"), 40.0 * normal(2, 2, 16, 16, seed=1).cuda()
    solver = robot_and_ball(200, 100, backend="native")
    first, *others = compared(lambda: solver.step(state, field, substeps=20).x)
    for other in others:
        torch.testing.assert_close(other, first, rtol=0, atol=1e-11)


@pytest.mark.cuda
def test_gradients_from_replays_equal_eager() -> None:
    given = {name: value.cuda() for name, value in state_leaves(300, 2).items()}
    wanted, solver = ("x", "F", "actuation", "origin"), solvers(300, 2)["three bodies"]
    expected = gradients(lambda _: solver, given, wanted, 20, "eager")
    cuda.cache.clear()
    for _ in range(4):
        assert_gradients_close(gradients(lambda _: solver, given, wanted, 20, "native"), expected, 1e-8)


@pytest.mark.cuda
def test_within_a_graph_of_the_caller() -> None:
    """Kernels are launched one by one into it."""
    solver, state = robot(100, backend="native", gravity=torch.tensor([0.0, -9.0]).cuda()), lively(100).to("cuda")
    expected = solver.step(state, substeps=5)
    (arguments,) = operator_calls(lambda: solver.step(state, substeps=5))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        planes = kernels.native_step(*arguments)
    graph.replay()
    torch.testing.assert_close(planes[0], expected.x[..., 0], rtol=0, atol=1e-12)


@pytest.mark.cuda
def test_a_step_within_a_graph_of_the_caller() -> None:
    """With values and gravity some of which are numbers, which must not be copied to the device in every step."""
    mu = torch.full((100,), 500.0, dtype=torch.float64, device="cuda")[None]
    solver = robot(100, bodies=(Body(100, VonMises(mu, 50.0, 60.0), mass=2.0),), backend="native")
    state = lively(100).to("cuda")
    expected = solver.step(state, substeps=5)
    graph = torch.cuda.CUDAGraph()
    with torch.no_grad(), torch.cuda.graph(graph):
        found = solver.step(state, substeps=5)
    graph.replay()
    torch.testing.assert_close(found.x, expected.x, rtol=0, atol=1e-12)
