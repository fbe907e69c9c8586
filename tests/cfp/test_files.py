import errno
import json
from pathlib import Path

import pytest

from cfp.errors import CheckpointError
from cfp.files import write_atomically, write_json
from cfp.tables import CSVTable, read_table


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt("value.json")])
def test_interrupted_write_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})

    def fail(file):
        file.write(b"half")
        raise error

    with pytest.raises(type(error), match=r"value\.json"):
        write_atomically(path, fail)
    assert [item.name for item in tmp_path.iterdir()] == ["value.json"]
    assert json.loads(path.read_text()) == {"a": 1}


def test_two_may_write_the_same_file(tmp_path):
    path = tmp_path / "value.json"

    def write(file):
        file.write(b'{"a": ')
        write_atomically(path, lambda other: other.write(b'{"a": 1}'), shared=True)
        file.write(b"2}")

    write_atomically(path, write, shared=True)
    assert json.loads(path.read_text()) == {"a": 2} and [item.name for item in tmp_path.iterdir()] == ["value.json"]


def test_table_grows_rows_and_columns(tmp_path):
    table = CSVTable(tmp_path / "t.csv", last_step=0)
    table.add({"step": 1, "a": 0.5})
    table.add({"step": 2, "a": None})
    table.add({"step": 3, "a": 1, "b": "x,y"})
    assert (tmp_path / "t.csv").read_text().splitlines() == ["step,a,b", "1,0.5,", "2,,", '3,1,"x,y"']


def test_resumed_table_drops_rows_past_the_checkpoint(tmp_path):
    table = CSVTable(tmp_path / "t.csv", last_step=0)
    for step in (10, 20, 30):
        table.add({"step": step, "a": step})
    again = CSVTable(tmp_path / "t.csv", last_step=20)
    again.add({"step": 25, "a": 1})
    assert [row["step"] for row in read_table(tmp_path / "t.csv")] == ["10", "20", "25"]


def test_line_cut_short_by_a_crash_is_left_out(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("step,a\r\n10,1\r\n20,")
    assert read_table(path) == [{"step": "10", "a": "1"}]
    CSVTable(path, last_step=30).add({"step": 20, "a": 2})
    assert [row["a"] for row in read_table(path)] == ["1", "2"]


@pytest.mark.parametrize("content", [b"step,a\nabc,1\n", b"step,a\n\xff\xfe,1\n", b"step;a\n1;2\n"])
def test_damaged_table_is_named(tmp_path, content):
    path = tmp_path / "evaluations.csv"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"evaluations\.csv"):
        CSVTable(path, last_step=30)
    assert path.read_bytes() == content


def test_table_that_a_spreadsheet_has_saved_is_read(tmp_path):
    path = tmp_path / "evaluations.csv"
    path.write_bytes("\ufeffstep,a\r\n10,1\r\n".encode())
    assert CSVTable(path, last_step=30).rows == [{"step": "10", "a": "1"}]


def test_links_in_a_folder_of_a_stranger_are_not_written_through(tmp_path):
    mine, folder = tmp_path / "mine.txt", tmp_path / "run"
    mine.write_text("precious")
    folder.mkdir()
    for name in ("config.json", "config.json.part"):
        (folder / name).symlink_to(mine)
    write_json(folder / "config.json", {"a": 1})
    assert mine.read_text() == "precious"
    assert json.loads((folder / "config.json").read_text()) == {"a": 1}


def test_row_that_no_longer_fits_names_the_file(tmp_path, monkeypatch):
    table = CSVTable(tmp_path / "t.csv", last_step=0)
    table.add({"step": 1})
    table.path = Path("/dev/full")
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        table.add({"step": 2})
