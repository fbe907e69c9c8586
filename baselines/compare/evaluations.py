"""Final evaluations of a run's policy, kept in ``judged.json`` of its folder so that none is made twice."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.plan import judged, read_notes
from baselines.registry import load, reference_policy
from cfp.config import RunConfig
from cfp.envs.disturbances import Case, make_cases
from cfp.envs.make import choose_device, make_env
from cfp.evaluation.evaluate import Result, evaluate, evaluation_seed
from cfp.files import write_json
from cfp.policy import Policy
from cfp.robustness import report
from cfp.sections import Particles
from cfp.weights import policy_file

CHUNK = 10
"""Episodes side by side; what is kept when an evaluation is stopped, or more episodes are asked for."""
PAPER_CASES = 3
"""Of `make_cases`: unperturbed, action dropout, observation dropout, which the paper reports."""


@dataclass(frozen=True)
class Judging:
    """How policies are judged.

    Attributes:
        episodes: For each policy, on the same layouts for all.
        tier: Particles, see `cfp.config.EnvironmentConfig`.
        robustness: Which disturbed cases: none, those of the paper, or all of `cfp.envs.disturbances.make_cases`.
        parity: Of the run, which holds at full size only, see `cfp.config.EnvironmentConfig.for_evaluation`.
    """

    episodes: int
    tier: Particles = "lite"
    robustness: Literal["none", "paper", "all"] = "paper"
    parity: Literal["clean", "reference"] = "clean"

    def cases(self) -> list[Case]:
        """Cases of the robustness table, the unperturbed one first: it is the evaluation on the common layouts."""
        return [] if self.robustness == "none" else make_cases()[: PAPER_CASES if self.robustness == "paper" else None]

    def chunks(self) -> list[tuple[int, int]]:
        """First layout and number of layouts of each part of the evaluation."""
        return [(first, min(CHUNK, self.episodes - first)) for first in range(0, self.episodes, CHUNK)]

    def key(self, what: str) -> str:
        """Under which an entry is kept."""
        mended = self.parity == "reference" and self.tier != "full"  # not what an earlier version has judged
        return f"{what}, particles {self.tier}" + (", parity clean" if mended else "")

    def to_json(self) -> dict[str, Any]:
        """For `from_json`."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Judging:
        """Undo `to_json` after a way through JSON."""
        tier = values["tier"]
        return cls(**{**values, "tier": tuple(tier) if isinstance(tier, list) else tier})


@dataclass(frozen=True)
class Judged:
    """What the judging of a policy has found so far.

    Attributes:
        returns: One for each episode on the common layouts; fewer than asked for while judging goes on.
        successes: How many of them were successful, None where the task does not define success.
        own: Return on the one layout that the policy was made for, if it was.
        cases: Mean return by case, the unperturbed one first; None where a case changes nothing for the policy or was
            not tried on all layouts yet.
        whole: Nothing is left to do.
    """

    returns: tuple[float, ...]
    successes: int | None
    own: float | None
    cases: dict[str, float | None]
    whole: bool


class Record:
    """``judged.json`` of a run folder; what was found for another policy file counts no longer.

    Args:
        folder: Of the run.

    Raises:
        CheckpointError: There is no policy, or the record is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / "judged.json"
        self.policy = hashlib.sha256(policy_file(folder).read_bytes()).hexdigest()
        there = read_notes(self.path, entries=dict) if self.path.exists() else {}
        self.entries: dict[str, Any] = there["entries"] if there.get("policy") == self.policy else {}

    def once(self, key: str, make: Callable[[], Any]) -> None:
        """Make and keep an entry that is not there."""
        if key not in self.entries:
            self.entries[key] = make()
            write_json(self.path, {"policy": self.policy, "entries": self.entries})


def judge(config: RunConfig, folder: Path, judging: Judging, stop: Callable[[], None]) -> None:
    """Make the evaluations that are missing.

    Args:
        config: Of the run.
        folder: Of the run.
        judging: What is asked for.
        stop: Called between two parts; raises to stop.

    Raises:
        CheckpointError: There is no policy, or it is damaged.
        ConfigError: The environment refuses an option.
    """
    record, own = Record(folder), judged(config, judging.tier)
    policy: Policy
    if config.algo in REFERENCE_POLICIES:
        policy = reference_policy(config)
    else:
        policy = load(folder / "policy.safetensors", choose_device(config.device))

    def part(first: int, count: int) -> dict[str, Any]:
        return _entry(_evaluate(own, policy, evaluation_seed(own) + first, count))

    def disturbed(first: int, count: int, case: Case) -> list[dict[str, Any]]:
        return [_entry(result) for result in report(replace(own, seed=own.seed + first), policy, [case], count)]

    for first, count in judging.chunks():
        stop()
        record.once(_layouts(judging, first, count), partial(part, first, count))
    if "layout" in policy.description:
        layout = policy.description["layout"]
        record.once(judging.key("own layout"), lambda: _entry(_evaluate(own, policy, layout, 1)))
    for case in judging.cases()[1:]:
        for first, count in judging.chunks():
            stop()
            record.once(_layouts(judging, first, count, case), partial(disturbed, first, count, case))


def read(folder: Path, judging: Judging) -> Judged | None:
    """What has been found so far; None without a policy or a whole part of its evaluation.

    Raises:
        CheckpointError: The record is damaged.
    """
    if not (folder / "policy.safetensors").exists():
        return None
    entries = Record(folder).entries
    keys = [_layouts(judging, first, count) for first, count in judging.chunks()]
    parts = [entries[key] for key in keys if key in entries]
    if not parts:
        return None
    returns = [value for part in parts for value in part["returns"]]
    successes = [part["successes"] for part in parts]
    own, cases = entries.get(judging.key("own layout")), judging.cases()
    found = {
        case.name: [entries.get(_layouts(judging, first, count, case)) for first, count in judging.chunks()]
        for case in cases[1:]
    }
    means: dict[str, float | None] = {case.name: _mean(returns) for case in cases[:1]}
    return Judged(
        tuple(returns),
        None if None in successes else sum(successes),
        None if own is None else own["returns"][0],
        means | {name: _mean_of(results) for name, results in found.items()},
        len(parts) == len(keys) and not any(None in results for results in found.values()),
    )


def _layouts(judging: Judging, first: int, count: int, case: Case | None = None) -> str:
    layouts = f"layouts {first} to {first + count - 1}"
    return judging.key(layouts if case is None else f"{case.name}, {layouts}")


def _evaluate(config: RunConfig, policy: Policy, seed: int, count: int) -> Result:
    env = make_env(config, policy.resolution, count)
    return evaluate("", policy, env, count, deterministic=policy.deterministic_by_default, seed=seed)


def _entry(result: Result) -> dict[str, Any]:
    successes = None if result.success is None else round(result.success * len(result.returns))
    return {"returns": list(result.returns), "successes": successes}


def _mean_of(parts: list[list[dict[str, Any]] | None]) -> float | None:
    """Mean return of a case; None where it changes nothing, or a part of it is missing."""
    return _mean([value for part in parts if part for value in part[0]["returns"]]) if all(parts) else None


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
