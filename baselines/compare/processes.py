"""Where runs are carried out: in processes of this machine, or of the machines of a Ray cluster."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from dataclasses import asdict, dataclass
from typing import Any, Literal

from baselines.compare.evaluation import Protocol
from baselines.compare.plan import PlannedRun
from baselines.compare.worker import IN_USE
from cfp.errors import ConfigError
from cfp.files import write_text

#: How a run ended; in use: another process holds its folder.
Outcome = Literal["finished", "failed", "stopped", "in use"]
WORKER = (sys.executable, "-m", "baselines.compare.worker")
POLL = 0.2  # seconds between two looks at a process and at what it is asked for
RETRIES = 2  # further attempts after the process or node of a run was lost


@dataclass(frozen=True)
class Resources:
    """What a run gets."""

    threads: int = 1
    gpus: float = 0.0  # also a fraction of one; with Ray only


def carry_out(
    run: PlannedRun, protocol: Protocol, resources: Resources, urgency: Callable[[], int] = lambda: 0
) -> Outcome:
    """Carry out a run in a process of its own, whose output goes to ``log.txt`` in the folder of the run.

    Args:
        run: The run.
        protocol: How its policy is evaluated.
        resources: What it gets.
        urgency: Asked again and again whether to stop: 0 not, 1 with a checkpoint, 2 at once.
    """
    if urgency():
        return "stopped"
    run.folder.mkdir(parents=True, exist_ok=True)
    error = run.folder / "error.txt"
    error.unlink(missing_ok=True)
    given = asdict(run) | {"folder": str(run.folder)}
    words = [*WORKER, json.dumps({"run": given, "protocol": asdict(protocol)})]
    code = 0
    for _ in range(1 + RETRIES):
        code, last_line = _call(words, run, resources.threads, urgency)
        if code >= 0 or urgency():
            break
    if urgency() or code in (128 + signal.SIGINT, 128 + signal.SIGTERM):
        return "finished" if code == 0 else "stopped"
    if code in (0, IN_USE):
        return "finished" if code == 0 else "in use"
    if code < 0:
        last_line = f"killed by {signal.Signals(-code).name}"
    write_text(error, f"{last_line or 'no output'} (exit code {code}; see log.txt)\n")
    return "failed"


def _call(words: list[str], run: PlannedRun, threads: int, urgency: Callable[[], int]) -> tuple[int, str]:
    """Exit code of a process, and the last line of its output.

    It is in a session of its own, so that Ctrl-C reaches the parent only.
    """
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "OMP_NUM_THREADS": str(threads)}
    with open(run.folder / "log.txt", "a+b") as log:
        start = log.seek(0, os.SEEK_END)
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
        )
        assert process.stdin is not None
        try:
            while process.poll() is None:
                if urgency():
                    process.stdin.close()
                if urgency() > 1:
                    process.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL)
        finally:  # also where this process is ended by force, or a task of a cluster is cancelled
            process.stdin.close()
            process.wait()
        log.seek(start)
        lines = log.read().decode(errors="replace").split("\n")
    return process.returncode, next((line.strip() for line in reversed(lines) if line.strip()), "")


class LocalExecutor:
    """Processes of this machine, a number of them at a time."""

    def __init__(self, workers: int, resources: Resources) -> None:
        self.resources, self.urgency = resources, 0
        self._pool = ThreadPoolExecutor(workers)

    def submit(self, run: PlannedRun, protocol: Protocol) -> Future[Outcome]:
        """Begin a run as soon as there is room for it."""
        return self._pool.submit(carry_out, run, protocol, self.resources, lambda: self.urgency)

    def stop(self, urgency: int) -> None:
        """Ask the runs in progress to stop, 1 with a checkpoint, 2 at once, and begin no other."""
        self.urgency = urgency

    def shutdown(self) -> None:
        """Free all resources."""
        self._pool.shutdown()


class RayExecutor:
    """Tasks of a Ray cluster. A run whose node is lost continues on another one from its last checkpoint."""

    def __init__(self, address: str | None, resources: Resources) -> None:
        try:
            import ray
        except ImportError as error:
            raise ConfigError("executor ray requires Ray: pip install 'torchmpm[ray]'") from error
        self._ray: Any = ray
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False, ignore_reinit_error=True)
        except ConnectionError as error:
            raise ConfigError(f"address: no Ray cluster answers at {address!r} ({error})") from error
        self._resources, self._references = resources, list[Any]()
        self._task = ray.remote(carry_out).options(
            num_cpus=resources.threads,
            num_gpus=resources.gpus,
            max_retries=RETRIES,
            scheduling_strategy="SPREAD",
        )

    def submit(self, run: PlannedRun, protocol: Protocol) -> Future[Outcome]:
        """Begin a run as soon as there is room for it."""
        reference = self._task.remote(run, protocol, self._resources)
        self._references.append(reference)
        future: Future[Outcome] = reference.future()
        return future

    def stop(self, urgency: int) -> None:
        """Cancel all tasks; their processes stop with a checkpoint, see `_call`."""
        for reference in self._references:
            self._ray.cancel(reference, force=urgency > 1)

    def shutdown(self) -> None:
        """Disconnect from the cluster."""
        self._ray.shutdown()


def execute(
    runs: Iterable[PlannedRun],
    protocol: Protocol,
    executor: LocalExecutor | RayExecutor,
    on_outcome: Callable[[PlannedRun, Outcome], None],
) -> None:
    """Carry out runs, and tell ``on_outcome`` how each ended.

    After Ctrl-C or SIGTERM the runs in progress stop with a checkpoint, and this raises ``KeyboardInterrupt`` at the
    end; the second Ctrl-C stops them at once.
    """
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    futures: dict[Future[Outcome], PlannedRun] = {}
    try:
        futures |= {executor.submit(run, protocol): run for run in runs}
        for future in as_completed(futures):
            on_outcome(futures[future], _outcome(future, futures[future]))
    except BaseException:  # Ctrl-C, or a fault such as a full disk, which stops the other runs, too
        print("stopping all runs with a checkpoint (press Ctrl-C again to stop at once, without one)", file=sys.stderr)
        try:
            executor.stop(1)
            wait(futures)
        except KeyboardInterrupt:
            executor.stop(2)
            wait(futures)
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
        executor.shutdown()


def _outcome(future: Future[Outcome], run: PlannedRun) -> Outcome:
    """How a run ended, also where Ray has lost it."""
    error = future.exception()
    if error is None:
        return future.result()
    if not type(error).__module__.startswith("ray."):
        raise error
    write_text(run.folder / "error.txt", f"{type(error).__name__}: {' '.join(str(error).split())}\n")
    return "failed"
