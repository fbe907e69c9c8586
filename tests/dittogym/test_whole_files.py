"""Files of films, replays and episodes: the old one or the new one, whole."""

import pytest

from dittogym import files


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("last", [False, True])
def test_what_fails_leaves_the_old_file(tmp_path, monkeypatch, error: type[BaseException], last: bool) -> None:
    """Up to the last moment, in which the new file takes its place."""

    def fail(*paths):
        raise error("the robot is gone")

    path = tmp_path / "film.webp"
    path.write_text("old")
    monkeypatch.setattr(files.os, "replace", fail)
    with pytest.raises(error, match="the robot is gone"), files.replacing(path) as aside:
        aside.write_text("new")
        if not last:
            fail()
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_two_may_write_the_same_file(tmp_path) -> None:
    path = tmp_path / "film.webp"
    with files.replacing(path) as first:
        with files.replacing(path) as second:
            second.write_text("of the second")
        assert path.read_text() == "of the second"
        first.write_text("of the first")
    assert path.read_text() == "of the first" and list(tmp_path.iterdir()) == [path]
