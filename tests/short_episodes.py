"""SHAPE MATCH with short episodes: half of the time of a tiny training is that of its evaluations."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from dittogym import TaskSpec

HORIZON = 8


@contextmanager
def short_episodes() -> Iterator[None]:
    """Episodes of `HORIZON` instead of 30 steps, in this process."""

    def shortened(**fields: Any) -> TaskSpec:
        return TaskSpec(**{**fields, "horizon": HORIZON})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules["dittogym.tasks.shapematch"], "TaskSpec", shortened)
        yield
