"""Predicted against measured memory of gradients."""

import gc
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from peak_memory import PeakMemory
from scenes import Learned, Wrapped, lively, normal, robot, robot_and_ball

from torchmpm import Body, Grid, ParticleState, Solver, VonMises, estimate_memory, segment_for, trajectory
from torchmpm.backends import compiler_found
from torchmpm.native.cpu import call
from torchmpm.substep import Planes, Scene

needs_compiler = pytest.mark.skipif(not compiler_found(), reason="no C++ compiler")


def measured(solver: Solver, batch: int, substeps: int, segment: int | None, env_steps: int = 1) -> int:
    """Largest number of bytes alive at once in a rollout and its backward pass, without scratch memory of kernels."""
    state = lively(solver.num_particles, batch)
    state = replace(state, v=state.v.clone().requires_grad_(), F=state.F.clone().requires_grad_())
    fields = [normal(batch, 2, 16, 16, seed=k).requires_grad_() for k in range(env_steps)]
    gc.collect()
    with PeakMemory() as memory:
        if env_steps == 1:
            final = solver.step(state, fields[0], substeps=substeps, segment=segment)
        else:
            final, _ = trajectory(
                lambda s, a: solver.step(s, a, substeps=substeps, segment=segment),
                state,
                fields,
                observe=lambda s: None,
            )
        (final.x.square().sum() + final.F.square().sum()).backward()
    assert fields[0].grad.abs().max() > 0
    return memory.peak


@pytest.mark.parametrize(
    ("count", "batch", "substeps", "segment", "env_steps"),
    [(300, 1, 8, None, 1), (300, 1, 12, 3, 1), (1000, 1, 6, 2, 1), (150, 3, 4, None, 1), (300, 1, 3, None, 4)],
)
def test_eager(count: int, batch: int, substeps: int, segment: int | None, env_steps: int) -> None:
    solver, options = robot_and_ball(count - 50, 50), {"substeps": substeps, "segment": segment, "env_steps": env_steps}
    predicted = estimate_memory(solver, (batch, count, torch.float64), **options)
    assert predicted == pytest.approx(measured(solver, batch, substeps, segment, env_steps), rel=0.25)


@pytest.mark.parametrize("wrapped", [False, True])
def test_learned_materials(wrapped: bool) -> None:
    law = Learned()
    solver = robot(300, bodies=(Body(300, Wrapped(law) if wrapped else law, mass=2.0, muscle=True),))
    predicted = estimate_memory(solver, (1, 300, torch.float64), substeps=8, segment=None)
    assert predicted == pytest.approx(measured(solver, 1, 8, None), rel=0.25)
    assert law.mu.device.type == "cpu"


class Thrice(Solver):
    """A solver with a substep of its own."""

    def substep(self, scene: Scene, planes: Planes) -> Planes:
        for _ in range(3):
            planes = super().substep(scene, planes)
        return planes


def test_a_substep_of_a_subclass() -> None:
    own = robot(300)
    solver = Thrice(**{field.name: getattr(own, field.name) for field in fields(own)})
    predicted = estimate_memory(solver, (1, 300, torch.float64), substeps=4, segment=None)
    assert predicted == pytest.approx(measured(solver, 1, 4, None), rel=0.25)


PROGRAM = """
import gc, sys, torch
from torchmpm import Body, Grid, ParticleState, Solver, VonMises, estimate_memory
backend, count, substeps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
solver = Solver(Grid(), (Body(count, VonMises(500.0, 50.0, 60.0), muscle=True),), backend=backend)

def resident(name):  # in kB: VmRSS now, VmHWM the largest so far
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name))

state = ParticleState.at_rest(0.4 + 0.2 * torch.rand(1, count, 2))

def run(substeps):
    field = torch.zeros(1, 2, 128, 128, requires_grad=True)
    solver.step(state, field, substeps=substeps, segment=None).x.square().sum().backward()

predicted, least = (
    estimate_memory(solver, state, substeps=n, segment=None) for n in (substeps, 1)
)
run(1)
gc.collect()
before = resident("VmRSS")
run(substeps)
print(predicted - least, 1024 * (resident("VmHWM") - before))
"""


