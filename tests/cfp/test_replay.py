import numpy as np
import pytest
from gymnasium import spaces

from cfp.agent.replay import ReplayRing

SPACES = spaces.Box(0, 255, (3, 64, 64), np.uint8), spaces.Box(-1, 1, (2, 8, 8), np.float32)


def make_ring(rows=6, envs=2):
    return ReplayRing(rows * envs, *SPACES, device="cpu", n_envs=envs, seed=0)


def fill(ring, start, stop):
    """Store rows whose every number tells which row it is."""
    for row in range(start, stop):
        image = np.full((2, 3, 64, 64), row, np.uint8)
        action = np.full((2, 2, 8, 8), row / 100, np.float32)
        infos = [{"TimeLimit.truncated": row % 3 == 0}, {}]
        ring.add(image, image + 1, action, np.array([row, -row], np.float32), np.array([row % 2 == 0] * 2), infos)


def test_ring_keeps_next_observations():
    options = {"device": "cpu", "n_envs": 2, "handle_timeout_termination": False}
    with pytest.raises(ValueError, match="optimize_memory_usage must be False"):
        ReplayRing(12, *SPACES, optimize_memory_usage=True, **options)


def test_batch_has_no_repetition_and_keeps_rows_together():
    ring = make_ring()
    fill(ring, 0, 6)
    batch = ring.sample(12)
    assert sorted(batch.rewards[:, 0].tolist()) == sorted([float(r) for r in range(6)] + [-float(r) for r in range(6)])
    row = batch.rewards[:, 0].abs()
    assert (batch.observations[:, 0, 0, 0] == row).all()
    assert (batch.next_observations[:, 0, 0, 0] == row + 1).all()
    np.testing.assert_allclose(batch.actions[:, 0], row / 100, rtol=1e-6)
    first = batch.rewards[:, 0] > 0  # element 0 of the batch has the time limits, at rows 0, 3, ...
    limit = first & (row % 3 == 0)
    expected = ((row % 2 == 0) & ~limit & (row > 0)).float()
    assert (batch.dones[row > 0, 0] == expected[row > 0]).all()
    assert len(ring.sample(20).rewards) == 20
