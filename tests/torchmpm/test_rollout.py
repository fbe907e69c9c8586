"""Loops over steps and their checkpoints, on a step simple enough to know the answer."""

import gc
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from peak_memory import PeakMemory
from scenes import lively, normal, robot
from torch import Tensor
from torch.autograd import forward_ad

from torchmpm import Body, Elastic, ParticleState, Solver, repeated, trajectory
from torchmpm.materials.body import METHODS
from torchmpm.native.library import find_compiler

NATIVE = pytest.param("native", marks=pytest.mark.skipif(not find_compiler(), reason="no C++ compiler"))
CHANGED = "in.?place"


def double(x: Tensor) -> Tensor:
    return 2.0 * x


@pytest.mark.parametrize("segment", [None, 1, 2, 3, 5, 9])
@pytest.mark.parametrize("times", [0, 1, 5, 6])
def test_repeated_counts(times: int, segment: int | None) -> None:
    x = torch.ones(2, requires_grad=True)
    result = repeated(double, x, times, segment=segment)
    assert result.tolist() == [2.0**times] * 2
    if times:
        result.sum().backward()
        assert x.grad.tolist() == [2.0**times] * 2
    with torch.no_grad():
        assert repeated(double, x, times, segment=segment).tolist() == [2.0**times] * 2


def test_repeated_takes_tuples() -> None:
    x = torch.ones(1, requires_grad=True)
    a, b = repeated(lambda s: (s[1], s[0] * s[1]), (x, 2.0 * x), 5, segment=2)
    (slope,) = torch.autograd.grad(a + b, x)
    # Fibonacci: x, 2x, 2x^2, 4x^3, 8x^5, 32x^8, 256x^13
    assert (a.item(), b.item(), slope.item()) == (32.0, 256.0, 32.0 * 8 + 256.0 * 13)


def test_numbers_of_numpy() -> None:
    assert repeated(double, torch.ones(1), np.int64(3), segment=np.int64(2)).item() == 8.0


@pytest.mark.parametrize("checkpointed", [True, False])
def test_trajectory_collects_what_it_observes(checkpointed: bool) -> None:
    inputs = [torch.tensor(float(k), requires_grad=True) for k in (1, 2, 3)]
    x = torch.tensor(1.0, requires_grad=True)
    final, seen = trajectory(
        lambda s, a: s * a + 1.0, x, iter(inputs), observe=lambda s: 10.0 * s, checkpointed=checkpointed
    )
    assert [s.item() for s in seen] == [20.0, 50.0, 160.0]
    assert final.item() == 16.0
    gradient = torch.autograd.grad(final + seen[1] / 10.0, [x, *inputs])
    # final = ((x a + 1) b + 1) c + 1, seen[1] / 10 = (x a + 1) b + 1
    assert [g.item() for g in gradient] == [6.0 + 2.0, 6.0 + 2.0, 6.0 + 2.0, 5.0]


def rollout_gradients(backend: str, checkpointed: bool, segment: int | None) -> list[Tensor]:
    """Gradients of a loss on four observed steps of a robot."""
    solver, state = robot(30, backend=backend), lively(30)
    x, v = state.x.clone().requires_grad_(), state.v.clone().requires_grad_()
    fields = [(60.0 * normal(1, 2, 16, 16, seed=k)).requires_grad_() for k in range(4)]
    final, seen = trajectory(
        lambda s, a: solver.step(s, a, substeps=5, segment=segment),
        replace(state, x=x, v=v),
        fields,
        observe=lambda s: s.x.square().sum() + s.F.square().sum(),
        checkpointed=checkpointed,
    )
    return list(torch.autograd.grad(sum(seen) + final.v.square().sum(), [x, v, *fields]))


@pytest.mark.parametrize("backend", ["eager", NATIVE])
@pytest.mark.parametrize(("checkpointed", "segment"), [(True, None), (True, 2), (False, 2)])
def test_checkpoints_do_not_change_gradients(checkpointed: bool, segment: int | None, backend: str) -> None:
    plain = rollout_gradients("eager", False, None)
    assert all(g.abs().max() > 0 for g in plain)
    for found, without in zip(rollout_gradients(backend, checkpointed, segment), plain, strict=True):
        torch.testing.assert_close(found, without, rtol=0, atol=1e-12 * without.abs().max().item())


