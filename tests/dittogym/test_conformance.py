"""Published figures of the reference implementation for its seed 0, kept here so that they are tested anywhere."""

import numpy as np
import pytest
import torch

import dittogym

#: task: (first robot particle, sum of the occupancy channel of the first observation)
LAYOUT = {"shapematch": ((0.531649, 0.635818), 44911), "run": ((0.139393, 0.303807), 57788)}
#: task: rewards of steps 1, 2, 3, 5 at rest
REST = {"run": (3.0, 3.0, 3.0001, 2.9789), "shapematch": (1.0, 1.0, 1.0, 1.0)}
#: task: rewards of steps 1, 2, 5, 10 under the drive; centre and split after 10; action norm of step 1; channel sums
DRIVE = {
    "run": (
        (2.1769, 2.1763, 2.1771, 1.9352),
        (0.089831, 0.248279),
        0.067400,
        4115.537,
        (58040, 539921, 546293),
    ),
}


@pytest.mark.parametrize("task", LAYOUT)
def test_layout_and_first_observation_of_seed_0(task: str) -> None:
    env = dittogym.TorchEnv(task, 1, action_layout="grid")
    observation, _ = env.reset(seed=0)
    particle, occupancy = LAYOUT[task]
    assert env.state.x[0, 0].tolist() == pytest.approx(particle, abs=1e-6)
    assert observation[0].flatten(1).sum(1).tolist() == [occupancy, 132 * 4096, 132 * 4096]


@pytest.mark.parametrize("task", REST)
@torch.no_grad()
def test_rewards_at_rest(task: str) -> None:
    env = dittogym.TorchEnv(task, 1)
    env.reset(seed=0)
    rewards = [float(env.step(torch.zeros(1, *env.action_shape))[1]) for _ in range(5)]
    assert [rewards[i] for i in (0, 1, 2, 4)] == pytest.approx(REST[task], abs=1e-3)


@pytest.mark.parametrize("task", DRIVE)
@torch.no_grad()
def test_deterministic_drive(task: str) -> None:
    env = dittogym.TorchEnv(task, 1, action_layout="grid")
    env.reset(seed=0)
    c, r, s = np.indices(env.action_shape)
    rewards, norms = [], []
    for t in range(1, 11):
        action = torch.as_tensor(np.sin(0.3 * t + 0.7 * r + 1.1 * s + 2 * c), dtype=torch.float32)[None]
        observation, reward, *_, info = env.step(action)
        rewards.append(float(reward))
        norms.append(-float(info["reward_terms"]["action"]) / env.spec.weights.action)
    wanted, com, split, norm, sums = DRIVE[task]
    assert [rewards[i] for i in (0, 1, 4, 9)] == pytest.approx(wanted, abs=1e-3)
    assert info["com"][0].tolist() == pytest.approx(com, abs=1e-5)
    assert float(info["split"]) == pytest.approx(split, abs=1e-5)
    assert norms[0] == pytest.approx(norm, rel=1e-5)
    assert observation[0].flatten(1).sum(1).tolist() == pytest.approx(sums, abs=50)
