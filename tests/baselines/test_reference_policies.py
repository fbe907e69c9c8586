"""Reference policies, and single stages of the coarse-to-fine policy."""

import numpy as np
import pytest
import torch

from baselines import train
from baselines.common.reference_policies import REFERENCE_POLICIES, wave
from baselines.registry import configure
from cfp.tables import read_table
from dittogym.action import patch_field, to_grid_layout
from dittogym.rewards import action_cost

IMAGES = np.zeros((2, 3, 64, 64), np.uint8)


def reference(algo, **values):
    return REFERENCE_POLICIES[algo](configure({"algo": "coarse", "task": "shapematch", **values}))


def test_zero_leaves_every_muscle_slack():
    actions, _ = reference("zero").predict(IMAGES)
    assert actions.shape == (2, 2, 32, 32) and not actions.any()


def test_random_differs_by_seed_only():
    policy, draws = reference("random"), []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        draws.append(policy.predict(IMAGES)[0])
    assert draws[0].shape == (2, 2, 32, 32) and np.array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2]) and not np.array_equal(draws[0][0], draws[0][1])
    assert abs(draws[0].mean()) < 0.05 and draws[0].min() < -0.99 and draws[0].max() > 0.99


def test_wave_is_the_one_of_the_reference_figures():
    drive = wave(3, 8, "grid")
    assert drive[0, 1, 2, 3] == pytest.approx(np.sin(0.3 + 1.4 + 3.3 + 2.0), abs=1e-6)
    for layout in ("image", "grid"):
        field = patch_field(to_grid_layout(wave(1, 8, layout), layout), 64, 45.0)  # RUN's muscles
        assert torch.allclose(field[0, 0, :, 5], patch_field(drive[:1], 64, 45.0)[0, 0, :, 5], atol=1e-4)
        assert float(action_cost(field)) == pytest.approx(4115.537, rel=1e-5)


def test_scripted_drives_the_whole_episode_in_the_layout_of_the_environment():
    policy = reference("scripted", action_layout="grid")
    memory = None
    for step in range(30):
        actions, memory = policy.predict(IMAGES, memory)
        assert np.allclose(actions[1], wave(30, 32, "grid")[step])


@pytest.mark.slow
def test_coarse_is_the_first_stage_and_goes_on(tmp_path):
    """With one seed the curves of coarse and CFP are the same up to the handover."""
    options = (
        "--particles 100 --substeps 2 --eval-episodes 2 --no-video --device cpu --num-envs 2 --batch-size 4 --steps 60 "
        "--buffer-size 80 --update-start 8 --gradient-steps 1 --critics-first 0 --final-rate 1 --eval-every 10 "
    )
    two = "--resolutions 4 8 --random-steps 10 4 --handover 0.667"
    curves = []
    for algo, stages in (("coarse", "--resolutions 4 --random-steps 10"), ("cfp-sac", two)):
        assert train.main([*f"--algo {algo} {options} {stages}".split(), "--out", str(tmp_path / algo)]) == 0
        curves.append(read_table(tmp_path / algo / "evaluations.csv"))
    first = [row for row in curves[1] if row["stage"] == "1"]
    assert len(first) == 4 and curves[0][:4] == first and [row["step"] for row in curves[0][4:]] == ["50", "60"]
