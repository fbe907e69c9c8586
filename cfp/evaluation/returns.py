"""Evaluating policies: their returns on environments used for nothing else, beside those of untrained policies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.special import stdtrit  # scipy.stats takes a second to import

from cfp.config import EVALUATION_SEED, EnvironmentConfig, RunConfig
from cfp.envs.make import batch_size, make_env
from cfp.evaluation.episodes import Trial, play
from cfp.evaluation.untrained import UntrainedPolicy
from cfp.files import read_json
from cfp.policy_protocols import Policy

#: With action noise or without; default: as the run that trained a policy evaluates it.
Noise = Literal["default", "with", "without", "both"]
#: Returns of zero and random action by task, as committed in ``docs/leaderboard``; none of them succeeds.
REFERENCE_RETURNS = Path(__file__).with_name("reference_returns.json")


@dataclass(frozen=True)
class Result:
    """Undiscounted returns of some episodes of a policy."""

    name: str
    resolution: int  # of its action grid
    returns: tuple[float, ...]  # those of element 0 first, so that equal places are equal layouts
    success: float | None = None  # share of episodes, None where the task does not define success

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over the episodes (of this sample, not of its mean)."""
        return float(np.std(self.returns))

    @property
    def interval(self) -> float | None:
        """Half the width of the 95 % confidence interval of the mean (Student's t); None for one episode."""
        count = len(self.returns)
        if count < 2:
            return None
        return float(stdtrit(count - 1, 0.975) * np.std(self.returns, ddof=1) / math.sqrt(count))


def evaluation_seed(config: RunConfig) -> int:
    """Seed of the layouts of final evaluations, on which no policy was trained or chosen."""
    return config.seed + 2 * EVALUATION_SEED


def decision_grid(policy: Policy) -> int:
    """Rows and columns on which a policy decides; one of several stages returns an enlarged blend."""
    return int(policy.description.get("resolution", policy.resolution))


def make_trial(config: RunConfig, name: str, policy: Policy, episodes: int, *, deterministic: bool, seed: int) -> Trial:
    """Episodes of a policy in the environment of a run."""
    size = policy.resolution
    return Trial(
        name=name,
        resolution=decision_grid(policy),
        policy=policy,
        make_env=lambda _, count: make_env(config, size, count),
        episodes=episodes,
        deterministic=deterministic,
        seed=seed,
        batch=batch_size(config, episodes),
    )


def evaluate(
    trials: Sequence[Trial], steps: int | None = None, should_stop: Callable[[], bool] = lambda: False
) -> list[Result]:
    """Evaluate policies without learning; torch's generator is left as it was.

    A trial gives the same result whatever the number of threads and whatever is evaluated beside it.

    Args:
        trials: Episodes, all played side by side.
        steps: Steps of an episode at most, to show a progress bar on a terminal; None shows none.
        should_stop: Asked before each step; once it is true, the evaluation ends in `EpisodesStopped`.
    """
    results = []
    for trial, episodes in zip(trials, play(trials, steps, should_stop), strict=True):
        successes = [episode.success for episode in episodes if episode.success is not None]
        success = float(np.mean(successes)) if successes else None
        results.append(Result(trial.name, trial.resolution, tuple(episode.total for episode in episodes), success))
    return results


def untrained(config: RunConfig, episodes: int) -> list[Result]:
    """Returns of zero and random action: those of `REFERENCE_RETURNS` where they hold, else of episodes played now.

    They hold in the tasks of the package with lite particles and default physics; the table has eight layouts of each.
    """
    table = read_json(REFERENCE_RETURNS).get(config.task)
    without_influence = {name: getattr(config, name) for name in ("num_envs", "backend", "action_layout")}
    kinds: tuple[Literal["zero", "random"], ...] = ("zero", "random")
    if table and config.environment == EnvironmentConfig(**without_influence):
        return [Result(f"{kind} action", table["resolution"], tuple(table[kind][:episodes]), 0.0) for kind in kinds]
    options: dict[str, Any] = {"deterministic": True, "seed": evaluation_seed(config)}
    policies = {f"{kind} action": UntrainedPolicy(kind, config.resolution(1)) for kind in kinds}
    trials = [make_trial(config, name, policy, episodes, **options) for name, policy in policies.items()]
    return evaluate(trials, config.make_spec().horizon)


def compare(config: RunConfig, policies: Mapping[str, Policy], episodes: int, noise: Noise = "default") -> list[Result]:
    """Evaluate policies, beside zero and random action; one made for a single layout also there."""
    trials, seed = [], evaluation_seed(config)
    for name, trained in policies.items():
        default = without_noise(trained, noise)
        for deterministic in (False, True) if noise == "both" else (default,):
            label = f"{name}, {'mean' if deterministic else 'noisy'}" if noise == "both" else name
            trials.append(make_trial(config, label, trained, episodes, deterministic=deterministic, seed=seed))
        if "layout" in trained.description:
            own = trained.description["layout"]
            trials.append(make_trial(config, "  own layout", trained, 1, deterministic=default, seed=own))
    return untrained(config, episodes) + evaluate(trials, config.make_spec().horizon)


def without_noise(policy: Policy, noise: Noise) -> bool:
    """Whether a policy acts without noise."""
    return policy.deterministic_by_default if noise == "default" else noise == "without"
