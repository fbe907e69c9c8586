"""Settings shared by all tests."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import settings
from short_episodes import short_episodes
from torch import Tensor

from dittogym import TASKS, Reward, Transition, make_spec

settings.register_profile("torchmpm", deadline=None)  # the first call of an operator may compile or allocate
settings.load_profile("torchmpm")


os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1,localhost"  # servers of the tests


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Where there is no CUDA device, say so instead of failing."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(scope="module")
def short() -> Iterator[None]:
    """For modules whose tiny runs need no whole episodes."""
    with short_episodes():
        yield


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Tests run in as many processes as there are cores: more threads than that wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def restored_settings() -> Iterator[None]:
    """Tests may change torch's threads and default type."""
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    yield
    torch.set_num_threads(threads)
    torch.set_default_dtype(dtype)


@pytest.fixture
def own_task(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Registers RUN with another reward, a term as a function of the transition beside terms of the library."""

    def register(term: Callable[[Transition], Tensor], **weights: float) -> str:
        reward = {"reward_fn": lambda transition, spec: Reward({"own": term(transition)}), "weights": {"own": 1.0}}
        reward["weights"] |= weights
        monkeypatch.setitem(TASKS, "own", lambda: replace(make_spec("run"), name="own", **reward))
        return "own"

    return register


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium or Chrome without a window, driven by Playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(f"no browser found, of {', '.join(names)}")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield browser
        browser.close()
