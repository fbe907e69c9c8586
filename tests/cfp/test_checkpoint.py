from dataclasses import replace

import pytest
import torch
from fakes import FakeEnv
from stable_baselines3.common.callbacks import BaseCallback

from cfp.agent.hyperparameters import Hyperparameters
from cfp.agent.policies import CFPPolicy
from cfp.envs.vec_env import monitored
from cfp.errors import CheckpointError
from cfp.experiment.algorithm import Position
from cfp.experiment.checkpoint import Checkpoint
from cfp.experiment.sac_learner import SACLearner
from cfp.presets import sac_preset

CONFIG = replace(sac_preset("shapematch"), resolutions=(4, 8), gate_bias=(-1.0,), device="cpu")


def make(stage=2):
    # The ring (20 rows) wraps around, and 7 does not divide anything: episodes are in progress at every checkpoint.
    env = monitored(FakeEnv(num_envs=2, resolution=CONFIG.action_size(stage), horizon=7))
    spec = CONFIG.actor_spec(stage)
    hyperparameters = Hyperparameters(buffer_size=40, batch_size=4, update_start=6, random_steps=10, gate_penalty=0.1)
    return SACLearner(CONFIG, stage, env, CFPPolicy, {"spec": spec}, hyperparameters)


class Hook(BaseCallback):
    """Calls a function between two rollouts."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self.function(self.model)


def assert_same(first, second, path="state"):
    assert type(first) is type(second), path
    if isinstance(first, dict):
        assert first.keys() == second.keys(), path
        for key in first:
            assert_same(first[key], second[key], f"{path}.{key}")
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), path
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_same(*pair, f"{path}.{index}")
    elif isinstance(first, torch.Tensor):
        assert torch.equal(first, second), path
    elif not path.endswith(".t"):  # wall time of an episode
        assert first == second, path


@pytest.mark.parametrize("stop", [8, *(pytest.param(late, marks=pytest.mark.slow) for late in (22, 50))])
def test_resumed_training_equals_uninterrupted_training_to_the_last_bit(tmp_path, stop):
    checkpoint = Checkpoint(tmp_path)

    def save(_):
        if algorithm.num_timesteps == stop:
            checkpoint.save(algorithm, CONFIG, Position(2, 100))

    algorithm = make()
    algorithm.learn(70, Hook(save))
    resumed = make()
    torch.rand(5)  # generators are somewhere else
    state = Checkpoint(tmp_path).read()
    assert (state["stage"], state["offset"]) == (2, 100)
    Checkpoint(tmp_path).restore(resumed, state)
    assert resumed.num_timesteps == stop
    resumed.learn(70 - stop)
    assert_same(resumed.state_dict(), algorithm.state_dict())
    batch, again = algorithm.replay_buffer.sample(4), resumed.replay_buffer.sample(4)
    assert all(torch.equal(*pair) for pair in zip(batch[:5], again[:5], strict=True))


@pytest.mark.parametrize(
    "writer", ["cfp.experiment.checkpoint.write_atomically", "cfp.experiment.replay_archive.write_atomically"]
)
def test_checkpoint_survives_a_crash_while_the_next_is_written(tmp_path, monkeypatch, writer):
    checkpoint, algorithm = Checkpoint(tmp_path), make()
    algorithm.learn(20)
    checkpoint.save(algorithm, CONFIG, Position(2))
    algorithm.learn(30)

    def crash(path, write):
        path.with_name(path.name + ".part").write_bytes(b"half a file")
        raise OSError("No space left on device")

    monkeypatch.setattr(writer, crash)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(algorithm, CONFIG, Position(2))
    monkeypatch.undo()
    other = make()
    Checkpoint(tmp_path).restore(other, Checkpoint(tmp_path).read())
    assert other.num_timesteps == 20
    assert other.replay_buffer.size() == 10


def test_next_stage_replaces_the_replay_of_the_last(tmp_path):
    checkpoint, coarse, fine = Checkpoint(tmp_path), make(1), make(2)
    coarse.learn(12)
    checkpoint.save(coarse, CONFIG, Position(1))
    fine.learn(8)
    checkpoint.save(fine, CONFIG, Position(2, 12))
    assert [path.name for path in (tmp_path / "replay").iterdir()] == ["stage2-000000000-000000004.npz"]
    state = Checkpoint(tmp_path).read()
    other = make(2)
    Checkpoint(tmp_path).restore(other, state)
    assert other.replay_buffer.size() == 4


def test_state_of_another_network_is_refused(tmp_path):
    checkpoint, algorithm = Checkpoint(tmp_path), make(2)
    algorithm.learn(8)
    checkpoint.save(algorithm, CONFIG, Position(2))
    with pytest.raises(CheckpointError, match="does not fit"):
        checkpoint.restore(make(1), checkpoint.read())
