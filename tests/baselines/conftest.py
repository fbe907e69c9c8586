"""What tests of several programs share."""

import signal
from collections.abc import Callable

import pytest

from cfp.experiment.callbacks import StopCallback


@pytest.fixture
def stop_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Press Ctrl-C when a training comes to a step."""
    on_step, steps = StopCallback._on_step, []

    def interrupt(callback: StopCallback) -> bool:
        if callback.stage.step in steps:
            signal.raise_signal(signal.SIGINT)
        return on_step(callback)

    monkeypatch.setattr(StopCallback, "_on_step", interrupt)
    return steps.append
