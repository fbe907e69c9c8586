"""Backends: the same numbers, and clear words where one cannot run."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import pytest
import torch
from scenes import GRID, assert_close, assert_identical, lively, normal, robot, robot_and_ball
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from torchmpm import Body, Grid, ParticleState, Solver, VelocityRule, VonMises, backends, trajectory, tree
from torchmpm.native import library
from torchmpm.native.library import find_compiler
from torchmpm.substep import Scene


@pytest.fixture
def fresh_process() -> None:
    """As in a process that has not said or loaded anything yet."""
    backends.warn_eager.cache_clear()
    library.build.cache_clear()


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.message for record in caplog.records if record.name == "torchmpm.backends"]


@pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
def test_auto_is_native_where_that_works(fresh_process: None, caplog: pytest.LogCaptureFixture) -> None:
    state = lively(30)
    results = [robot(30, backend=backend).step(state, substeps=5) for backend in ("auto", "native")]
    assert_identical(*results)
    assert messages(caplog) == []


class Own(VonMises):
    """Somebody's material."""


class Still(Solver):
    """Its particles rest."""

    def boundary(self, scene: Scene, velocity: Tensor) -> Tensor:
        """Nothing moves."""
        return torch.zeros_like(velocity)


@dataclass(frozen=True, eq=False)
class Slippery(Solver):
    """Its rules have a friction that can be learned."""

    friction: Tensor | float = 0.0

    def scene(self, state: ParticleState, actuation: Tensor | None, origin: Tensor) -> Scene:
        """The same with other faces."""
        scene = super().scene(state, actuation, origin)
        faces = tuple(replace(face, friction=self.friction * face.active) for face in scene.faces)
        return replace(scene, faces=faces)


class Floor(Solver):
    """A floor between the seventh and the eighth row of nodes, as a surface of its own."""

    def boundary(self, scene: Scene, velocity: Tensor) -> Tensor:
        """Nothing falls through it."""
        below = self.grid.nodes(scene.origin)[1] < 7.5 * self.grid.h
        return torch.stack((velocity[0], torch.where(below, velocity[1].clamp_min(0.0), velocity[1])))


def test_a_surface_of_ones_own_acts_as_the_rule_in_its_place() -> None:
    """In windows at two places."""
    state, origin = lively(30, 2), torch.tensor([[0.0, 0.0], [2 / 16, 1 / 16]], dtype=torch.float64)
    bodies, floor = robot(30).bodies, VelocityRule("-y", j=(None, 7))
    own, rule, none = (
        Floor(GRID, bodies, (0.5, -9.8)),
        *(robot(30, bodies=bodies, rules=rules) for rules in ((floor,), ())),
    )
    ends = [solver.step(state, substeps=20, origin=origin) for solver in (own, rule, none)]
    assert_identical(*ends[:2])
    assert not torch.equal(ends[0].x, ends[2].x)


class Narrow(Grid):
    """Of its particles none takes part."""

    def contains(self, x: Tensor, origin_x: Tensor) -> Tensor:
        """None."""
        return x != x


OTHERS = {
    "Own": (Solver, GRID, Own),
    "Still": (Still, GRID, VonMises),
    "Narrow": (Solver, Narrow(16), VonMises),
}


@pytest.mark.parametrize("name", OTHERS)
def test_auto_is_eager_where_the_kernels_do_not_work(
    name: str, fresh_process: None, caplog: pytest.LogCaptureFixture
) -> None:
    """And says why, once; the kernels call nothing that a subclass overrides, and say so."""
    kind, grid, law = OTHERS[name]
    state, body = lively(30), Body(30, law(500.0, 50.0, 60.0))
    auto, eager, _ = (kind(grid, (body,), backend=b).step(state, substeps=2) for b in ("auto", "eager", "auto"))
    assert_identical(auto, eager)
    assert torch.equal(eager.x, state.x) == (name != "Own")
    (message,) = messages(caplog)
    assert name in message
    if find_compiler():
        with pytest.raises(ValueError, match=name):
            kind(grid, (body,), backend="native").step(state)


