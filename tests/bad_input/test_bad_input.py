"""Every case of bad input gets an error that names the argument, what was given and what is allowed."""

import bad_environments
import bad_files
import bad_programs
import pytest
from bad_cases import Desk, make_trained, snapshot

CASES = [*bad_environments.CASES, *bad_files.CASES, *bad_programs.CASES]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return make_trained(tmp_path_factory.mktemp("trained") / "run")


def test_the_table_names_each_case_once():
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name.replace(" ", "-"))
def test_bad_input_is_refused_by_name(case, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    desk = Desk(tmp_path, trained)
    message = case.message(desk)
    for words in case.words:
        assert words in message
    after = {
        path: content for path, content in snapshot(tmp_path).items() if path in desk.before or case.leaves not in path
    }
    assert after == desk.before  # nothing was left behind, nothing touched
