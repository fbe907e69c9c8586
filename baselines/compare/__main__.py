"""``python -m baselines.compare``: several algorithms, tasks and seeds, and one report about them."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.executor import Executor, InProcessExecutor, LocalExecutor, RayExecutor, Resources, execute
from baselines.compare.final_evaluation import Protocol, ProtocolNoise, Robustness
from baselines.compare.jobs import Job, Plan, check_folder, make_jobs
from baselines.compare.report import write_report
from baselines.compare.results import RunResult, read_result
from baselines.compare.worker import Outcome
from baselines.leaderboard.evaluation import submit
from baselines.leaderboard.protocol import PROTOCOLS
from baselines.registry import ALGORITHMS, ALIASES
from cfp.config import Preset, RunConfig
from cfp.errors import ConfigError
from cfp.experiment.cli import program_name, read_options, run_command
from cfp.experiment.folder import Folder, make_folder
from cfp.experiment.process import Stopped, StopSignals
from cfp.sections import Particles
from cfp.validation import check_at_least

#: Options that the help shows first.
BASIC = ("tasks", "algos", "seeds", "preset", "steps", "device", "workers", "episodes", "out", "report_only")
#: Seconds to wait for another process that holds a run folder; file servers take a while to give up a lost machine.
LOCK_TIMEOUT, CLUSTER_LOCK_TIMEOUT = 30.0, 300.0


@dataclass(frozen=True)
class Command:
    """Train what is missing, reuse what is finished, resume what was interrupted, evaluate all, and write a report.

    Ctrl-C stops all runs with a checkpoint; the same command resumes them. Exit code 0: every run is finished and
    evaluated; 1: some are not, and the report says why; 2: an option is wrong.
    """

    tasks: tuple[str, ...] = ("shapematch",)
    """Tasks."""
    algos: tuple[str, ...] = ("zero", "cfp")
    """Algorithms, or variants that the plan names; include zero, relative to which sample efficiency is measured."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the runs; the reference policies zero, random and scripted have one run, with the first seed."""
    out: Folder = Path("runs/compare")
    """Folder of the report, with the run folders in runs/."""
    plan: Path | None = None
    """JSON file with options of runs, under common, tasks and algos."""
    preset: Preset = "quick"
    """Preset of all runs."""
    steps: int | None = None
    """Environment steps of every algorithm with this option, unless the plan gives it."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    episodes: int = 10
    """Episodes of the final evaluation of each policy."""
    particles: Particles = "lite"
    """Particles of the final evaluation, for all policies."""
    noise: ProtocolNoise = "paper"
    """Action noise of all policies in the final evaluation: with, without, or as in the paper, that is without in
    SHAPE MATCH and with it in all other tasks."""
    slot_episodes: int = 100
    """Minimum number of episodes in SLOT, summed over the seeds of an algorithm, for its success rate."""
    robustness: Robustness = "paper"
    """Disturbed cases that are evaluated."""
    executor: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks of a Ray cluster."""
    workers: int = 1
    """Local: runs at a time, each in a process of its own; 0: one after the other in this process."""
    cpus_per_run: int | None = None
    """Cores of a run; if not given, an equal share of this machine's for each worker, or 1 on a cluster."""
    gpus_per_run: float = 0.0
    """Ray: GPUs of a run, also a fraction of one."""
    retries: int = 2
    """Number of times that a run is restarted after its process or node was lost."""
    address: str | None = None
    """Ray: address of the cluster; if not given, RAY_ADDRESS, else one on this machine, new if there is none."""
    only: int | None = None
    """Carry out only the run of this number, as --dry-run lists them, and write no report (array jobs)."""
    report_only: bool = False
    """Only write the report from the existing results; train and evaluate nothing."""
    dry_run: bool = False
    """Only list the runs and their states."""
    protocol: Literal["v1"] | None = None
    """Fixed protocol of the leaderboard, under which each finished run is also evaluated; its submission is written to
    submissions/ in the folder of the report."""
    policies: tuple[str, ...] = ()
    """With a protocol: carry out no runs and evaluate these policies instead: names of pretrained ones, run folders,
    policy files, hf://OWNER/NAME, or zero, random and scripted, which act in each of the tasks."""

    def check(self) -> None:
        """Check what the types cannot."""
        check_at_least(1, episodes=self.episodes, slot_episodes=self.slot_episodes)
        if self.cpus_per_run is not None:
            check_at_least(1, cpus_per_run=self.cpus_per_run)
        check_at_least(0, workers=self.workers, gpus_per_run=self.gpus_per_run, retries=self.retries)
        if self.gpus_per_run and self.executor == "local":
            raise ConfigError(f"gpus_per_run must be 0 without --executor ray, got {self.gpus_per_run}")
        if self.address is not None and self.executor == "local":
            raise ConfigError(f"address requires --executor ray, got {self.address}")
        if self.only is not None and self.report_only:
            raise ConfigError(f"only cannot be combined with --report-only, got {self.only}")
        if self.protocol is not None and (self.only is not None or self.report_only):
            raise ConfigError(f"protocol cannot be combined with --only or --report-only, got {self.protocol}")
        if self.policies and (self.protocol is None or self.report_only or self.dry_run or self.only is not None):
            names = " ".join(self.policies)
            raise ConfigError(f"policies requires protocol, and none of only, report_only and dry_run, got {names}")
        if self.protocol is not None:
            for task in self.tasks:
                PROTOCOLS[self.protocol].check_task(task)

    @property
    def final_protocol(self) -> Protocol:
        """How policies are evaluated."""
        return Protocol(self.episodes, self.particles, self.robustness, self.noise)

    def protocol_of(self, config: RunConfig) -> Protocol:
        """How the policy of a run is evaluated: SLOT has more episodes."""
        if config.task != "slot":
            return self.final_protocol
        runs = 1 if config.algo in REFERENCE_POLICIES else len(self.seeds)
        return replace(self.final_protocol, episodes=max(self.episodes, -(-self.slot_episodes // runs)))

    def make_executor(self, signals: StopSignals) -> Executor:
        """What carries out the runs."""
        one_machine = self.executor == "local" and self.only is None
        lock_timeout = LOCK_TIMEOUT if one_machine else CLUSTER_LOCK_TIMEOUT
        resources = Resources(self.cpus_per_run, self.gpus_per_run, self.retries, lock_timeout)
        if self.executor == "ray":
            return RayExecutor(self.address, resources)
        return LocalExecutor(self.workers, resources) if self.workers else InProcessExecutor(signals, resources)


def compare(command: Command) -> int:
    """Carry out a comparison; returns the exit code."""
    command.check()
    command = replace(command, algos=tuple(ALIASES.get(name, name) for name in command.algos))  # as the report names it
    if command.policies:
        _submit(command, command.policies)
        return 0
    plan = Plan.read(command.plan)
    for part, names in plan.unused(command.tasks, command.algos).items():
        print(f"plan: {part} {', '.join(names)} are not in this comparison")
    jobs = make_jobs(
        plan,
        command.tasks,
        command.algos,
        command.seeds,
        command.out / "runs",
        command.protocol_of,
        preset=command.preset,
        steps=command.steps,
        device=command.device,
    )
    for job in jobs:
        check_folder(job)
    if command.only is not None and not 0 <= command.only < len(jobs):
        raise ConfigError(f"only must be between 0 and {len(jobs) - 1}, got {command.only}")
    if command.dry_run:
        print("\n".join(f"{number:>4}  {job.name:<40} {job.state}" for number, job in enumerate(jobs)))
        return 0
    if command.report_only:
        return 0 if all(run.state == "finished" for run in _report(command, jobs)) else 1
    chosen = jobs if command.only is None else [jobs[command.only]]
    make_folder(command.out)
    with StopSignals() as signals:
        outcomes = _carry_out(command, chosen, signals)
    if command.only is None:
        _report(command, jobs)
    if command.protocol and not signals.number:
        names = [job.config.algo if job.untrained else str(job.folder) for job in jobs if job.trained]
        _submit(command, list(dict.fromkeys(names)))  # a reference policy has a run in each task
    if signals.number:
        raise Stopped(signals.number, "the same command resumes the comparison")
    return 0 if set(outcomes) == {"finished"} else 1


def _carry_out(command: Command, jobs: Sequence[Job], signals: StopSignals) -> list[Outcome]:
    """Carry out runs and print how each ended."""
    outcomes: list[Outcome] = []

    def on_outcome(job: Job, outcome: Outcome) -> None:
        outcomes.append(outcome)
        reason = f" ({job.error})" if outcome == "failed" and job.error else ""
        ending = "not begun" if outcome == "stopped" and job.state == "missing" else outcome
        print(f"[{len(outcomes)}/{len(jobs)}] {job.name}: {ending}{reason}", flush=True)

    execute(command.make_executor(signals), jobs, signals, on_outcome)
    return outcomes


def _submit(command: Command, policies: Sequence[str]) -> None:
    """Write the submissions of policies under the protocol."""
    assert command.protocol is not None
    submit(PROTOCOLS[command.protocol], policies, command.tasks, command.out / "submissions")


def _report(command: Command, jobs: Sequence[Job]) -> list[RunResult]:
    description = (
        f"{', '.join(command.algos)} on {', '.join(command.tasks)}, preset {command.preset}, seeds "
        f"{', '.join(map(str, command.seeds))}."
    )
    runs = [read_result(job) for job in jobs]
    print(f"report: {write_report(command.out, runs, command.final_protocol, description)}")
    return runs


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry point; returns the exit code."""
    names = f"Algorithms: {', '.join(ALGORITHMS)}. Reference policies: {', '.join(REFERENCE_POLICIES)}."
    program = program_name("baselines.compare", arguments)
    examples = (
        "--tasks shapematch --algos cfp shac --seeds 0 1",
        "--tasks run kick --algos zero gradient --out runs/reach --workers 2",
        "--out runs/reach --report-only",
        "--protocol v1 --policies run runs/mine/policy.safetensors --out runs/mine",
    )
    return run_command(
        lambda: compare(read_options(Command(), BASIC, prog=program, about=names, examples=examples, args=arguments))
    )


if __name__ == "__main__":
    sys.exit(main())
