"""Executors of runs, with one interface: in this process, in processes of this machine, or on a cluster."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import Any

from baselines.compare.jobs import Job
from baselines.compare.worker import EXIT_CODES, Outcome, carry_out, encode
from cfp.errors import ConfigError
from cfp.experiment.process import StopSignals
from cfp.files import write_text

WORKER = (sys.executable, "-m", "baselines.compare.worker")
POLL = 0.2  # seconds between two looks at the processes and at the stop signals


class ProcessKilled(Exception):
    """The process of a run was killed by a signal."""


@dataclass(frozen=True)
class Resources:
    """What a run gets."""

    cpus: int | None = None  # None: an equal share of this machine's cores, or one on a cluster
    gpus: float = 0.0  # also a fraction of one; on a cluster only
    retries: int = 2  # further attempts after the process or the node was lost, over all causes together
    lock_timeout: float = 30.0  # seconds to wait for another process that holds the run folder


class Executor(ABC):
    """Carries out runs, like a `concurrent.futures.Executor` whose tasks can be asked to stop."""

    @abstractmethod
    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a run as soon as there is room for it; it may be over when this returns."""

    def stop(self) -> None:  # noqa: B027  (nothing where no run is in progress)
        """Ask the runs in progress to stop with a checkpoint, and begin no other."""

    def shutdown(self, kill: bool) -> None:  # noqa: B027
        """Free all resources; ``kill`` ends the runs in progress at once."""


def execute(
    executor: Executor, jobs: Sequence[Job], signals: StopSignals, on_outcome: Callable[[Job, Outcome], None]
) -> None:
    """Carry out runs until all are over or have stopped, and shut down the executor."""
    pending: dict[Future[Outcome], Job] = {}
    stopping = False

    def collect(timeout: float) -> None:
        for future in wait(pending, timeout, FIRST_COMPLETED).done:
            on_outcome(pending.pop(future), future.result())

    try:
        for job in jobs:
            pending[executor.submit(job)] = job
            collect(timeout=0)
        while pending:
            collect(POLL)
            if signals.number and not stopping:
                stopping = True
                executor.stop()
    except BaseException as error:
        executor.stop()
        executor.shutdown(kill=not isinstance(error, Exception))  # an error of one run costs the others nothing
        raise
    executor.shutdown(kill=False)


class InProcessExecutor(Executor):
    """Carries out each run in this process when it is submitted; it looks at the signals itself."""

    def __init__(self, signals: StopSignals, resources: Resources) -> None:
        self.signals, self.lock_timeout = signals, resources.lock_timeout

    def submit(self, job: Job) -> Future[Outcome]:
        """Carry out a run, see `Executor.submit`."""
        future: Future[Outcome] = Future()
        stopped = self.signals.number
        future.set_result("stopped" if stopped else carry_out(job, self.signals, self.lock_timeout, own_process=False))
        return future


