"""Recorded episodes of the reference implementation, replayed."""

import numpy as np
import pytest
import reference
import torch

import dittogym

TASKS = tuple(dittogym.TASKS)
RECORDED = tuple(
    f"{task}-coarse-full-{actions}-f32"
    for task in TASKS
    for actions in ("sine", "zeros")
    if (task, actions) != ("shapematch", "sine")  # was not recorded
)


def check(name: str, errors: dict[str, float], bounds: dict[str, float]) -> None:
    exceeded = {q: (error, bounds[q]) for q, error in errors.items() if q in bounds and not error <= bounds[q]}
    assert errors.keys() & bounds.keys(), f"{name}: nothing was compared"
    assert not exceeded, f"{name}: (error, bound) {exceeded}"


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_substeps_in_float64(task: str) -> None:
    name = f"{task}-coarse-small-f64"
    check(name, reference.substep_errors(reference.load(name)), reference.SMALL)


@pytest.mark.parametrize("name", [f"{task}-coarse-small-f64" for task in TASKS] + list(RECORDED))
@torch.no_grad()
def test_episode(name: str) -> None:
    check(name, reference.episode_errors(reference.load(name)), reference.EPISODE)


@torch.no_grad()
def test_the_comparison_can_fail() -> None:
    """Actions one percent stronger exceed the bounds."""
    data = reference.load("run-coarse-small-f64")
    data["actions"] = data["actions"] * np.float32(1.01)
    errors = reference.episode_errors(data)
    assert any(error > reference.EPISODE[quantity] for quantity, error in errors.items())
