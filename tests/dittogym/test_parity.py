"""Recorded episodes of the reference implementation, replayed."""

import numpy as np
import pytest
import recordings
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
    check(name, recordings.substep_errors(recordings.load(name)), recordings.SMALL)


@pytest.mark.parametrize("name", [f"{task}-coarse-small-f64" for task in TASKS] + list(RECORDED))
@torch.no_grad()
def test_episode(name: str) -> None:
    check(name, recordings.episode_errors(recordings.load(name)), recordings.EPISODE)


@torch.no_grad()
def test_the_extract_without_the_complete_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "FOLDER", recordings.EXTRACT)  # no folder
    name = "grow-coarse-small-f64"
    data = recordings.load(name)
    assert len(data["sub1_x"]) < 100, "not the extract"
    check(name, recordings.substep_errors(data), recordings.SMALL)
    check(name, recordings.episode_errors(data), recordings.EPISODE)


@pytest.mark.skipif(not recordings.FOLDER.is_dir(), reason=f"needs the complete recordings in {recordings.FOLDER}")
@pytest.mark.parametrize("name", [f"{task}-coarse-small-f64" for task in TASKS] + list(RECORDED))
def test_the_extract_is_of_the_complete_recordings(name: str) -> None:
    found, expected = recordings.load_extract(name), recordings.extract(recordings.load(name))
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)


@torch.no_grad()
def test_the_comparison_can_fail() -> None:
    """Actions one percent stronger exceed the bounds."""
    data = recordings.load("run-coarse-small-f64")
    data["actions"] = data["actions"] * np.float32(1.01)
    errors = recordings.episode_errors(data)
    assert any(error > recordings.EPISODE[quantity] for quantity, error in errors.items())