def test_a_replay_ends_at_its_own_tensors() -> None:
    """Muscles and the mass depend on mu here, whose derivative must not be counted twice; second ones work, too."""
    found = []
    for segment in (None, 2):
        log_mu = torch.tensor(6.0, dtype=torch.float64, requires_grad=True)
        mu = log_mu.exp()
        body = Body(30, Elastic(mu, 0.1 * mu), mass=1.0 + 0.002 * mu, muscle=True)
        solver, state = robot(30, bodies=(body,), backend="eager"), lively(30)
        for _ in range(2):
            muscles = 0.1 * mu * state.v.mean() * normal(1, 2, 16, 16, seed=1)
            state = solver.step(state, muscles, substeps=5, segment=segment)
        (first,) = torch.autograd.grad(state.v.square().sum(), log_mu, create_graph=True)
        found.append((first, *torch.autograd.grad(first, log_mu)))
    assert all(derivative.abs() > 1e-9 for derivative in found[0]), found
    torch.testing.assert_close(found[1], found[0], rtol=1e-9, atol=0)


def test_one_buffer_for_all_inputs_is_refused() -> None:
    """Its last numbers would be replayed in every step."""
    x, buffer = torch.ones(2, requires_grad=True), torch.zeros(2)
    final, _ = trajectory(lambda s, a: s * a, x, (buffer.fill_(k) for k in (2.0, 3.0)), observe=lambda s: None)
    with pytest.raises(RuntimeError, match=CHANGED):
        final.sum().backward()
    final, _ = trajectory(lambda s, a: s * a, x, (buffer.fill_(k).clone() for k in (2.0, 3.0)), observe=lambda s: None)
    for _ in range(2):  # replayed twice
        final.sum().backward(retain_graph=True)
    assert x.grad.tolist() == [12.0, 12.0]


@pytest.mark.parametrize("loop", ["trajectory", "repeated"])
def test_tensors_that_a_loop_reads(loop: str) -> None:
    """Have their derivative, also one that depends on another; a change between step and gradient is refused."""
    base, x = torch.tensor(0.7, requires_grad=True), torch.ones(2, requires_grad=True)
    gain, offset, start = 2.0 * base, torch.full((2,), 0.1), x + 0.0

    def step(state: Tensor, k: int = 1) -> Tensor:
        return (gain * state + k * base + offset).sin()

    def roll() -> Tensor:
        if loop == "trajectory":
            return trajectory(step, start, range(4), observe=id)[0]
        return repeated(step, start, 4, segment=2)

    def whole() -> Tensor:
        state = start
        for k in range(4):
            state = step(state, k if loop == "trajectory" else 1)
        return state

    found, expected = (torch.autograd.grad(f().sum(), (x, base), retain_graph=True) for f in (roll, whole))
    torch.testing.assert_close(found, expected)
    for read in (start, offset):
        final = roll()
        with torch.no_grad():
            read.add_(0.5)
        with pytest.raises(RuntimeError, match=CHANGED):
            final.sum().backward()


def test_forward_mode_derivatives_of_checkpoints() -> None:
    gain, x = torch.tensor(0.7, requires_grad=True), torch.ones(2)
    found = []
    for options in ({}, {"segment": 2}):
        with forward_ad.dual_level():
            start = forward_ad.make_dual(x, torch.tensor([1.0, 2.0]))
            end = repeated(lambda gain, s: (gain * s).sin(), start, 4, shared=gain, **options)
            found.append(forward_ad.unpack_dual(end).tangent)
    torch.testing.assert_close(*found)


def test_a_state_that_is_no_number_is_replayed() -> None:
    x = torch.tensor([1.0, 0.0, -1.0], requires_grad=True)
    (slope,) = torch.autograd.grad(repeated(lambda s: 2.0 * s.log(), x, 2, segment=1)[:1].sum(), x)
    assert slope[0] == math.inf