def available_cpus() -> int:
    """Number of cores that this process may use, which a cluster's scheduler may have limited."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LocalExecutor(Executor):
    """Carries out runs in processes of this machine."""

    def __init__(self, workers: int, resources: Resources) -> None:
        self.threads = resources.cpus or max(1, available_cpus() // workers)
        self.resources = resources
        self._pool = ThreadPoolExecutor(workers)
        self._stop, self._kill = threading.Event(), threading.Event()

    def submit(self, job: Job) -> Future[Outcome]:
        """Queue a run, see `Executor.submit`."""
        return self._pool.submit(self._run, job)

    def stop(self) -> None:
        """Ask the processes to stop with a checkpoint."""
        self._stop.set()

    def shutdown(self, kill: bool) -> None:
        """Wait for the processes; ``kill`` ends them at once."""
        if kill:
            self._stop.set()
            self._kill.set()
        self._pool.shutdown()

    def _run(self, job: Job) -> Reward:
        for attempt in range(1 + self.resources.retries):
            if self._stop.is_set():
                return "stopped"
            try:
                return run_process(job, self.threads, self.resources.lock_timeout, self._urgency)
            except ProcessKilled as error:
                reason = f"{error} ({attempt + 1} times)"
        write_text(job.error_file, reason + "\n")
        return "failed"

    def _urgency(self) -> int:
        return self._stop.is_set() + self._kill.is_set()


class RayExecutor(Executor):
    """Carries out runs as tasks of a Ray cluster; Ray is imported only when this is made.

    A run whose node is lost continues on another one from its last checkpoint; the lock on its folder keeps two nodes
    from working on it at once. Ray counts lost nodes and killed processes together.
    """

    def __init__(self, address: str | None, resources: Resources) -> None:
        try:
            import ray
        except ImportError as error:
            raise ConfigError("executor ray requires Ray: pip install 'torchmpm[ray]'") from error
        self._ray: Any = ray
        self._owned = not ray.is_initialized()
        if self._owned:
            try:
                ray.init(address=address, log_to_driver=False, configure_logging=False)
            except ConnectionError as error:
                raise ConfigError(f"address: no Ray cluster answers at {address!r} ({error})") from error
        self._threads, self._lock_timeout = resources.cpus or 1, resources.lock_timeout
        self._task = ray.remote(run_process).options(
            num_cpus=self._threads,
            num_gpus=resources.gpus,
            max_retries=resources.retries,
            retry_exceptions=[ProcessKilled],
            scheduling_strategy="SPREAD",
        )
        self._references: list[Any] = []

    def submit(self, job: Job) -> Future[Outcome]:
        """Queue a run, see `Executor.submit`."""
        reference, future = self._task.remote(job, self._threads, self._lock_timeout), Future[Outcome]()
        self._references.append(reference)
        reference.future().add_done_callback(partial(self._finish, future, job))
        return future

    def stop(self) -> None:
        """Cancel the tasks, which asks their runs to stop with a checkpoint."""
        for reference in self._references:
            self._ray.cancel(reference)

    def shutdown(self, kill: bool) -> None:
        """Disconnect from the cluster, which ends all tasks of this process, unless the caller had connected to it."""
        if kill:
            self.stop()
        if self._owned:
            self._ray.shutdown()

    def _finish(self, future: Future[Outcome], job: Job, done: Future[Outcome]) -> None:
        """Pass on the result of a task; an exception that a callback raised would be lost."""
        error = done.exception()
        try:
            if isinstance(error, self._ray.exceptions.TaskCancelledError):
                future.set_result("stopped")
            elif isinstance(error, ProcessKilled | self._ray.exceptions.RayError):
                write_text(job.error_file, f"{type(error).__name__}: {' '.join(str(error).split())}\n")
                future.set_result("failed")
            else:
                future.set_result(done.result())
        except BaseException as unexpected:
            future.set_exception(unexpected)


def run_process(job: Job, threads: int, lock_timeout: float, urgency: Callable[[], int] = lambda: 0) -> Reward:
    """Carry out a run in a process of its own, whose output is appended to ``log.txt`` in the run folder.

    The process is in a session of its own: Ctrl-C reaches this process only, which then asks it to stop, once.
    ``urgency`` tells whether to stop it: 0 not, 1 with a checkpoint, 2 at once. If something else kills it, this raises
    `ProcessKilled`.
    """
    folder = job.folder
    folder.mkdir(parents=True, exist_ok=True)
    job.error_file.unlink(missing_ok=True)
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "OMP_NUM_THREADS": str(threads)}
    with open(folder / "log.txt", "ab") as log:
        log_start = log.tell()
        process = subprocess.Popen(
            WORKER, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
        )
    assert process.stdin is not None
    try:
        process.stdin.write(encode(job, lock_timeout))
        process.stdin.flush()
    except BrokenPipeError:
        pass  # the process has ended already; its exit code says how
    code = _wait(process, urgency)
    if code < 0 and not urgency():
        raise ProcessKilled(f"killed by {signal.Signals(-code).name}; see log.txt")
    outcome: Outcome = "stopped" if code < 0 else {code: name for name, code in EXIT_CODES.items()}.get(code, "failed")
    if outcome == "failed" and not job.error_file.exists():  # it failed outside of the run itself
        with open(folder / "log.txt", "rb") as log:
            log.seek(log_start)
            last_line = log.read().decode(errors="replace").strip().rpartition("\n")[2]
        write_text(job.error_file, f"{last_line or 'no output'} (exit code {code}; see log.txt)\n")
    return outcome


def _wait(process: subprocess.Popen[bytes], urgency: Callable[[], int]) -> int:
    """Wait for a process, pass on requests to stop, and return its exit code."""
    asked = 0
    try:
        while True:
            try:
                return process.wait(POLL)
            except subprocess.TimeoutExpired:
                if urgency() > asked:
                    asked = urgency()
                    process.send_signal(signal.SIGTERM if asked == 1 else signal.SIGKILL)
    except BaseException:  # this process is ended by force, or a task of a cluster is cancelled
        process.terminate()
        process.wait()
        raise
    finally:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # of what an ended process has not read
            process.stdin.close()
