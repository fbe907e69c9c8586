"""What carries out runs: one interface for this process, processes of this machine, and the nodes of a cluster."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass

from baselines.compare.jobs import Job
from baselines.compare.worker import Outcome
from cfp.experiment.process import StopSignals

POLL = 0.5
"""Seconds between two looks at the stop signals."""


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

    @abstractmethod
    def stop(self) -> None:
        """Ask the runs in progress to stop with a checkpoint, and begin no other."""

    @abstractmethod
    def shutdown(self, kill: bool) -> None:
        """Free all resources; ``kill`` ends the runs in progress at once."""


def execute(
    executor: Executor, jobs: Sequence[Job], signals: StopSignals, on_outcome: Callable[[Job, Outcome], None]
) -> None:
    """Carry out runs until all are over or have stopped, and shut down the executor."""
    pending: dict[Future[Outcome], Job] = {}
    stopping, complete = False, False

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
        complete = True
    finally:
        executor.shutdown(kill=not complete)
