"""Recorded episodes of the reference implementation, replayed."""

import numpy as np
import pytest
import recordings
import reference
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


def test_a_reset_leaves_what_the_reference_leaves() -> None:
    """The last image, the centre of the first action, and what CATCH's hand is chosen by; particles stay unit ones."""
    env = reference.make("catch", particles=(120, 30), substeps=4, dtype="float64")
    first, _ = env.reset(seed=0)
    for _ in range(3):
        last, *_ = env.step(np.ones(env.action_space.shape, np.float32))
    before = env.torch_env.env_state
    again, _ = env.reset()
    after, (robot, cube) = env.torch_env.env_state, env.torch_env.model.solver.bodies
    assert np.array_equal(again, last) and not np.array_equal(again, first)
    assert torch.equal(after.centre, before.centre) and not torch.equal(after.centre, after.start.com)
    assert torch.equal(after.task_state["object_com"], before.task_state["object_com"])
    assert (robot.volume, cube.volume, robot.mass, env.state.x.shape) == (1.0, 1.0, 2.0, (1, 150, 2))