class Softened(VonMises):
    """A law that works in place."""

    def return_map(self, F: Any, Jp: Tensor) -> Any:
        """One stretch and Jp are changed."""
        return (F[0].mul_(0.9), *F[1:]), Jp.mul_(0.5)


def test_a_law_may_work_in_place() -> None:
    """Also in the first step, before which it is tried."""
    state, body = lively(30), Body(30, Softened(500.0, 50.0, 60.0))
    copy = state.clone()
    result = robot(30, bodies=(body,), backend="eager").step(state)
    assert_identical(state, copy)
    assert torch.equal(result.Jp, 0.5 * copy.Jp)


@pytest.mark.parametrize("backend", ["auto", "eager"])
def test_friction_that_a_subclass_learns(backend: str) -> None:
    """Through checkpoints, too."""
    friction = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    rule, found = VelocityRule("-y", j=(None, 8), friction=1.0), []
    for segment in (None, 2):
        solver = Slippery(
            GRID, (Body(30, VonMises(500.0, 50.0, 60.0)),), rules=(rule,), backend=backend, friction=friction
        )
        final = solver.step(lively(30), substeps=5, segment=segment)
        found += torch.autograd.grad(final.x.square().sum(), friction)
    torch.testing.assert_close(*found)
    assert found[0].abs() > 0


def test_transforms_of_torch_func_get_what_eager_gives(fresh_process: None, caplog: pytest.LogCaptureFixture) -> None:
    """Also in long steps, without checkpoints; the kernels would lose forward-mode derivatives, and say so."""
    state, drive = lively(5), normal(1, 2, 16, 16, seed=1)
    mu = torch.tensor(500.0, dtype=torch.float64)
    rules = (VelocityRule("-y", j=(None, 6), friction=0.4), VelocityRule("-x", i=(None, 6), friction=math.inf))

    def loss(backend: str) -> Callable[[Tensor, Tensor], Tensor]:
        def through(drive: Tensor, mu: Tensor) -> Tensor:
            bodies = (Body(5, VonMises(mu, 50.0, 62.0), mass=2.0, muscle=True),)
            solver = robot(5, bodies=bodies, rules=rules, backend=backend)
            last, _ = trajectory(lambda s, _: solver.step(s, drive, substeps=12), state, range(2), observe=id)
            return last.F.square().sum()

        return through

    tangents, twice = (drive, torch.ones_like(mu)), (torch.stack((drive, drive)), mu.expand(2))
    leaves = drive.clone().requires_grad_(), mu.clone().requires_grad_()
    expected = torch.autograd.grad(loss("eager")(*leaves), leaves)
    slope = sum((gradient * tangent).sum() for gradient, tangent in zip(expected, tangents, strict=True))
    for transform, result in (
        (lambda f: torch.func.jvp(f, (drive, mu), tangents)[1], slope),
        (lambda f: torch.func.grad(f, (0, 1))(drive, mu), expected),
        (lambda f: torch.func.vmap(torch.func.grad(f, (0, 1)))(*twice), [torch.stack((e, e)) for e in expected]),
    ):
        torch.testing.assert_close(transform(loss("auto")), transform(loss("eager")), rtol=0, atol=0)
        torch.testing.assert_close(transform(loss("auto")), result, rtol=1e-9, atol=1e-12)
        with pytest.raises(ValueError, match=r"torch\.func"):
            transform(loss("native"))
    with forward_ad.dual_level():
        for pair in ((forward_ad.make_dual(drive, drive), mu), (drive, forward_ad.make_dual(mu, torch.ones_like(mu)))):
            auto, eager = (forward_ad.unpack_dual(loss(backend)(*pair)).tangent for backend in ("auto", "eager"))
            assert auto is not None and auto == eager != 0
            with pytest.raises(ValueError, match="forward-mode"):
                loss("native")(*pair)
    assert len(messages(caplog)) == 2


