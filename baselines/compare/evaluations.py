"""The final evaluation of a run's policy, recorded in its folder so that no episode is played twice."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from baselines.compare import paper
from baselines.compare.jobs import Job, read_record
from baselines.registry import load
from cfp.config import RunConfig, Tier
from cfp.envs.disturbances import Case, make_cases
from cfp.envs.make import choose_device, make_env
from cfp.evaluation.rollout import Policy, Result, evaluate, judging_seed
from cfp.experiment.files import write_json
from cfp.robustness import report

RECORD = "final_evaluation.json"
BATCH = 10
"""Episodes side by side; what is kept when an evaluation is stopped, or more episodes are asked for."""
PAPER_CASES = 3
"""How many of `make_cases` the paper reports: unperturbed, action dropout, observation dropout."""

Noise = Literal["paper", "with", "without"]
Entry = dict[str, Any]
"""``returns`` of some episodes, and how many of them were ``successes`` (None if the task does not define success)."""


@dataclass(frozen=True)
class Protocol:
    """How policies are evaluated; the same for all policies of a comparison.

    Attributes:
        episodes: Number of episodes, on the same layouts for all policies.
        tier: Particles, see `cfp.config.EnvironmentConfig`.
        robustness: Disturbed cases: none, those of the paper, or all of `cfp.envs.disturbances.make_cases`.
        noise: Whether policies act with their action noise; ``paper``: except in the tasks in `paper.WITHOUT_NOISE`.
    """

    episodes: int
    tier: Tier = "lite"
    robustness: Literal["none", "paper", "all"] = "paper"
    noise: Noise = "paper"

    def cases(self) -> list[Case]:
        """Cases of the robustness table; the first one is unperturbed, the evaluation on the common layouts."""
        return [] if self.robustness == "none" else make_cases()[: PAPER_CASES if self.robustness == "paper" else None]

    def deterministic(self, task: str) -> bool:
        """Whether policies act without noise in a task."""
        return task in paper.WITHOUT_NOISE if self.noise == "paper" else self.noise == "without"

    def batches(self) -> list[tuple[int, int]]:
        """First layout and number of layouts of each batch of episodes."""
        return [(first, min(BATCH, self.episodes - first)) for first in range(0, self.episodes, BATCH)]

    def key(self, what: str, task: str) -> str:
        """Key of an entry in the record: evaluations with other particles or other noise have another one."""
        return f"{what}, particles {self.tier}, {'without' if self.deterministic(task) else 'with'} noise"

    def batch_key(self, task: str, first: int, count: int, case: Case | None = None) -> str:
        """Key of a batch of episodes, unperturbed or in a disturbed case."""
        layouts = f"layouts {first} to {first + count - 1}"
        return self.key(layouts if case is None else f"{case.name}, {layouts}", task)

    def to_json(self) -> dict[str, Any]:
        """JSON values for `from_json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Protocol:
        """Inverse of `to_json`."""
        tier = values["tier"]
        return cls(**{**values, "tier": tuple(tier) if isinstance(tier, list) else tier})


@dataclass(frozen=True)
class FinalEvaluation:
    """What the evaluation of a policy has found so far.

    Attributes:
        returns: One per episode on the common layouts; fewer than asked for while the evaluation is incomplete.
        successes: Number of successful episodes, None if the task does not define success.
        own_layout: Return on the one layout that the policy was made for, if there is one.
        cases: Mean return by case, the unperturbed one first; None if a case changes nothing for the policy, or has not
            been tried on all layouts yet.
        complete: Whether nothing is left to do.
    """

    returns: tuple[float, ...]
    successes: int | None
    own_layout: float | None
    cases: dict[str, float | None]
    complete: bool


class Record:
    """The entries in ``final_evaluation.json`` of a run folder that belong to the policy that is there now.

    Args:
        job: The run.

    Raises:
        CheckpointError: There is no policy, or the record is damaged.
    """

    def __init__(self, job: Job) -> None:
        self.path = job.folder / RECORD
        self.policy = hashlib.sha256((job.folder / "policy.safetensors").read_bytes()).hexdigest()
        record = read_record(self.path, policy=str, entries=dict) if self.path.exists() else {}
        self.entries: dict[str, Any] = record["entries"] if record.get("policy") == self.policy else {}

    def add(self, key: str, make: Callable[[], Entry | None]) -> None:
        """Make an entry that is missing, and write it; None where a case changes nothing for the policy."""
        if key not in self.entries:
            self.entries[key] = make()
            write_json(self.path, {"policy": self.policy, "entries": self.entries})


def evaluation_config(config: RunConfig, tier: Tier) -> RunConfig:
    """Options of the environment of a final evaluation: seed 0 for all runs, so that all play the same layouts.

    The environment depends on ``tier`` and not on the particles of the run, so that it is the same for all runs.
    """
    return replace(config, seed=0, environment=config.environment.judged_at(tier))


def evaluate_run(job: Job, protocol: Protocol, check_stop: Callable[[], None]) -> None:
    """Evaluate the policy of a run as far as that has not been done.

    Args:
        job: The run.
        protocol: How to evaluate.
        check_stop: Called between two batches of episodes; raises to stop.

    Raises:
        CheckpointError: There is no policy, or it is damaged.
        ConfigError: The environment refuses an option.
    """
    record, task = Record(job), job.config.task
    config, deterministic = evaluation_config(job.config, protocol.tier), protocol.deterministic(task)
    policy = load(job.folder / "policy.safetensors", choose_device(job.config.device))

    def play(seed: int, count: int) -> Entry:
        env = make_env(config, policy.resolution, count)
        return _entry(evaluate("", policy, env, count, deterministic=deterministic, seed=seed))

    def play_disturbed(first: int, count: int, case: Case) -> Entry | None:
        shifted = replace(config, seed=config.seed + first)
        results = report(shifted, policy, [case], count, deterministic=deterministic)
        return _entry(results[0]) if results else None

    for first, count in protocol.batches():
        check_stop()
        seed = judging_seed(config) + first
        record.add(protocol.batch_key(task, first, count), lambda seed=seed, count=count: play(seed, count))
    if "layout" in policy.description:
        layout = policy.description["layout"]
        record.add(protocol.key("own layout", task), lambda: play(layout, 1))
    for case in protocol.cases()[1:]:
        for batch in protocol.batches():
            check_stop()
            record.add(
                protocol.batch_key(task, *batch, case), lambda batch=batch, case=case: play_disturbed(*batch, case)
            )


def read_evaluation(job: Job, protocol: Protocol) -> FinalEvaluation | None:
    """What has been found so far; None without a policy or a whole batch of episodes.

    Raises:
        CheckpointError: The record is damaged.
    """
    if not (job.folder / "policy.safetensors").exists():
        return None
    entries, task, batches = Record(job).entries, job.config.task, protocol.batches()

    def found(case: Case | None = None) -> list[Entry | None]:
        keys = [protocol.batch_key(task, *batch, case) for batch in batches]
        return [entries[key] for key in keys if key in entries]

    parts = [part for part in found() if part is not None]
    if not parts:
        return None
    returns = [value for part in parts for value in part["returns"]]
    successes, own = [part["successes"] for part in parts], entries.get(protocol.key("own layout", task))
    disturbed = {case.name: found(case) for case in protocol.cases()[1:]}
    cases: dict[str, float | None] = {case.name: sum(returns) / len(returns) for case in protocol.cases()[:1]}
    return FinalEvaluation(
        tuple(returns),
        None if None in successes else sum(successes),
        None if own is None else own["returns"][0],
        cases | {name: _mean_return(parts, len(batches)) for name, parts in disturbed.items()},
        all(len(each) == len(batches) for each in (parts, *disturbed.values())),
    )


def _entry(result: Result) -> Entry:
    successes = None if result.success is None else round(result.success * len(result.returns))
    return {"returns": list(result.returns), "successes": successes}


def _mean_return(parts: list[Entry | None], batches: int) -> float | None:
    """Mean return of a case; None if it changes nothing, or a batch is missing."""
    returns = [value for part in parts if part is not None for value in part["returns"]]
    return sum(returns) / len(returns) if returns and len(parts) == batches else None
