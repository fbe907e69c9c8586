"""Where runs are carried out: processes of this machine. `baselines.compare.ray` has those of a cluster."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.compare.worker import BUSY, FINISHED, work
from cfp.experiment.process import StopSignals
from cfp.files import write_text

MODULE = (sys.executable, "-m", "baselines.compare.worker")
POLL = 0.2
"""Seconds between two looks at a process."""


@dataclass(frozen=True)
class Resources:
    """What a run gets.

    Attributes:
        cpus: Cores; None: this machine's shared out among the workers, one on a cluster.
        gpus: GPUs, also parts of one; on a cluster only.
        retries: How often a run is begun again whose process or machine was lost.
    """

    cpus: int | None = None
    gpus: float = 0.0
    retries: int = 2


def outcome(code: int) -> str:
    """Finished, failed, busy or stopped."""
    return {FINISHED: "finished", BUSY: "busy"}.get(code, "failed" if 0 < code <= 128 else "stopped")


def run_process(values: dict[str, Any], threads: int, retries: int, stopped: Callable[[], int]) -> str:
    """Carry out work in a process of its own; its output goes to ``log.txt`` in the run folder.

    The process is in a session of its own: Ctrl-C reaches this one only, which asks it to stop, once.

    Args:
        values: From `baselines.compare.worker.describe`.
        threads: Of its numerical libraries.
        retries: How often it is begun again when something kills it.
        stopped: How urgently the user wants to stop: 0 not, 1 with a checkpoint, 2 at once.

    Returns:
        See `outcome`.
    """
    folder = Path(values["folder"])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "error.txt").unlink(missing_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    environment.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for _ in range(1 + retries):
        with open(folder / "log.txt", "ab") as log:
            begun = log.tell()
            process = subprocess.Popen(
                MODULE, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(values).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended already, and its exit code says how
        code = _wait(process, stopped)
        if code >= 0 or stopped():
            break
    if code < 0 and not stopped():
        reason = f"killed by {signal.Signals(-code).name}, {1 + retries} times; see log.txt"
        write_text(folder / "error.txt", reason + "\n")
        return "failed"
    if outcome(code) == "failed" and not (folder / "error.txt").exists():  # it ended before or beside the run itself
        with open(folder / "log.txt", "rb") as log:
            log.seek(begun)
            last = log.read().decode(errors="replace").strip().rpartition("\n")[2]
        write_text(folder / "error.txt", f"{last or 'no word'} (exit code {code}; see log.txt)\n")
    return outcome(code)


def _wait(process: subprocess.Popen[bytes], stopped: Callable[[], int]) -> int:
    asked = 0
    try:
        while True:
            try:
                return process.wait(POLL)
            except subprocess.TimeoutExpired:
                if stopped() > asked:
                    asked = stopped()
                    process.send_signal(signal.SIGTERM if asked == 1 else signal.SIGKILL)
    except BaseException:  # this process is stopped by force, or a task of a cluster is cancelled
        process.terminate()
        process.wait()
        raise
    finally:
        assert process.stdin is not None
        process.stdin.close()


Report = Callable[[int, str], None]
"""Called with the index of a run and how it ended."""


def run_here(works: Sequence[dict[str, Any]], signals: StopSignals, told: Report) -> None:
    """Carry out all work in this process, one after the other."""
    for index, values in enumerate(works):
        if signals.number:
            told(index, "stopped")
            continue
        code = work(values, alone=False)
        if code >= 128:
            signals.number = code - 128
        told(index, outcome(code))


def run_local(
    works: Sequence[dict[str, Any]], workers: int, resources: Resources, signals: StopSignals, told: Report
) -> None:
    """Carry out all work in processes of this machine.

    Args:
        works: From `baselines.compare.worker.describe`.
        workers: Processes at a time.
        resources: Of a run.
        signals: Whether the user wants to stop.
        told: Called as each ends.
    """
    threads = resources.cpus or max(1, (os.cpu_count() or 1) // workers)
    forced = False

    def one(values: dict[str, Any]) -> str:
        if signals.number:
            return "stopped"
        return run_process(values, threads, resources.retries, lambda: 2 if forced else int(signals.number > 0))

    with ThreadPoolExecutor(workers) as pool:
        futures = {pool.submit(one, values): index for index, values in enumerate(works)}
        try:
            for future in as_completed(futures):
                told(futures[future], future.result())
        except BaseException:
            forced = True
            raise
