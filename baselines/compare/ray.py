"""Runs of a comparison as tasks of a Ray cluster; Ray is imported only when this is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from baselines.compare.local import Report, Resources, run_process
from cfp.errors import ConfigError
from cfp.experiment.process import StopSignals
from cfp.files import write_text


def run_ray(
    works: Sequence[dict[str, Any]], address: str | None, resources: Resources, signals: StopSignals, told: Report
) -> None:
    """Carry out all work as tasks of a Ray cluster.

    The run folders must be on a file system that all nodes share, and all nodes must have this package. What a lost
    node was doing goes on from its last checkpoint on another one; its folder's lock keeps two from doing it at once.

    Args:
        works: From `baselines.compare.worker.describe`.
        address: Of the cluster; None: what ``RAY_ADDRESS`` says, else the one last started on this machine, else a new
            one.
        resources: Of a run.
        signals: Whether the user wants to stop.
        told: Called as each ends.

    Raises:
        ConfigError: Ray is not installed, or the cluster cannot be reached.
    """
    try:
        import ray
    except ImportError as error:
        raise ConfigError(
            "executor: got 'ray', which is not installed; pip install 'torchmpm[ray]', or --executor local"
        ) from error
    owned = not ray.is_initialized()
    if owned:
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except ConnectionError as error:
            raise ConfigError(f"address: got {address!r}, where no Ray cluster answers ({error})") from error
    cpus = resources.cpus or 1
    task = ray.remote(_ray_task).options(
        num_cpus=cpus, num_gpus=resources.gpus, max_retries=resources.retries, scheduling_strategy="SPREAD"
    )
    try:
        waiting = {task.remote(values, cpus, resources.retries): index for index, values in enumerate(works)}
        asked = False
        while waiting:
            done, _ = ray.wait(list(waiting), timeout=1.0)
            if signals.number and not asked:
                asked = True
                for reference in waiting:
                    ray.cancel(reference)
            for reference in done:
                index = waiting.pop(reference)
                told(index, _result(ray, reference, Path(works[index]["folder"])))
    finally:
        if owned:
            ray.shutdown()


def _ray_task(values: dict[str, Any], threads: int, retries: int) -> str:
    return run_process(values, threads, retries, lambda: 0)


def _result(ray: Any, reference: Any, folder: Path) -> str:
    try:
        return str(ray.get(reference))
    except ray.exceptions.TaskCancelledError:
        return "stopped"
    except ray.exceptions.RayError as error:
        write_text(folder / "error.txt", f"{type(error).__name__}: {' '.join(str(error).split())}\n")
        return "failed"
