import numpy as np
import pytest
from test_replay import fill, make_ring

from cfp.errors import CheckpointError
from cfp.experiment.replay_archive import ReplayArchive


def contents(ring):
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
    return {name: getattr(ring, name) for name in names} | {"pos": ring.pos, "full": ring.full}


def assert_same(first, second):
    for name, value in contents(first).items():
        np.testing.assert_array_equal(contents(second)[name], value, err_msg=name)


@pytest.mark.parametrize("saves", [(3, 7), (5, 8, 11, 14), (2, 20, 23)])
def test_ring_comes_back_from_its_chunks(tmp_path, saves):
    ring, archive, done = make_ring(), ReplayArchive(tmp_path, 1), 0
    for rows in saves:
        fill(ring, done, rows)
        done = rows
        chunks = archive.save(ring, rows)
        archive.prune()
        other = make_ring()
        ReplayArchive(tmp_path, 1).load(other, rows, chunks)
        assert_same(ring, other)
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(chunk["file"] for chunk in chunks)
        assert all(chunk["stop"] > rows - 6 for chunk in chunks)


def test_only_new_rows_are_written_and_old_files_never_change(tmp_path):
    ring, archive = make_ring(), ReplayArchive(tmp_path, 1)
    fill(ring, 0, 3)
    archive.save(ring, 3)
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in tmp_path.iterdir()}
    fill(ring, 3, 5)
    chunks = archive.save(ring, 5)
    assert [(chunk["start"], chunk["stop"]) for chunk in chunks] == [(0, 3), (3, 5)]
    assert all(
        ((tmp_path / name).stat().st_mtime_ns, (tmp_path / name).read_bytes()) == old for name, old in before.items()
    )


def test_chunks_of_the_last_checkpoint_outlive_the_next_save(tmp_path):
    ring, archive = make_ring(), ReplayArchive(tmp_path, 1)
    fill(ring, 0, 4)
    chunks = archive.save(ring, 4)
    kept = make_ring()
    fill(kept, 0, 4)
    fill(ring, 4, 16)
    archive.save(ring, 16)  # killed here: the state file still names the old chunks
    other = make_ring()
    ReplayArchive(tmp_path, 1).load(other, 4, chunks)
    assert_same(kept, other)


@pytest.mark.parametrize("damage", ["missing", "cut", "flipped"])
def test_damaged_chunk_is_named(tmp_path, damage):
    ring, archive = make_ring(), ReplayArchive(tmp_path, 1)
    fill(ring, 0, 4)
    chunks = archive.save(ring, 4)
    path = tmp_path / chunks[0]["file"]
    content = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    elif damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    else:
        content[len(content) // 2] ^= 0xFF
        path.write_bytes(content)
    with pytest.raises(CheckpointError, match=chunks[0]["file"]):
        ReplayArchive(tmp_path, 1).load(make_ring(), 4, chunks)


def test_gap_between_chunks_is_noticed(tmp_path):
    ring, archive = make_ring(), ReplayArchive(tmp_path, 1)
    for rows in (2, 4, 6):
        fill(ring, rows - 2, rows)
        chunks = archive.save(ring, rows)
    with pytest.raises(CheckpointError, match="rows 2 to 4"):
        ReplayArchive(tmp_path, 1).load(make_ring(), 6, [chunks[0], chunks[2]])
    with pytest.raises(CheckpointError, match="rows 4 to 6"):
        ReplayArchive(tmp_path, 1).load(make_ring(), 6, chunks[:2])


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
