"""Files that hold for the plain substep and for the kernels alike run once with each."""

from collections.abc import Iterator

import pytest
import scenes

from torchmpm.native.library import find_compiler


@pytest.fixture(scope="module", params=["eager", "native"])
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """The backend of all solvers made by :mod:`scenes`; ask for it with ``pytestmark``."""
    if request.param == "native" and not find_compiler():
        pytest.skip("no C++ compiler")
    scenes.BACKEND, before = request.param, scenes.BACKEND
    yield request.param
    scenes.BACKEND = before
