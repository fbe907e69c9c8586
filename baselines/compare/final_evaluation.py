"""The final evaluation of a run's policy, recorded in its folder so that it can be continued."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare import paper
from baselines.registry import load, reference_policy
from cfp.config import RunConfig
from cfp.envs.disturbances import Case, make_cases
from cfp.envs.make import choose_device
from cfp.errors import CheckpointError
from cfp.evaluation.returns import Result, evaluate, evaluation_seed, make_trial
from cfp.files import read_json, write_json
from cfp.robustness import report
from cfp.sections import Particles

RECORD = "final_evaluation.json"
#: Episodes side by side; whole batches are kept when an evaluation is stopped, or more episodes are asked for.
BATCH = 10
#: How many of `make_cases` the paper reports: unperturbed, action dropout, observation dropout.
PAPER_CASES = 3

ProtocolNoise = Literal["paper", "with", "without"]
Robustness = Literal["none", "paper", "all"]
#: ``returns`` of some episodes, and how many of them were ``successes`` (None if the task does not define success).
Entry = dict[str, Any]


@dataclass(frozen=True)
class Protocol:
    """How policies are evaluated; but for the episodes in SLOT the same for all policies of a comparison."""

    episodes: int  # on the same layouts for all policies
    particles: Particles = "lite"
    robustness: Robustness = "paper"
    noise: ProtocolNoise = "paper"  # whether policies act with their noise; paper: except in `paper.WITHOUT_NOISE`

    def disturbed_cases(self) -> list[Case]:
        """Cases of the robustness table."""
        last = {"none": 1, "paper": PAPER_CASES, "all": None}[self.robustness]
        return make_cases()[1:last]

    def deterministic(self, task: str) -> bool:
        """Whether policies act without noise in a task."""
        return task in paper.WITHOUT_NOISE if self.noise == "paper" else self.noise == "without"

    def key(self, task: str, layouts: str, case: Case | None = None) -> str:
        """Key of an entry in the record; other particles or other noise make another entry."""
        noise = "without" if self.deterministic(task) else "with"
        return f"{f'{case.name}, ' if case else ''}{layouts}, particles {self.particles}, {noise} noise"

    def batches(self, task: str, case: Case | None = None) -> dict[str, tuple[int, int]]:
        """First layout and number of layouts of each batch of episodes, by the key of its entry."""
        spans = [(first, min(BATCH, self.episodes - first)) for first in range(0, self.episodes, BATCH)]
        return {
            self.key(task, f"layouts {first} to {first + count - 1}", case): (first, count) for first, count in spans
        }


@dataclass(frozen=True)
class FinalEvaluation:
    """What the evaluation of a policy has found so far."""

    returns: tuple[float, ...]  # one per episode on the common layouts
    successes: int | None  # number of episodes; None if the task does not define success
    own_layout: float | None  # return on the one layout that the policy was made for, if there is one
    cases: dict[str, float | None]  # mean returns; None if a case has no effect or is not complete
    complete: bool

    @property
    def mean(self) -> float:
        """Mean return on the common layouts."""
        return float(np.mean(self.returns))


#: Bytes of the largest record that is read; one return takes about 28.
LARGEST_RECORD = 2**26


class Record:
    """The entries in ``final_evaluation.json`` of a run folder that belong to the policy that is there now."""

    def __init__(self, config: RunConfig, folder: Path) -> None:
        self.path, policy = folder / RECORD, folder / "policy.safetensors"
        self.policy = config.algo  # of a reference policy
        if config.algo not in REFERENCE_POLICIES and policy.exists():
            self.policy = hashlib.sha256(policy.read_bytes()).hexdigest()
        record = read_record(self.path, policy=str, entries=dict) if self.path.exists() else {}
        self.entries: dict[str, Any] = record["entries"] if record.get("policy") == self.policy else {}

    def add(self, key: str, make: Callable[[], Entry | None]) -> None:
        """Make an entry that is missing, and write it; None where a case changes nothing for the policy."""
        if key not in self.entries:
            self.entries[key] = make()
            write_json(self.path, {"policy": self.policy, "entries": self.entries})


def read_record(path: Path, **types: type) -> dict[str, Any]:
    """Read a JSON object from a run folder; ``types`` are those of the values that it must hold."""
    try:
        record = read_json(path, LARGEST_RECORD)
        for name, kind in types.items():
            if not isinstance(record[name], kind):
                raise TypeError(f"{name} must be of type {kind.__name__}, got {record[name]!r}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: cannot be read ({type(error).__name__}: {error})") from error
    return record


def evaluation_config(config: RunConfig, particles: Particles) -> RunConfig:
    """Options of a final evaluation: seed 0 and the ``particles``, so that all runs play the same episodes."""
    return replace(config, seed=0, environment=config.environment.for_evaluation(particles))


def evaluate_run(config: RunConfig, folder: Path, protocol: Protocol, check_stop: Callable[[], None]) -> None:
    """Evaluate the policy of a run as far as that has not been done; ``check_stop`` is called between two batches."""
    record, task, deterministic = Record(config, folder), config.task, protocol.deterministic(config.task)
    if config.algo in REFERENCE_POLICIES:
        policy = reference_policy(config)
    else:
        policy = load(folder / "policy.safetensors", choose_device(config.device))
    config = evaluation_config(config, protocol.particles)

    def play(seed: int, count: int) -> Entry:
        trial = make_trial(config, "", policy, count, deterministic=deterministic, seed=seed)
        return _entry(evaluate([trial])[0])

    def play_disturbed(first: int, count: int, case: Case) -> Entry | None:
        results = report(replace(config, seed=first), policy, [case], count, deterministic=deterministic)
        return _entry(results[0]) if results else None

    for key, (first, count) in protocol.batches(task).items():
        check_stop()
        record.add(key, partial(play, evaluation_seed(config) + first, count))
    if "layout" in policy.description:
        record.add(protocol.key(task, "own layout"), partial(play, policy.description["layout"], 1))
    for case in protocol.disturbed_cases():
        for key, (first, count) in protocol.batches(task, case).items():
            check_stop()
            record.add(key, partial(play_disturbed, first, count, case))


def _entry(result: Result) -> Entry:
    successes = None if result.success is None else round(result.success * len(result.returns))
    return {"returns": list(result.returns), "successes": successes}


def read_evaluation(config: RunConfig, folder: Path, protocol: Protocol) -> FinalEvaluation | None:
    """What has been found so far; None without a whole batch of episodes."""
    task, entries, complete = config.task, Record(config, folder).entries, True
    parts = [entries[key] for key in protocol.batches(task) if key in entries]
    if not parts:
        return None
    cases: dict[str, float | None] = {}
    for case in protocol.disturbed_cases():
        keys = protocol.batches(task, case)
        returns = [value for key in keys if entries.get(key) for value in entries[key]["returns"]]
        whole = all(key in entries for key in keys)
        cases[case.name] = float(np.mean(returns)) if whole and returns else None
        complete = complete and whole
    own = entries.get(protocol.key(task, "own layout"))
    return FinalEvaluation(
        returns=tuple(value for part in parts for value in part["returns"]),
        successes=None if parts[0]["successes"] is None else sum(part["successes"] for part in parts),
        own_layout=own and own["returns"][0],
        cases=cases,
        complete=complete and len(parts) == len(protocol.batches(task)),
    )
