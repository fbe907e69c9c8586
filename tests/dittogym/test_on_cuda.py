"""Environment steps on a GPU: recorded ones against others, where they wait, and streams."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from tiny import ALL, TASKS, actions, begun, on_edge, tiny

import dittogym
from dittogym.conditions import act, seen
from dittogym.cuda_graph import WARM_UP
from torchmpm import tree

pytestmark = pytest.mark.cuda


@contextmanager
def without_waiting() -> Iterator[None]:
    """An error where the host waits for the device."""
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def on_cuda(task: str, **options: object) -> dittogym.TorchEnv:
    env = begun(tiny(task, 3, particles=600, dtype="float32", device="cuda", **options))
    return env


def equal(ours: object, theirs: object) -> bool:
    pairs = zip(tree.leaves(ours), tree.leaves(theirs), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_a_recorded_step_is_the_same(task: str) -> None:
    ours, theirs = on_cuda(task), on_cuda(task)
    theirs._replayed = None
    mask = np.array([False, True, False])
    for given in actions(ours, WARM_UP + 4).to("cuda"):
        assert equal(ours.step(given), theirs.step(given)) and equal(ours.env_state, theirs.env_state)
        assert equal(ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask}))
    assert ours._replayed is not None and ours._replayed.failure is None


def test_conditions_are_those_of_the_cpu() -> None:
    """Draws agree, and images lose the same entries; the recorded step is the same."""
    ours = on_cuda("run", conditions=ALL)
    cpu = begun(tiny("run", 3, particles=600, dtype="float32", conditions=ALL))
    for name, value in cpu.env_state.conditions.items():
        assert (ours.env_state.conditions[name].cpu() - value).abs().max() <= 1e-6
    state, image = cpu.env_state.conditions, torch.ones(3, 3, 64, 64)
    on_device = {name: value.to("cuda") for name, value in state.items()}
    for step in range(3):
        steps, action = torch.full((3,), step), actions(cpu, 1, seed=step)[0]
        assert torch.equal(seen(on_device, steps.to("cuda"), image.to("cuda")).cpu(), seen(state, steps, image))
        acted, expected = (
            act(cpu.conditions, each, steps.to(device), action.to(device))[0].cpu()
            for device, each in (("cuda", on_device), ("cpu", state))
        )
        assert (acted - expected).abs().max() <= 1e-5


@torch.no_grad()
def test_a_disturbed_step_is_recorded_and_waits_for_nothing() -> None:
    ours, theirs = (on_cuda("run", conditions=ALL) for _ in range(2))
    theirs._replayed = None
    for given in actions(ours, WARM_UP + 4).to("cuda"):
        assert equal(ours.step(given), theirs.step(given)) and equal(ours.env_state, theirs.env_state)
    with without_waiting():
        ours.step(given)
    assert ours._replayed is not None and ours._replayed.failure is None


@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("gradients", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_a_step_waits_for_nothing(task: str, gradients: bool, soft: bool) -> None:
    env = on_cuda(task)
    given = actions(env, 1)[0].to("cuda").requires_grad_(gradients)
    with torch.set_grad_enabled(gradients):
        for _ in range(WARM_UP + 2):
            env.step(given, soft=soft)
            env.detach()
        with without_waiting():
            env.step(given, soft=soft)


@torch.no_grad()
def test_another_stream() -> None:
    ours, theirs = on_cuda("run"), on_cuda("run")
    theirs._replayed = None
    streams = torch.cuda.current_stream(), torch.cuda.Stream()
    for k, given in enumerate(actions(ours, WARM_UP + 8).to("cuda")):
        stream, before = streams[k % 2], streams[(k + 1) % 2]
        stream.wait_stream(before)
        with torch.cuda.stream(stream):
            step = ours.step(given)
        torch.cuda.synchronize()
        assert equal(step, theirs.step(given))


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("particles", ["lite", "full"])
@torch.no_grad()
def test_the_kernel_draws_what_torch_does(task: str, particles: str) -> None:
    env = begun(dittogym.TorchEnv(task, 2, particles=particles, device="cuda"))
    env.step(torch.ones(2, *env.action_shape, device="cuda"))
    state, camera = env.env_state, env.model.camera
    arrays = state.particles.x, state.particles.v, state.origin, state.centre
    difference = (camera.observe(*arrays).int() - camera.draw(*arrays).int()).abs()
    assert difference.max() <= 1 and (difference.bool() & ~on_edge(env)).double().mean() <= 1e-3