def test_other_defaults_of_torch_change_nothing(fresh_process: None) -> None:
    state, drive = lively(20), normal(1, 2, 16, 16, seed=1)
    expected = robot(20, backend="auto").step(state, drive, substeps=2)
    with torch.device("meta"):
        assert_identical(robot(20, backend="auto").step(state, drive, substeps=2), expected)


def test_tensors_without_numbers_take_an_eager_step(fresh_process: None, caplog: pytest.LogCaptureFixture) -> None:
    """The kernels would read from a null pointer."""
    fake, state = FakeTensorMode(), lively(5)
    with fake:
        imagined = tree.map(fake.from_tensor, state)
        assert robot(5, backend="auto").step(imagined, substeps=2).x.shape == state.x.shape
        if find_compiler():
            with pytest.raises(ValueError, match="FakeTensor"):
                robot(5, backend="native").step(imagined)
    assert "FakeTensor" in messages(caplog)[0]


def test_a_trace_holds_an_eager_step_and_its_gradient() -> None:
    """It replays operators of torch alone: what the kernels write would be missing."""
    state, drive = lively(5), normal(1, 2, 16, 16, seed=1)

    def gradient(solver: Solver, drive: Tensor) -> tuple[Tensor, Tensor]:
        x = solver.step(state, drive, substeps=2).x
        return x, *torch.autograd.grad(x.sum(), drive)

    traced = make_fx(partial(gradient, robot(5, backend="auto")))(drive.requires_grad_())
    other = (2 * drive.detach()).requires_grad_()
    torch.testing.assert_close(traced(other), gradient(robot(5), other), rtol=1e-12, atol=1e-12)


@pytest.mark.cuda
def test_cuda_equals_cpu() -> None:
    """To 1e-10 in double precision: only the order of the sums on the nodes differs."""
    solver, state, field = robot_and_ball(20, 10), lively(30, 2, strain=0.1), 40.0 * normal(2, 2, 16, 16, seed=1)
    on_cpu = solver.step(state, field, substeps=20)
    on_cuda = solver.step(state.to("cuda"), field.to("cuda"), substeps=20)
    assert on_cuda.device.type == "cuda"
    assert_close(on_cuda.to("cpu"), on_cpu, 1e-10)


@pytest.mark.filterwarnings("ignore::UserWarning")  # torch's own about what it cannot trace
def test_a_compiled_function_holds_an_eager_step_whole_and_runs_around_other_backends() -> None:
    state, drive = lively(5), normal(1, 2, 16, 16, seed=1)

    def moved(backend: str, **options: bool) -> Tensor:
        solver = robot(5, backend=backend)
        return torch.compile(lambda d: solver.step(state, d).x, backend="eager", **options)(drive)

    expected = robot(5).step(state, drive).x
    assert torch.equal(moved("eager", fullgraph=True), expected)
    with pytest.raises(Exception, match="backend 'auto'"):
        moved("auto", fullgraph=True)
    torch.testing.assert_close(moved("auto"), expected, rtol=1e-12, atol=1e-12)


def test_tensors_of_a_trace_are_not_kept() -> None:
    """They hold no numbers for those who come after it."""

    @tree.cached_tensors
    def row(count: int) -> tuple[Tensor, Tensor]:
        return torch.arange(count, device="cpu"), torch.ones(count, device="cpu")

    class Model(torch.nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x * row(3)[0]

    with FakeTensorMode():
        assert type(row(2)[0]) is not Tensor
    exported = torch.export.export(Model(), (torch.ones(3),))
    for count in (2, 3):
        assert type(row(count)[0]) is Tensor and row(count)[0].tolist() == list(range(count))
        assert row(count)[0] is row(count)[0]
    again = torch.export.export(Model(), (torch.ones(3),))  # with what is kept by now
    for program in (exported, again):
        assert program.module()(torch.ones(3)).tolist() == [0.0, 1.0, 2.0]
