"""Carries out one run of a comparison: trains it to its end, then evaluates its policy.

As a program, the process reads its job as one line of JSON from the standard input, which its parent keeps open. When
the standard input ends, the parent is gone, and the run stops with a checkpoint as if a signal had asked it to.
"""

import json
import os
import signal
import sys
import threading
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from baselines.compare.final_evaluation import Protocol, evaluate_run
from baselines.compare.jobs import Job, check_folder, read_sessions
from baselines.registry import algorithm_of, configure
from cfp.config import to_json
from cfp.envs.make import choose_device
from cfp.experiment.process import Stopped, StopSignals, keep_memory, peak_memory
from cfp.experiment.run import TrainingRun
from cfp.experiment.run_lock import FolderInUse, run_lock
from cfp.files import write_json, write_text
from cfp.from_dict import update_from_dict

#: How a run ended; busy: another process holds its folder.
Outcome = Literal["finished", "failed", "busy", "stopped"]
EXIT_CODES: dict[Outcome, int] = {"finished": 0, "failed": 1, "busy": 3, "stopped": 4}


def encode(job: Job, lock_timeout: float) -> bytes:
    """A job as one line of JSON, see `decode`."""
    values = {"label": job.label, "config": to_json(job.config), "folder": str(job.folder)}
    return json.dumps(values | {"protocol": asdict(job.protocol), "lock_timeout": lock_timeout}).encode() + b"\n"


def decode(line: str) -> tuple[Job, float]:
    """Inverse of `encode`."""
    values = json.loads(line)
    protocol = update_from_dict(Protocol(1), values["protocol"])
    job = Job(values["label"], configure(values["config"]), Path(values["folder"]), protocol)
    return job, values["lock_timeout"]


def carry_out(job: Job, signals: StopSignals, lock_timeout: float, *, own_process: bool = True) -> Reward:
    """Do what is left of a run; an error is written to ``error.txt`` in its folder."""
    try:
        with run_lock(job.folder, lock_timeout):
            job.error_file.unlink(missing_ok=True)
            try:
                _train_and_evaluate(job, signals, own_process)
            except (Stopped, KeyboardInterrupt):
                raise
            except BaseException as error:
                traceback.print_exc()
                write_text(job.error_file, f"{type(error).__name__}: {error}\n")
                return "failed"
    except FolderInUse as error:
        print(error)
        return "busy"
    except (Stopped, KeyboardInterrupt) as stopped:
        print(stopped if isinstance(stopped, Stopped) else "stopped at once, without a checkpoint")
        return "stopped"
    return "finished"


def _train_and_evaluate(job: Job, signals: StopSignals, own_process: bool) -> None:
    def check_stop() -> None:
        if signals.number:
            raise Stopped(signals.number)

    check_folder(job)
    if job.untrained and not job.trained:
        write_json(job.folder / "config.json", to_json(job.config))
    elif not job.trained:
        train(job, signals, own_process)
    evaluate_run(job.config, job.folder, job.protocol, check_stop)


def train(job: Job, signals: StopSignals, own_process: bool = True) -> None:
    """Train to the end, and record the cost of this session in ``sessions.json``; a killed process leaves no record."""
    earlier = read_sessions(job.folder)["sessions"]
    run = TrainingRun(algorithm_of(job.config), job.config, job.folder, True, signals)
    first_step, start, finished = run.step, time.perf_counter(), False
    try:
        run.train()
        finished = True
    finally:
        record = {
            "from": first_step,
            "to": run.step,
            "seconds": time.perf_counter() - start - run.preparation_seconds,
            "evaluation_seconds": run.evaluation_seconds,
            "memory": peak_memory() if own_process else None,
            "device": choose_device(job.config.device),
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
    job, lock_timeout = decode(sys.stdin.readline())
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    keep_memory()
    with StopSignals() as signals:
        return EXIT_CODES[carry_out(job, signals, lock_timeout)]


if __name__ == "__main__":
    # The daemon thread holds the lock of the standard input, for which a normal exit of the interpreter would wait.
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
