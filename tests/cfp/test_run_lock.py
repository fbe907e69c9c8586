import os
import subprocess
import sys
from threading import Timer

import pytest

from cfp.experiment.run_lock import FolderInUse, run_lock

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


def holder(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "1\n"
    return process


def test_folder_is_held_by_one_process_until_it_ends(tmp_path):
    folder = tmp_path / "run"
    process = holder(folder)
    message = f"out: {folder} is in use by process {process.pid} on"
    try:
        for timeout in (0, 0.1):
            with pytest.raises(FolderInUse, match=message), run_lock(folder, timeout):
                pass
        Timer(0.3, process.kill).start()
        with run_lock(folder, 60):  # waits for it
            assert (folder / ".lock").read_text().startswith(f"process {os.getpid()} on ")
    finally:
        process.kill()
        process.communicate()
    assert folder.exists() and not list(folder.iterdir())


def test_new_folder_goes_again_if_nothing_was_written(tmp_path):
    with pytest.raises(ValueError, match="refused"), run_lock(tmp_path / "a" / "empty"):
        raise ValueError("refused")
    assert not (tmp_path / "a" / "empty").exists()
    with run_lock(tmp_path / "full"):
        (tmp_path / "full" / "file").touch()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["file"]


def test_lock_that_is_a_link_is_not_written_through(tmp_path):
    mine, folder = tmp_path / "mine.txt", tmp_path / "run"
    mine.write_text("precious")
    folder.mkdir()
    (folder / ".lock").symlink_to(mine)
    with pytest.raises(OSError, match=r"\.lock"), run_lock(folder):
        pass
    assert mine.read_text() == "precious"
