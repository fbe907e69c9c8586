"""``python -m baselines.compare``: several algorithms, tasks and seeds, and one report about them."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from baselines.compare.evaluations import Judging
from baselines.compare.local import Report, Resources, run_here, run_local
from baselines.compare.plan import Job, Plan, check_there, make_jobs
from baselines.compare.report import write_report
from baselines.compare.results import Found, find_runs
from baselines.compare.worker import describe
from baselines.registry import ALGORITHMS
from cfp.config import Preset
from cfp.errors import ConfigError
from cfp.experiment.cli import program_name, run_command
from cfp.experiment.process import StopSignals
from cfp.sections import Particles

PATIENCE, CLUSTER_PATIENCE = 30.0, 300.0
"""Seconds to wait for another process that holds a run folder; file servers take a while to give up a lost machine."""


@dataclass(frozen=True)
class Command:
    """Train what is missing, reuse what is there, go on with what was interrupted, judge all, and write a report.

    Ctrl-C stops all runs with a checkpoint; the same command goes on. Exit code 0: every run is finished and judged;
    1: some are not, the report says why; 2: an option is wrong.
    """

    tasks: tuple[str, ...] = ("shapematch",)
    """Which tasks."""
    algos: tuple[str, ...] = ("zero", "cfp")
    """Which algorithms, or variants that the plan names; zero is a resting robot, from which efficiency counts."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the runs; what learns nothing has one run, with the first."""
    out: Path = Path("runs/compare")
    """Folder of the report, with the run folders in runs/."""
    plan: Path | None = None
    """JSON file with options of runs, under common, tasks and algos."""
    preset: Preset = "quick"
    """Where the defaults of all runs come from."""
    steps: int | None = None
    """Environment steps of every algorithm with this option, unless the plan says otherwise."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    episodes: int = 10
    """Episodes of the final evaluation of each policy."""
    tier: Particles = "lite"
    """Particles of the final evaluation, for all."""
    slot_episodes: int = 100
    """Least episodes in SLOT, of all seeds of an algorithm together, for the success rate."""
    robustness: Literal["none", "paper", "all"] = "paper"
    """Disturbed cases that are evaluated."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks of a Ray cluster."""
    workers: int = 1
    """Local: runs at a time, each in a process; 0: all in this process."""
    cpus_per_run: int | None = None
    """Cores of a run; if not given, this machine's by the number of workers, or 1 on a cluster."""
    gpus_per_run: float = 0.0
    """Ray: GPUs of a run; parts are allowed."""
    retries: int = 2
    """How often a run goes on again after its process or node was lost."""
    address: str | None = None
    """Ray: address of the cluster; if not given, RAY_ADDRESS, else one on this machine, new if there is none."""
    only: int | None = None
    """Do only the run of this number, as --dry-run lists them, and write no report (array jobs)."""
    report_only: bool = False
    """Run nothing; write the report about what is there."""
    dry_run: bool = False
    """Only list the runs and their states."""

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        least = {"episodes": 1, "slot_episodes": 1, "workers": 0, "gpus_per_run": 0, "retries": 0}
        if self.cpus_per_run is not None:
            least["cpus_per_run"] = 1
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ConfigError(f"{name}: got {getattr(self, name)}, allowed {value} or more")
        if self.gpus_per_run and self.executor == "local":
            raise ConfigError(f"gpus_per_run: got {self.gpus_per_run}, allowed with --executor ray only")
        if self.only is not None and self.report_only:
            raise ConfigError(f"only: got {self.only}, allowed without --report-only: a single run has no report")

    def judging(self, job: Job) -> Judging:
        """How the policy of a run is judged."""
        general = Judging(self.episodes, self.tier, self.robustness, job.config.environment.parity)
        if job.config.task != "slot":
            return general
        for_each = -(-self.slot_episodes // (1 if job.untrained else len(self.seeds)))
        return replace(general, episodes=max(self.episodes, for_each))


def compare(command: Command) -> int:
    """Do what a command says; returns the exit code.

    Raises:
        CFPError: An option is wrong, or a run folder holds something else.
    """
    command.check()
    jobs = make_jobs(
        Plan.read(command.plan),
        command.tasks,
        command.algos,
        command.seeds,
        command.out / "runs",
        preset=command.preset,
        steps=command.steps,
        device=command.device,
    )
    for job in jobs:
        check_there(job)
    if command.dry_run:
        print("\n".join(f"{number:>4}  {job.name:<40} {job.state}" for number, job in enumerate(jobs)))
        return 0
    chosen = jobs
    if command.only is not None:
        if not 0 <= command.only < len(jobs):
            raise ConfigError(f"only: got {command.only}, allowed 0 to {len(jobs) - 1}")
        chosen = [jobs[command.only]]
    with StopSignals() as signals:
        outcomes = {} if command.report_only else _carry_out(command, chosen, signals)
    runs = [] if command.only is not None else _report(command, jobs)
    if signals.number:
        print("stopped; the same command goes on")
        return 128 + signals.number
    if command.report_only:
        return 0 if all(run.state == "finished" for run in runs) else 1
    return 0 if set(outcomes.values()) == {"finished"} else 1


def _carry_out(command: Command, jobs: Sequence[Job], signals: StopSignals) -> dict[int, str]:
    """Do all runs; returns how each ended."""
    alone = command.executor == "local" and command.only is None  # else the same folder is seen by other machines
    patience = PATIENCE if alone else CLUSTER_PATIENCE
    works = [describe(job, command.judging(job), patience) for job in jobs]
    resources = Resources(command.cpus_per_run, command.gpus_per_run, command.retries)
    outcomes: dict[int, str] = {}

    def told(index: int, how: str) -> None:
        outcomes[index] = how
        error = jobs[index].folder / "error.txt"
        reason = f" ({error.read_text().strip()})" if how == "failed" and error.exists() else ""
        print(f"[{len(outcomes)}/{len(jobs)}] {jobs[index].name}: {how}{reason}", flush=True)

    _execute(command, works, resources, signals, told)
    return outcomes


def _execute(
    command: Command, works: list[dict[str, object]], resources: Resources, signals: StopSignals, told: Report
) -> None:
    if command.executor == "ray":
        from baselines.compare.ray import run_ray

        run_ray(works, command.address, resources, signals, told)
    elif command.workers:
        run_local(works, command.workers, resources, signals, told)
    else:
        run_here(works, signals, told)


def _report(command: Command, jobs: Sequence[Job]) -> list[Found]:
    about = (
        f"{', '.join(command.algos)} on {', '.join(command.tasks)}, preset {command.preset}, seeds "
        f"{', '.join(map(str, command.seeds))}."
    )
    runs = find_runs(jobs, command.judging)
    print(f"report: {write_report(command.out, runs, command.episodes, command.tier, about)}")
    return runs


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    about = f"Algorithms: {', '.join(ALGORITHMS)}.\n\n{inspect.getdoc(Command)}"
    started = program_name("baselines.compare", arguments)
    return run_command(lambda: compare(tyro.cli(Command, prog=started, description=about, args=arguments)))


if __name__ == "__main__":
    sys.exit(main())
