"""Carries out one run of a comparison: trains it to its end, then evaluates its policy.

As a program, the process reads its request as one line of JSON from the standard input, which its parent keeps open.
When the standard input ends, the parent is gone, and the run stops with a checkpoint as if a signal had asked it to.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from baselines.compare.evaluations import Protocol, evaluate_run
from baselines.compare.jobs import Job, check_folder, read_sessions
from baselines.registry import configure, open_run
from cfp.config import to_json
from cfp.envs.make import choose_device
from cfp.experiment.files import write_json, write_text
from cfp.experiment.process import Stopped, StopSignals, keep_memory, peak_memory
from cfp.experiment.run_lock import Claimed, claim

Outcome = Literal["finished", "failed", "busy", "stopped"]
"""How a run ended; busy: another process holds its folder."""
EXIT_CODES: dict[Outcome, int] = {"finished": 0, "failed": 1, "busy": 3, "stopped": 4}


@dataclass(frozen=True)
class Request:
    """A run as JSON values, for another process.

    Attributes:
        label: Name of the algorithm in the report.
        folder: Run folder.
        config: Options of the run.
        protocol: How its policy is evaluated.
        lock_timeout: Seconds to wait for another process that holds the folder.
    """

    label: str
    folder: str
    config: dict[str, Any]
    protocol: dict[str, Any]
    lock_timeout: float

    @classmethod
    def make(cls, job: Job, protocol: Protocol, lock_timeout: float) -> Request:
        """The request for a job."""
        return cls(job.label, str(job.folder), to_json(job.config), protocol.to_json(), lock_timeout)

    @property
    def job(self) -> Job:
        """The run."""
        return Job(self.label, configure(self.config), Path(self.folder))

    def encode(self) -> bytes:
        """One line of JSON."""
        return json.dumps(asdict(self)).encode() + b"\n"


def run(request: Request, signals: StopSignals, *, own_process: bool = True) -> Outcome:
    """Do what is left of a run; an error is written to ``error.txt`` in its folder.

    Args:
        request: The run.
        signals: Whether the user wants to stop.
        own_process: Whether this process does nothing else, so that its memory is that of the run.
    """
    job = request.job
    try:
        with claim(job.folder, request.lock_timeout):
            (job.folder / "error.txt").unlink(missing_ok=True)
            try:
                _train_and_evaluate(job, Protocol.from_json(request.protocol), signals, own_process)
            except (Stopped, KeyboardInterrupt):
                raise
            except BaseException as error:
                traceback.print_exc()
                write_text(job.folder / "error.txt", f"{type(error).__name__}: {error}\n")
                return "failed"
    except Claimed as error:
        print(error)
        return "busy"
    except Stopped as stopped:
        print(stopped)
        return "stopped"
    except KeyboardInterrupt:
        print("stopped at once, without a checkpoint")
        return "stopped"
    return "finished"


def _train_and_evaluate(job: Job, protocol: Protocol, signals: StopSignals, own_process: bool) -> None:
    def check_stop() -> None:
        if signals.number:
            raise Stopped(signals.number)

    check_folder(job)
    if job.untrained:
        write_json(job.folder / "config.json", to_json(job.config))
    elif not job.trained:
        train(job, signals, own_process)
    evaluate_run(job, protocol, check_stop)


def train(job: Job, signals: StopSignals, own_process: bool = True) -> None:
    """Train to the end, and record the costs of this session in ``sessions.json``; a killed process leaves no record."""
    earlier = read_sessions(job.folder)["sessions"]
    session = open_run(job.config, job.folder, True, signals)
    first_step, start, finished = session.step, time.perf_counter(), False
    try:
        session.train()
        finished = True
    finally:
        record = {
            "from": first_step,
            "to": session.step,
            "seconds": time.perf_counter() - start,
            "evaluation_seconds": session.judging,
            "teacher": dict(zip(("steps", "seconds"), session.teaching, strict=True)),
            "memory": peak_memory() if own_process else None,
            "device": choose_device(job.config.device),
            "host": socket.gethostname(),
            "process": os.getpid(),
            "finished": finished,
        }
        end = job.config.ends()[-1] if finished else False
        write_json(job.folder / "sessions.json", {"finished": end, "sessions": [*earlier, record]})


def _stop_with_parent() -> None:
    """Wait for the end of the standard input, then ask this process to stop."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Entry point of the process; returns its exit code."""
    request = Request(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    keep_memory()
    with StopSignals() as signals:
        return EXIT_CODES[run(request, signals)]


if __name__ == "__main__":
    # The daemon thread holds the lock of the standard input, for which a normal exit of the interpreter would wait.
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
