"""One training for all tests that only look at a finished run."""

import pytest
import torch
from short_episodes import short_episodes
from tiny_runs import run


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in the tests that repeat it
    folder = tmp_path_factory.mktemp("runs") / "whole"
    with short_episodes():
        assert run(folder) == 0
    torch.set_num_threads(threads)
    return folder
