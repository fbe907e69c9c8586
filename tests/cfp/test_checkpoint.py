"""The replay ring, its chunks on disk, checkpoints of both learners, and the lock of a folder."""

import errno
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeEnv
from gymnasium import spaces
from stable_baselines3.common.logger import Logger

from cfp import CFPPolicy, Hyperparameters
from cfp.envs.vec_env import monitored
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.checkpoint import Checkpoint, ReplayArchive
from cfp.experiment.folder import FolderInUse, run_lock
from cfp.files import write_atomically
from cfp.presets import sac_preset
from cfp.sac.learner import CFPSAC
from cfp.sac.replay import FIELDS, ReplayRing

SPACES = spaces.Box(0, 255, (3, 64, 64), np.uint8), spaces.Box(-1, 1, (2, 8, 8), np.float32)
SAC = replace(sac_preset("shapematch"), resolutions=(4, 8), gate_bias=(-1.0,), device="cpu")


def make_ring(rows=6, envs=2):
    return ReplayRing(rows * envs, *SPACES, device="cpu", n_envs=envs, seed=0)


def fill(ring, start, stop):
    """Store rows whose every number tells which row it is."""
    for row in range(start, stop):
        image = np.full((2, 3, 64, 64), row, np.uint8)
        action = np.full((2, 2, 8, 8), row / 100, np.float32)
        infos = [{"TimeLimit.truncated": row % 4 == 0}, {}]
        ring.add(image, image + 1, action, np.array([row, -row], np.float32), np.array([row % 2 == 0] * 2), infos)


def assert_same_ring(first, second):
    for name in (*FIELDS, "pos", "full"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name), err_msg=name)


def test_batch_has_no_repetition_and_keeps_rows_together():
    ring = make_ring()
    fill(ring, 0, 6)
    batch = ring.sample(12)
    assert sorted(batch.rewards[:, 0].tolist()) == sorted([float(r) for r in range(6)] + [-float(r) for r in range(6)])
    row = batch.rewards[:, 0].abs()
    assert (batch.observations[:, 0, 0, 0] == row).all()
    assert (batch.next_observations[:, 0, 0, 0] == row + 1).all()
    np.testing.assert_allclose(batch.actions[:, 0], row / 100, rtol=1e-6)
    first = batch.rewards[:, 0] > 0  # element 0 of the batch has the time limits, at rows 0, 4, ...
    limit = first & (row % 4 == 0)
    expected = ((row % 2 == 0) & ~limit & (row > 0)).float()
    assert (batch.dones[row > 0, 0] == expected[row > 0]).all()
    assert len(ring.sample(20).rewards) == 20
    with pytest.raises(ValueError, match="optimize_memory_usage must be False"):
        ReplayRing(12, *SPACES, optimize_memory_usage=True, handle_timeout_termination=False)


@pytest.mark.parametrize("saves", [(3, 7), (5, 8, 11, 14), (2, 20, 23)])
def test_ring_comes_back_from_its_chunks_which_never_change(tmp_path, saves):
    ring, archive, done, written = make_ring(), ReplayArchive(tmp_path, 1), 0, {}
    for rows in saves:
        fill(ring, done, rows)
        done = rows
        chunks = archive.save(ring, rows)
        assert all(path.read_bytes() == content for path, content in written.items())  # until they are pruned
        archive.prune()
        other = make_ring()
        ReplayArchive(tmp_path, 1).load(other, rows, chunks)
        assert_same_ring(ring, other)
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(chunk["file"] for chunk in chunks)
        assert all(chunk["stop"] > rows - 6 for chunk in chunks)
        written = {path: path.read_bytes() for path in tmp_path.iterdir()}


@pytest.mark.parametrize("damage", ["missing", "cut"])
def test_damaged_chunk_is_named(tmp_path, damage):
    ring = make_ring()
    fill(ring, 0, 4)
    chunks = ReplayArchive(tmp_path, 1).save(ring, 4)
    path = tmp_path / chunks[0]["file"]
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CheckpointError, match=chunks[0]["file"]):
        ReplayArchive(tmp_path, 1).load(make_ring(), 4, chunks)


def test_chunk_with_a_flipped_bit_is_refused_or_whole(tmp_path):
    ring, refused = make_ring(), 0
    fill(ring, 0, 4)
    chunks = ReplayArchive(tmp_path, 1).save(ring, 4)
    path = tmp_path / chunks[0]["file"]
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    for position in generator.choice(len(content), 500, replace=False):
        flipped = content[position] ^ (1 << generator.integers(8))
        path.write_bytes(content[:position] + bytes([flipped]) + content[position + 1 :])
        loaded = make_ring()
        try:
            ReplayArchive(tmp_path, 1).load(loaded, 4, chunks)
        except CheckpointError as error:
            assert path.name in str(error)
            refused += 1
        else:
            assert_same_ring(ring, loaded)
    assert refused > 200


def test_gap_between_chunks_is_noticed(tmp_path):
    ring, archive = make_ring(), ReplayArchive(tmp_path, 1)
    for rows in (2, 4, 6):
        fill(ring, rows - 2, rows)
        chunks = archive.save(ring, rows)
    with pytest.raises(CheckpointError, match="rows 2 to 4"):
        ReplayArchive(tmp_path, 1).load(make_ring(), 6, [chunks[0], chunks[2]])
    with pytest.raises(CheckpointError, match="rows 4 to 6"):
        ReplayArchive(tmp_path, 1).load(make_ring(), 6, chunks[:2])


