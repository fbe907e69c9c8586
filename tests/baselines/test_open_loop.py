import numpy as np
import pytest
import torch

import baselines
from baselines import OpenLoop
from baselines.registry import configure
from cfp.errors import CheckpointError
from cfp.policy import describe_run


@pytest.fixture
def policy():
    actions = torch.arange(3 * 2 * 4 * 4).reshape(3, 2, 4, 4) / 100.0
    return OpenLoop(actions, describe_run(configure({"algo": "gradient", "task": "run"}), "gradient", 1, 0))


def test_each_element_plays_from_its_own_beginning(policy):
    images = np.zeros((2, 3, 64, 64), np.uint8)
    first, state = policy.predict(images, None, np.array([True, True]))
    second, state = policy.predict(images, state, np.array([False, True]))
    third, state = policy.predict(images, state, np.array([False, False]))
    slack, state = policy.predict(images, state, np.array([False, False]))
    expected = policy.actions.numpy()
    np.testing.assert_array_equal(first, expected[[0, 0]])
    np.testing.assert_array_equal(second, expected[[1, 0]])
    np.testing.assert_array_equal(third, expected[[2, 1]])
    np.testing.assert_array_equal(slack, np.stack((np.zeros_like(expected[0]), expected[2])))
    assert state[0].tolist() == [4, 3]


def test_single_image_gets_a_single_action(policy):
    action, state = policy.predict(np.zeros((3, 64, 64), np.uint8))
    np.testing.assert_array_equal(action, policy.actions[0].numpy())
    action, _ = policy.predict(np.zeros((3, 64, 64), np.uint8), state)
    np.testing.assert_array_equal(action, policy.actions[1].numpy())


def test_file_holds_what_was_saved(policy, tmp_path):
    policy.save(tmp_path / "policy.safetensors")
    again = baselines.load(tmp_path)
    assert torch.equal(again.actions, policy.actions)
    for name in ("kind", "task", "resolution", "steps", "seed"):
        assert again.description[name] == policy.description[name]


def test_file_without_actions_is_refused(tmp_path):
    wrong = OpenLoop(torch.zeros(1, 2, 4, 4), describe_run(configure({}), "cfp", 1, 0))
    wrong.save(tmp_path / "policy.safetensors")
    with pytest.raises(CheckpointError, match="weights and description do not match"):
        baselines.load(tmp_path)  # says that it is an actor


def test_wrong_shape_is_named():
    with pytest.raises(ValueError, match=r"actions must have shape \(T, 2, R, R\), got \(3, 2, 4, 5\)"):
        OpenLoop(torch.zeros(3, 2, 4, 5))
