"""Executor of a Ray cluster; Ray is imported only when this executor is made."""

from __future__ import annotations

from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from baselines.compare.executor import Executor, ProcessKilled, Resources, run_process
from baselines.compare.jobs import Job
from baselines.compare.worker import Outcome
from cfp.errors import ConfigError
from cfp.files import write_text


class RayExecutor(Executor):
    """Carries out runs as tasks of a Ray cluster.

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
        reference.future().add_done_callback(partial(self._finish, future, job.folder))
        return future

    def stop(self) -> None:
        """Cancel the tasks, which asks their runs to stop with a checkpoint."""
        for reference in self._references:
            self._ray.cancel(reference)

    def shutdown(self, kill: bool) -> None:
        """Disconnect from the cluster, which ends all tasks of this process."""
        if self._owned:
            self._ray.shutdown()

    def _finish(self, future: Future[Outcome], folder: Path, done: Future[Outcome]) -> None:
        """Pass on the result of a task; an exception that a callback raised would be lost."""
        error = done.exception()
        try:
            if isinstance(error, self._ray.exceptions.TaskCancelledError):
                future.set_result("stopped")
            elif isinstance(error, ProcessKilled | self._ray.exceptions.RayError):
                write_text(folder / "error.txt", f"{type(error).__name__}: {' '.join(str(error).split())}\n")
                future.set_result("failed")
            else:
                future.set_result(done.result())
        except BaseException as unexpected:
            future.set_exception(unexpected)