@needs_compiler
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
@pytest.mark.parametrize(
    ("backend", "count", "substeps"),
    [pytest.param("eager", 4000, 20, marks=pytest.mark.slow), ("native", 22000, 60), ("native", 3000, 150)],
)
def test_resident_memory_of_a_process(backend: str, count: int, substeps: int) -> None:
    """What further substeps add to the memory that the system gives to a process."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, backend, str(count), str(substeps)], capture_output=True, text=True, check=True
    )
    predicted, used = map(int, done.stdout.split())
    assert used > 1e7
    assert predicted == pytest.approx(used, rel=0.25)


@needs_compiler
@pytest.mark.parametrize(("count", "nodes"), [(300, 128), (4000, 256), (10000, 128), (33000, 128)])
def test_scratch_of_the_kernels(count: int, nodes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one, two, four and eight parts; the estimate adds what tensors take."""
    body = Body(count, VonMises(500.0, 50.0, 60.0), muscle=True)
    solver = Solver(Grid(nodes), (body,), backend="native", allow_unstable=True)
    sizes: list[int] = []
    scratch = call._scratch
    monkeypatch.setattr(call, "_scratch", lambda size: (sizes.append(size), scratch(size))[1])
    state = ParticleState.at_rest(0.005 + 0.99 * torch.rand(1, count, 2, generator=torch.Generator().manual_seed(0)))
    field = torch.zeros(1, 2, nodes, nodes, requires_grad=True)
    solver.step(state, field, substeps=3).x.square().sum().backward()
    tensors = 5 * 13 * 4 * count + 4 * field.numel()  # start, states, and their derivatives
    for start in (state, (1, count, torch.float32)):
        assert estimate_memory(solver, start, substeps=3) == pytest.approx(max(sizes) + tensors, rel=0.1)


def test_an_estimate_takes_no_memory_itself() -> None:
    """The state would have 500 TB."""
    for backend in ("eager", "auto"):
        assert estimate_memory(robot(10**4, backend=backend), (10**9, 10**4, torch.float32), substeps=2) > 5e14


def test_the_segment_follows_the_budget() -> None:
    solver, state = robot(300), lively(300)
    whole = estimate_memory(solver, state, substeps=20, segment=None)
    assert segment_for(solver, state, substeps=20, budget=whole) is None
    budget = whole // 2
    segment = segment_for(solver, state, substeps=20, budget=budget)
    assert 1 < segment < 20
    assert estimate_memory(solver, state, substeps=20, segment=segment) <= budget
    assert estimate_memory(solver, state, substeps=20, segment=segment + 1) > budget
    assert measured(solver, 1, 20, segment) <= 1.1 * budget
    assert segment_for(solver, state, substeps=20, budget=budget, env_steps=30) < segment


@needs_compiler
def test_the_native_tape_follows_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter tapes of more starts, of the scratch that kernels ask for; the gradient stays the same."""
    solver, state = robot(300, backend="native"), lively(300)
    whole = estimate_memory(solver, state, substeps=40)
    segment = segment_for(solver, state, substeps=40, budget=whole // 2)
    assert segment is not None and 1 < segment < 40
    assert estimate_memory(solver, state, substeps=40, segment=segment) <= whole // 2
    sizes: list[int] = []
    scratch = call._scratch
    monkeypatch.setattr(call, "_scratch", lambda size: (sizes.append(size), scratch(size))[1])

    def gradient(segment: int | None) -> tuple[torch.Tensor, int]:
        sizes.clear()
        v = state.v.clone().requires_grad_()
        final = solver.step(replace(state, v=v), substeps=40, segment=segment)
        return torch.autograd.grad(final.x.square().sum(), v)[0], max(sizes)

    (expected, most), (shorter, less) = gradient(None), gradient(segment)
    assert less < 0.6 * most
    torch.testing.assert_close(shorter, expected, rtol=0, atol=1e-12 * float(expected.abs().max()))


@pytest.mark.parametrize("backend", ["eager", pytest.param("native", marks=needs_compiler)])
def test_a_budget_that_nothing_fits_into(backend: str) -> None:
    with pytest.raises(
        ValueError, match=r"budget must be at least [\d,]+ bytes for 2 step\(s\) of 20 .* got 10,000: take"
    ):
        segment_for(robot(300, backend=backend), lively(300), substeps=20, budget=10_000, env_steps=2)


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="substeps must be at least 1, got 0"):
        estimate_memory(robot(10), lively(10), substeps=0)
    with pytest.raises(ValueError, match="env_steps must be at least 1, got 0"):
        estimate_memory(robot(10), lively(10), substeps=1, env_steps=0)
    with pytest.raises(ValueError, match="state has 9 particles, the solver's bodies 10"):
        estimate_memory(robot(10), (1, 9, torch.float32), substeps=1)
