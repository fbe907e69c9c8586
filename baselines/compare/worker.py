"""Carries out one run of a plan: trains it to its end, then evaluates its policy.

The parent names the run in the process's only argument, as JSON, and keeps its standard input open. When that ends, the
parent wants the run to stop or is gone itself, and the run stops with a checkpoint as after Ctrl-C.
"""

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

from filelock import FileLock, Timeout

from baselines import train
from baselines.compare.evaluation import Protocol, evaluate_run
from baselines.compare.plan import PlannedRun

#: Exit code if another process holds the run; a training never ends with it.
IN_USE = 3
#: Seconds to wait for another process that holds the run; file servers take a while to give up a lost machine.
WAIT = 120.0


def train_and_evaluate(run: PlannedRun, protocol: Protocol) -> int:
    """Do what is left of a run; returns an exit code, that of the training if it is not 0."""
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run.folder / ".comparison.lock", timeout=WAIT):
            run.check_folder()
            record = run.record
            run.update_record(options=run.options)
            if not run.trained:
                start = time.monotonic()
                code = train.main(run.words)
                run.update_record(seconds=record.get("seconds", 0.0) + time.monotonic() - start)
                if code:
                    return code
            evaluate_run(run, protocol)
            return 0
    except Timeout:
        print(f"{run.folder} is in use by another process")
        return IN_USE


def _stop_with_parent() -> None:
    """Wait for the end of the standard input, then ask this process to stop."""
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Entry point of the process; returns its exit code."""
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    values = json.loads(sys.argv[1])
    run = PlannedRun(**values["run"] | {"folder": Path(values["run"]["folder"])})
    return train_and_evaluate(run, Protocol(**values["protocol"]))


if __name__ == "__main__":
    sys.exit(main())