def test_many_rows_are_several_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr("cfp.experiment.checkpoint.LARGEST_CHUNK", 4)
    ring, other = make_ring(), make_ring()
    fill(ring, 0, 5)
    chunks = ReplayArchive(tmp_path, 1).save(ring, 5)
    assert [chunk["stop"] - chunk["start"] for chunk in chunks] == [2, 2, 1]
    ReplayArchive(tmp_path, 1).load(other, 5, chunks)
    assert_same_ring(ring, other)


def test_pruning_deletes_chunks_only(tmp_path):
    """The folder of a stranger's run may be a link to one of mine."""
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    (tmp_path / "replay").symlink_to(mine)
    ring, archive = make_ring(), ReplayArchive(tmp_path / "replay", 1)
    fill(ring, 0, 4)
    chunks = archive.save(ring, 4)
    (mine / "stage1-000000000-000000002.npz").touch()
    archive.prune()
    assert sorted(path.name for path in mine.iterdir()) == [chunks[0]["file"], "thesis.tex"]


def make_sac(stage=2):
    # The ring (20 rows) wraps around, and 7 does not divide anything: episodes are in progress at every checkpoint.
    env = monitored(FakeEnv(num_envs=2, resolution=SAC.action_size(stage), horizon=7))
    own = Hyperparameters(buffer_size=40, batch_size=4, update_start=6, random_steps=10, gate_penalty=0.1)
    model = CFPSAC(CFPPolicy, env, own, seed=0, device="cpu", policy_kwargs={"spec": SAC.actor_spec(stage)})
    model.config, model.stage = SAC, stage
    model.set_logger(Logger(None, []))
    return model


@pytest.mark.parametrize("file", ["state.pt", "stage"])
def test_checkpoint_survives_a_crash_while_the_next_is_written(tmp_path, monkeypatch, file):
    checkpoint, model = Checkpoint(tmp_path), make_sac()
    model.learn(20)
    checkpoint.save(model, SAC, 0)
    model.learn(60, reset_num_timesteps=False)  # the ring holds none of the first rows any more

    def crash(path, write):
        if not path.name.startswith(file):
            return write_atomically(path, write)
        path.with_name(path.name + ".part").write_bytes(b"half a file")
        raise OSError("No space left on device")

    monkeypatch.setattr("cfp.experiment.checkpoint.write_atomically", crash)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(model, SAC, 0)
    monkeypatch.undo()
    other = make_sac()
    Checkpoint(tmp_path).restore(other, Checkpoint(tmp_path).read())
    assert (other.num_timesteps, other.replay_buffer.size()) == (20, 10)


def test_next_stage_replaces_the_replay_of_the_last_and_its_state_fits_no_other(tmp_path):
    checkpoint, coarse, fine, other = Checkpoint(tmp_path), make_sac(1), make_sac(2), make_sac(2)
    coarse.learn(12)
    checkpoint.save(coarse, SAC, 0)
    fine.learn(8)
    checkpoint.save(fine, SAC, 12)
    assert [path.name for path in (tmp_path / "replay").iterdir()] == ["stage2-000000000-000000004.npz"]
    Checkpoint(tmp_path).restore(other, Checkpoint(tmp_path).read())
    assert other.replay_buffer.size() == 4
    with pytest.raises(CheckpointError, match="does not fit"):
        checkpoint.restore(make_sac(1), checkpoint.read())


# What `run_lock` does, without the imports of the package, which take seconds.
HOLD = """
import os, sys
from pathlib import Path
from filelock import FileLock
folder = Path(sys.argv[1])
folder.mkdir()
with FileLock(folder / ".lock"):
    (folder / ".lock").write_text(f"process {os.getpid()} on a machine")
    print(1, flush=True)
    input()
"""


def test_folder_is_held_by_one_process_until_it_ends(tmp_path):
    folder, pipe = tmp_path / "run", subprocess.PIPE
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdin=pipe, stdout=pipe, text=True)
    assert process.stdout.readline() == "1\n"
    try:
        in_use = pytest.raises(FolderInUse, match=f"out: {folder} is in use by process {process.pid} on")
        with in_use, run_lock(folder):
            pass
    finally:
        process.kill()
        process.communicate()
    with run_lock(folder):
        assert (folder / ".lock").read_text().startswith(f"process {os.getpid()} on ")
    assert folder.exists() and not list(folder.iterdir())


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    def flock(descriptor, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(ConfigError, match=f"^out: {tmp_path}/run .*{os.strerror(errno.ENOLCK)}.*local disk"):
        with run_lock(tmp_path / "run"):
            pass


def test_new_folder_goes_again_if_nothing_was_written_and_a_linked_lock_is_left_alone(tmp_path):
    with pytest.raises(ValueError, match="refused"), run_lock(tmp_path / "a" / "empty"):
        raise ValueError("refused")
    assert not (tmp_path / "a" / "empty").exists()
    with run_lock(tmp_path / "full"):
        (tmp_path / "full" / "file").touch()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["file"]
    mine = tmp_path / "mine.txt"
    mine.write_text("precious")
    (tmp_path / "full" / ".lock").symlink_to(mine)
    with pytest.raises(OSError, match=r"\.lock"), run_lock(tmp_path / "full"):
        pass
    assert mine.read_text() == "precious"
