"""What tests of several programs share."""

import signal
from collections.abc import Callable

import pytest

from cfp.experiment.books import Books


@pytest.fixture
def stop_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Press Ctrl-C when a training comes to a step."""
    turn = Books.turn

    def press(at: int) -> None:
        def interrupt(books, step, scalars):
            if step == at:
                signal.raise_signal(signal.SIGINT)
            turn(books, step, scalars)

        monkeypatch.setattr(Books, "turn", interrupt)

    return press
