"""One run of a comparison in a process of its own: trained to its end, then judged.

The process is given its work as a line of JSON on its standard input, which its parent holds open: when that ends, the
parent is gone, and the run stops with a checkpoint as if it had been asked to.
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
from pathlib import Path
from typing import Any

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.evaluations import Judging, judge
from baselines.compare.plan import Job, check_there, read_sessions
from baselines.registry import configure, find
from cfp.config import RunConfig, to_json
from cfp.envs.make import choose_device
from cfp.experiment.process import Stopped, StopSignals, keep_memory, peak_memory
from cfp.experiment.run import Run
from cfp.experiment.run_lock import Claimed, claim
from cfp.files import read_json, write_json, write_text

FINISHED, FAILED, BUSY = 0, 1, 3
"""Exit codes; stopped is 128 and the number of the signal."""


def describe(job: Job, judging: Judging, patience: float) -> dict[str, Any]:
    """The work as JSON values.

    Args:
        job: The run.
        judging: How it is judged.
        patience: Seconds to wait for another process that holds the folder.
    """
    return {
        "label": job.label,
        "folder": str(job.folder),
        "config": to_json(job.config),
        "judging": judging.to_json(),
        "patience": patience,
    }


def work(values: dict[str, Any], alone: bool = True) -> int:
    """Do the work of `describe` as far as it is not done; returns the exit code.

    What goes wrong is written to ``error.txt`` in the run folder.

    Args:
        values: From `describe`.
        alone: The process does nothing else, so that its memory is the run's.
    """
    job = Job(values["label"], configure(values["config"]), Path(values["folder"]))
    try:
        with claim(job.folder, values["patience"]), StopSignals() as signals:
            (job.folder / "error.txt").unlink(missing_ok=True)
            try:
                _train_and_judge(job, Judging.from_json(values["judging"]), signals, alone)
            except (Stopped, KeyboardInterrupt):
                raise
            except BaseException as error:
                traceback.print_exc()
                write_text(job.folder / "error.txt", f"{type(error).__name__}: {error}\n")
                return FAILED
    except Claimed as error:
        print(error)
        return BUSY
    except Stopped as stopped:
        print(stopped)
        return 128 + stopped.number
    except KeyboardInterrupt:
        print("stopped at once, without a checkpoint")
        return 128 + signal.SIGINT
    return FINISHED


def _train_and_judge(job: Job, judging: Judging, signals: StopSignals, alone: bool) -> None:
    def stop() -> None:
        if signals.number:
            raise Stopped(signals.number)

    check_there(job)
    if not job.finished:
        _train(job.config, job.folder, signals, alone)
    judge(job.config, job.folder, judging, stop)


def _train(config: RunConfig, folder: Path, signals: StopSignals, alone: bool) -> None:
    """Train to the end, and note in ``sessions.json`` what it took; a process that is killed leaves no note."""
    if config.algo in REFERENCE_POLICIES:
        config.check()
        write_json(folder / "config.json", to_json(config))
        write_json(folder / "sessions.json", {"finished": config.ends()[-1], "sessions": []})
        return
    there, cost = read_sessions(folder), folder / "teacher" / "cost.json"
    run = Run(find(config.algo), config, folder, True, signals)
    begun, start, whole = run.step, time.perf_counter(), False
    try:
        run.train()
        whole = True
    finally:
        seconds = time.perf_counter() - start
        session: dict[str, Any] = {
            "from": begun,
            "to": run.step,
            "seconds": seconds,
            "judging": run.evaluation_seconds,
            "memory": None,
        }
        if cost.exists() and not any("teacher" in earlier for earlier in there["sessions"]):
            teacher = read_json(cost)
            session["teacher"] = {"steps": teacher["steps"], "seconds": teacher["seconds"]}
            session["judging"] += teacher["evaluation_seconds"]
        session |= {"memory": peak_memory() if alone else None, "device": choose_device(config.device)}
        session |= {"host": socket.gethostname(), "process": os.getpid(), "finished": whole}
        finished = config.ends()[-1] if whole else False
        write_json(folder / "sessions.json", {"finished": finished, "sessions": [*there["sessions"], session]})


def _stop_with_parent() -> None:
    """Wait for the end of the standard input, then ask this process to stop."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Entry of the process; returns its exit code."""
    values = json.loads(sys.stdin.readline())
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    keep_memory()
    return work(values)


if __name__ == "__main__":
    # A daemon thread that reads the standard input must not be waited for, nor its lock, when the interpreter ends.
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
