"""Settings shared by all tests."""

import pytest
import torch
from hypothesis import settings

settings.register_profile("torchmpm", deadline=None)  # the first call of an operator may compile or allocate
settings.load_profile("torchmpm")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Where there is no CUDA device, say so instead of failing."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("cuda"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
