"""The whole way of a step to the CUDA kernels and back: on a GPU, and elsewhere on an imitation of one."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
from cuda_drivers import Imitation, in_use
from native_scenes import NAMES, moving, solvers
from scenes import assert_close

from torchmpm.backends import compiler_found

pytestmark = pytest.mark.skipif(not compiler_found(), reason="no C++ compiler")


@pytest.fixture(autouse=True)
def imitation() -> Iterator[None]:
    with in_use(Imitation()):
        yield


@pytest.mark.parametrize("name", NAMES)
def test_equals_eager(name: str) -> None:
    state, field, origin = moving(45, 2)
    solver = solvers(45, 2)[name]
    native, eager = (
        replace(solver, backend=backend).step(state, field, substeps=5, origin=origin)
        for backend in ("native", "eager")
    )
    assert_close(native, eager, 1e-10)
