"""Exit codes and error lines of all programs."""

import os
import signal
import sys

import pytest
import torch

from cfp.errors import CheckpointError, ConfigError, NonFiniteError
from cfp.experiment.cli import run_command
from cfp.experiment.process import Stopped


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError("steps: got 0"), 2),
        (CheckpointError("state.pt: damaged"), 2),
        (NonFiniteError("the loss became nan"), 1),
        (OSError("No space left on device"), 1),
        (MemoryError("backend"), 1),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 1),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"), 1),
    ],
)
def test_expected_error_is_one_line_and_an_exit_code(capsys, error, code):
    def command():
        raise error

    assert run_command(command) == code
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert str(error) in captured.err


def test_exit_code_of_a_command_that_ends_by_itself():
    assert run_command(lambda: None) == 0 and run_command(lambda: 1) == 1


def test_stopped_program_tells_how_to_continue(capsys):
    def command():
        raise Stopped(signal.SIGTERM, "resume with: the same command")

    assert run_command(command) == 128 + signal.SIGTERM
    assert capsys.readouterr().out == "stopped by SIGTERM; resume with: the same command\n"


def test_output_that_nobody_reads_any_more_is_no_error(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as output:  # buffered, as that of a program in a pipe
        monkeypatch.setattr(sys, "stdout", output)
        assert run_command(lambda: print("a few words")) == 141


def test_second_interrupt_stops_at_once(capsys):
    def command():
        raise KeyboardInterrupt

    assert run_command(command) == 130
    assert capsys.readouterr().err == "stopped at once\n"


def test_unexpected_error_keeps_its_traceback():
    def command():
        raise RuntimeError("a mistake in the program")

    with pytest.raises(RuntimeError, match="a mistake"):
        run_command(command)