def peak_memory(substeps: int, segment: int | None, checkpointed: bool | None = None) -> int:
    """Peak bytes of a forward and backward pass; with ``checkpointed`` as a trajectory of steps."""
    solver, state = robot(100), lively(100)
    v = state.v.clone().requires_grad_()
    start = ParticleState(state.x, v, state.C, state.F, state.Jp)
    gc.collect()
    with PeakMemory() as memory:
        if checkpointed is None:
            final = solver.step(start, substeps=substeps, segment=segment)
        else:
            final, _ = trajectory(
                lambda s, _: solver.step(s, substeps=2, segment=segment),
                start,
                range(substeps // 2),
                observe=lambda s: None,
                checkpointed=checkpointed,
            )
        final.x.square().sum().backward()
    assert v.grad.abs().max() > 0
    return memory.peak


def test_checkpoints_bound_the_memory() -> None:
    """Twelve substeps in segments of two need well under half of the whole graph, in both kinds of loop."""
    whole = peak_memory(12, None)
    assert whole > 1.8 * peak_memory(6, None), "without segments memory must grow with the number of substeps"
    segmented = peak_memory(12, 2)
    assert segmented < 0.4 * whole
    assert peak_memory(24, 2) < 1.4 * segmented
    assert peak_memory(12, None, checkpointed=True) < 0.4 * whole


class Learned(torch.nn.Module):
    """A law whose stiffness is a parameter of a module."""

    def __init__(self) -> None:
        super().__init__()
        self.mu = torch.nn.Parameter(torch.tensor([500.0], dtype=torch.float64))
        self.register_buffer("scale", torch.ones(1, dtype=torch.float64))
        self.lam = torch.tensor([50.0], dtype=torch.float64)
        for name in METHODS:
            setattr(self, name, partial(self.call, name))

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(Elastic(self.mu * self.scale, self.lam), method)(*arguments)


@dataclass
class Wrapped:
    """A law that holds another one."""

    base: Learned

    def __getattr__(self, name: str) -> Any:
        return getattr(self.base, name)


@pytest.mark.parametrize("name", ["mu", "scale", "lam"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_a_change_between_a_step_of_a_learned_law_and_its_gradient_is_refused(name: str, wrapped: bool) -> None:
    """Such as that of an optimiser."""
    law = Learned()
    solver = robot(5, bodies=(Body(5, Wrapped(law) if wrapped else law, mass=2.0),), backend="eager")
    final = solver.step(lively(5), substeps=11)
    final.x.square().sum().backward(retain_graph=True)
    assert law.mu.grad.abs().item() > 0
    with torch.no_grad():
        getattr(law, name).mul_(0.5)
    with pytest.raises(RuntimeError, match=CHANGED):
        final.x.square().sum().backward()


class Differentiated(Learned):
    """A law that differentiates its energy itself."""

    def call(self, method: str, *arguments: Any) -> Any:
        if method != "stress":
            return super().call(method, *arguments)
        F, Jp = arguments
        with torch.enable_grad():
            F = tuple(f if f.requires_grad else f.detach().requires_grad_() for f in F)
            a, b, c, d = torch.autograd.grad(self.energy(F, Jp).sum(), F, create_graph=True)
        return a * F[0] + b * F[1], a * F[2] + b * F[3], c * F[2] + d * F[3]


@pytest.mark.parametrize("segment", [None, 2])
def test_the_first_step_of_a_law_that_differentiates_its_energy_is_replayed(segment: int | None) -> None:
    found = []
    for law in (Learned(), Differentiated()):
        solver = robot(5, bodies=(Body(5, law, mass=2.0),), backend="eager")

        def step(state: ParticleState, _: int, solver: Solver = solver) -> ParticleState:
            return solver.step(state, substeps=5, segment=segment)

        final, _ = trajectory(step, lively(5), range(2), observe=lambda state: None)
        final.x.square().sum().backward()
        found.append(law.mu.grad)
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("loop", ["step", "trajectory", "repeated"])
@pytest.mark.parametrize("backend", ["eager", NATIVE])
@pytest.mark.parametrize("name", ["mu", "mass", "volume", "gravity", "origin", "actuation"])
def test_what_a_step_reads_must_last(name: str, backend: str, loop: str) -> None:
    """Until its replay in the backward pass, however few its substeps are; a change after the gradient is no error.

    A step alone copies some of it, so that changes do no harm.
    """
    tensors = {
        "mu": torch.full((1,), 500.0, dtype=torch.float64),
        "mass": torch.tensor(2.0, dtype=torch.float64),
        "volume": torch.ones(1, dtype=torch.float64),
        "gravity": torch.tensor([0.5, -9.8], dtype=torch.float64),
        "origin": torch.zeros(1, 2, dtype=torch.float64),
        "actuation": normal(1, 2, 16, 16, seed=1),
    }
    body = Body(5, Elastic(tensors["mu"], 50.0), mass=tensors["mass"], volume=tensors["volume"], muscle=True)
    solver = robot(5, bodies=(body,), gravity=tensors["gravity"], backend=backend)
    v = lively(5).v.requires_grad_()

    def step(s: ParticleState, substeps: int = 2) -> ParticleState:
        # Views of its own, which are gone when the step is replayed.
        return solver.step(s, tensors["actuation"][:], substeps=substeps, origin=tensors["origin"][:])

    start = replace(lively(5), v=v)
    if loop == "step":
        final = step(start, 11)
    elif loop == "trajectory":
        final, _ = trajectory(lambda s, _: step(s), start, range(3), observe=lambda s: None)
    else:
        final = repeated(step, start, 3, segment=1)
    (before,) = torch.autograd.grad(final.x.sum(), v, retain_graph=True)
    tensors[name].mul_(0.5).add_(0.01)
    copied = ("gravity", "actuation") if backend == "eager" else ("mu", "mass", "volume")
    if loop == "step" and name in copied:
        assert torch.equal(torch.autograd.grad(final.x.sum(), v)[0], before)
    else:
        with pytest.raises(RuntimeError, match=CHANGED):
            final.x.sum().backward()


@pytest.mark.parametrize("backend", ["eager", NATIVE])
def test_constants_that_a_step_makes_itself_are_made_again(backend: str) -> None:
    """Solvers may be gone before the backward pass."""
    log_mu, state = torch.tensor(6.0, dtype=torch.float64, requires_grad=True), lively(5)

    def step(s: ParticleState, _: int) -> ParticleState:
        body = Body(5, Elastic(log_mu.exp(), 50.0), mass=2.0)
        return robot(5, bodies=(body,), dt=9e-5, backend=backend).step(s, substeps=3)

    gradients = []
    for checkpointed in (False, True):
        final, _ = trajectory(step, state, range(3), observe=lambda s: None, checkpointed=checkpointed)
        gc.collect()
        gradients += torch.autograd.grad(final.F.square().sum(), log_mu)
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=0)


@pytest.mark.parametrize("given", ["shared", "closure"])
def test_a_replay_is_in_the_precision_of_the_step(given: str) -> None:
    """That of autocast, which has ended when the replay begins."""
    weights, x = normal(8, 8, seed=0, dtype=torch.float32).requires_grad_(), normal(4, 8, seed=1, dtype=torch.float32)

    def step(weights: Tensor, x: Tensor) -> Tensor:
        return torch.tanh(0.3 * (x @ weights).float())

    gradients = []
    for segment in (None, 2):
        with torch.autocast("cpu", torch.bfloat16):
            if given == "shared":
                final = repeated(step, x, 6, segment=segment, shared=weights)
            else:
                final = repeated(partial(step, weights), x, 6, segment=segment)
        gradients += torch.autograd.grad(final.square().sum(), weights)
    assert torch.equal(*gradients)


def test_a_state_of_inference_mode_is_replayed() -> None:
    solver = replace(robot(20), backend="eager")
    with torch.inference_mode():
        state = solver.step(lively(20), substeps=1)
    field = torch.zeros(1, 2, 16, 16, dtype=torch.float64, requires_grad=True)
    solver.step(state, field, substeps=25).x.sum().backward()
    assert field.grad is not None and field.grad.any()
