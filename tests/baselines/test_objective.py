import dataclasses

import cv2
import numpy as np
import pytest
import torch

from baselines.trajectory.objective import Objective, gaussian_matrix
from dittogym import TorchEnv, make_spec
from dittogym.rewards import Reward


@pytest.mark.parametrize("sigma", [0.0, 1.0, 3.5])
def test_blur_is_a_gaussian_with_empty_surroundings(sigma):
    picture = np.random.default_rng(0).random((64, 64))
    matrix = gaussian_matrix(sigma, 64)
    ours = (matrix @ torch.from_numpy(picture) @ matrix.T).numpy()
    theirs = picture
    if sigma:
        theirs = cv2.GaussianBlur(picture, (63, 63), sigma, borderType=cv2.BORDER_CONSTANT)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_loss_counts_the_pixels_that_differ():
    """Without blur it is the task's own measure: 0.1 for each of 4096 pixels, up to the soft edge."""
    env = TorchEnv("shapematch", resolution=8, particles="lite", substeps=1)
    env.reset(seed=0)
    with torch.no_grad():
        reward = env.step(torch.zeros(1, 2, 8, 8))[4]["reward_terms"]["mismatch"]
    loss = Objective(env, (0.0,))(env, reward, 0.0)
    assert 409.6 * loss.item() == pytest.approx(-reward.item(), rel=0.15)


def test_blurs_follow_one_another():
    env = TorchEnv("shapematch", resolution=8, particles=300, substeps=1)
    env.reset(seed=0)
    both, reward = Objective(env, (4.0, 0.0)), torch.zeros(1)
    for progress, blur in ((0.0, 4.0), (0.49, 4.0), (0.5, 0.0), (1.0, 0.0)):
        assert both(env, reward, progress) == Objective(env, (blur,))(env, reward, 0.0)


def test_tasks_without_a_picture_minimise_the_negative_reward():
    env = TorchEnv("run", resolution=8, particles=100, substeps=1)
    assert Objective(env, (0.0,))(env, torch.tensor([2.5]), 0.5).tolist() == [-2.5]


def test_the_reward_of_a_task_derived_from_shape_match_counts():
    def drift(transition, spec):
        return Reward({"drift": transition.now.com[:, 0]})

    spec = dataclasses.replace(make_spec("shapematch"), name="drift", reward_fn=drift, weights={"drift": 1.0})
    env = TorchEnv(spec, resolution=8, particles=100, substeps=1)
    env.reset(seed=0)
    reward = torch.ones(1)
    assert Objective(env, (0.0,))(env, reward, 0.0) == -reward
