"""One training by each learner for all tests that only look at a finished run."""

import pytest
import torch
from short_episodes import short_episodes
from tiny_runs import run


def trained(tmp_path_factory, learner):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in the tests that repeat it
    folder = tmp_path_factory.mktemp("runs") / "whole"
    with short_episodes():
        assert run(folder, learner=learner) == 0
    torch.set_num_threads(threads)
    return folder


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    return trained(tmp_path_factory, "sac")


@pytest.fixture(scope="session")
def finished_analytic(tmp_path_factory):
    return trained(tmp_path_factory, "analytic")
