"""``torchmpm compare``: several algorithms, tasks and seeds, and one report about them."""

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from baselines.compare.evaluation import Protocol
from baselines.compare.plan import PlannedRun, make_runs, read_plan
from baselines.compare.processes import LocalExecutor, Outcome, RayExecutor, Resources, execute
from baselines.compare.report import read_result, write_report
from cfp.config import Preset
from cfp.errors import ConfigError, check_at_least
from cfp.experiment.cli import read_command, run_command
from cfp.experiment.folder import Folder

EXAMPLES = (
    "--tasks shapematch --algos zero cfp-analytic shac --seeds 0 1 2",
    "--tasks run kick --algos zero gradient --out runs/gradient --workers 2",
    "--tasks run kick --algos zero gradient --out runs/gradient --report-only",
)


@dataclass(frozen=True)
class Command:
    """Train what is missing, resume what was interrupted, evaluate all policies on the same episodes, and report.

    Algorithms are those of train --algo, the reference policies zero, random and scripted, and variants that the plan
    file defines. The report shows differences to the first one.

    Ctrl-C stops all runs with a checkpoint; the same command resumes them. Exit code 0: every run is finished and
    evaluated; 1: some are not, and the report says why; 2: an option is wrong.
    """

    tasks: tuple[str, ...] = ("shapematch",)
    """Tasks."""
    algos: tuple[str, ...] = ("zero", "cfp-analytic")
    """Algorithms."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the runs; the reference policies have one run, with the first seed."""
    out: Folder = Path("runs/compare")
    """Folder of the report, with the run folders in runs/."""
    preset: Preset = "quick"
    """Preset of all runs."""
    steps: int | None = None
    """Environment steps of every algorithm with this option, unless the plan gives it."""
    plan: Path | None = None
    """JSON file with options of train, under common, tasks and algos."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    episodes: int = 10
    """Episodes of the final evaluation of each policy."""
    particles: Literal["full", "lite"] | int = "lite"
    """Particles of the final evaluation, for all policies."""
    noise: Literal["paper", "with", "without"] = "paper"
    """Action noise of all policies in the final evaluation; paper: without in SHAPE MATCH, with it in other tasks."""
    workers: int = 1
    """Runs at a time, each in a process of its own; on a cluster Ray decides."""
    cpus_per_run: int | None = None
    """Cores of a run; if not given, an equal share of this machine's for each worker, or 1 on a cluster."""
    gpus_per_run: float = 0.0
    """Ray: GPUs of a run, also a fraction of one."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks of a Ray cluster."""
    address: str | None = None
    """Ray: address of the cluster; if not given, RAY_ADDRESS, else one on this machine, new if there is none."""
    only: int | None = None
    """Carry out only the run of this number, as --dry-run lists them, and write no report (array jobs)."""
    report_only: bool = False
    """Only write the report from the existing results; train and evaluate nothing."""
    dry_run: bool = False
    """Only list the runs, their states and the command lines of their trainings."""

    def check(self) -> None:
        """Check what the types cannot."""
        check_at_least(1, episodes=self.episodes, workers=self.workers)
        check_at_least(0, gpus_per_run=self.gpus_per_run)
        if self.cpus_per_run is not None:
            check_at_least(1, cpus_per_run=self.cpus_per_run)
        if not isinstance(self.particles, str):
            check_at_least(1, particles=self.particles)
        for name, value in (("gpus_per_run", self.gpus_per_run), ("address", self.address)):
            if value and self.executor == "local":
                raise ConfigError(f"{name} requires --executor ray, got {value}")
        if self.workers > 1 and self.executor == "ray":
            raise ConfigError(
                f"workers requires --executor local (Ray starts what its cluster can), got {self.workers}"
            )
        if self.only is not None and self.report_only:
            raise ConfigError(f"only cannot be combined with --report-only, got {self.only}")

    def make_executor(self) -> LocalExecutor | RayExecutor:
        """What carries out the runs."""
        if self.executor == "ray":
            return RayExecutor(self.address, Resources(self.cpus_per_run or 1, self.gpus_per_run))
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        threads = self.cpus_per_run or max(1, available // self.workers)
        return LocalExecutor(self.workers, Resources(threads))


def compare(command: Command) -> int:
    """Carry out a comparison; returns the exit code."""
    command.check()
    runs = make_runs(
        read_plan(command.plan),
        command.tasks,
        command.algos,
        command.seeds,
        command.out / "runs",
        preset=command.preset,
        steps=command.steps,
        device=command.device,
    )
    protocol = Protocol(command.episodes, command.particles, command.noise)
    for run in runs:
        run.check_folder()
    if command.only is not None and not 0 <= command.only < len(runs):
        raise ConfigError(f"only must be between 0 and {len(runs) - 1}, got {command.only}")
    if command.dry_run:
        for number, run in enumerate(runs):
            words = "" if run.reference else f"  torchmpm train {shlex.join(run.words)}"
            print(f"{number:>4}  {run.name:<40} {read_result(run, protocol).state:<13}{words}".rstrip())
        return 0
    if command.report_only:
        return _report(command, runs, protocol)
    chosen = runs if command.only is None else [runs[command.only]]
    chosen = [run for run in chosen if read_result(run, protocol).state != "finished"]
    outcomes: list[Outcome] = []

    def on_outcome(run: PlannedRun, outcome: Outcome) -> None:
        outcomes.append(outcome)
        print(f"[{len(outcomes)}/{len(chosen)}] {run.name}: {outcome} {run.error}".rstrip(), flush=True)

    command.out.mkdir(parents=True, exist_ok=True)
    executor = command.make_executor()
    try:
        execute(chosen, protocol, executor, on_outcome)
    except KeyboardInterrupt:
        print("stopped; the same command resumes the comparison")
        return 130
    finally:
        code = int(any(each != "finished" for each in outcomes))
        if command.only is None:
            code = _report(command, runs, protocol)
    return code


def _report(command: Command, runs: Sequence[PlannedRun], protocol: Protocol) -> int:
    """Write the report; returns 0 if all runs are finished and evaluated, else 1."""
    results = [read_result(run, protocol) for run in runs]
    print(f"report: {write_report(command.out, results, command.algos[0], protocol)}")
    return 0 if all(result.state == "finished" for result in results) else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry point; returns the exit code."""
    return run_command(lambda: compare(read_command(Command, "baselines.compare", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())
