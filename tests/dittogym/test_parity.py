"""Recorded episodes of the reference implementation, replayed."""

import numpy as np
import pytest
import recordings
import torch

import dittogym

TASKS = tuple(dittogym.TASKS)
SMALL = [f"{task}-coarse-small-f64" for task in TASKS]
DRIVEN = [f"{task}-coarse-full-sine-f32" for task in TASKS if task != "shapematch"]  # was not recorded
AT_REST = [f"{task}-coarse-full-zeros-f32" for task in TASKS]


def check(name: str, errors: dict[str, float], bounds: dict[str, float]) -> None:
    exceeded = {q: (error, bounds[q]) for q, error in errors.items() if q in bounds and not error <= bounds[q]}
    assert errors.keys() & bounds.keys(), f"{name}: nothing was compared"
    assert not exceeded, f"{name}: (error, bound) {exceeded}"


@pytest.mark.parametrize("name", SMALL)
@torch.no_grad()
def test_substeps_in_float64(name: str) -> None:
    check(name, recordings.substep_errors(recordings.load(name)), recordings.SMALL)


@pytest.mark.parametrize("name", SMALL + DRIVEN + AT_REST)
@torch.no_grad()
def test_episode(name: str) -> None:
    check(name, recordings.episode_errors(recordings.load(name)), recordings.EPISODE)


@pytest.mark.skipif(not recordings.FOLDER.is_dir(), reason=f"needs the complete recordings in {recordings.FOLDER}")
@pytest.mark.parametrize("name", SMALL + DRIVEN + AT_REST)
def test_the_extract_is_of_the_complete_recordings(name: str) -> None:
    found, expected = recordings.load_extract(name), recordings.extract(recordings.load(name))
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)
