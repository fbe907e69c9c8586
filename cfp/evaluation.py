"""Returns of a policy on environments of its own, and the untrained policies it is compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from cfp.config import Config
from cfp.environments import EVALUATION_SEED, make_env
from cfp.policy import ActorPolicy


@dataclass(frozen=True)
class Result:
    """Undiscounted returns of some episodes.

    Attributes:
        name: Of the policy.
        resolution: Its action grid R.
        returns: One sum of raw rewards per episode.
        success: Share of successful episodes, None where the task does not define success.
    """

    name: str
    resolution: int
    returns: tuple[float, ...]
    success: float | None = None

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over the episodes (of this sample, not of its mean)."""
        return float(np.std(self.returns))


class ZeroPolicy:
    """Leaves every muscle slack.

    Args:
        resolution: Action grid R.
    """

    def __init__(self, resolution: int) -> None:
        self.resolution = resolution

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions (B, 2, R, R) for a batch of observations, as stable-baselines3's ``predict``."""
        return self._actions(len(observation)), state

    def _actions(self, count: int) -> np.ndarray:
        return np.zeros((count, 2, self.resolution, self.resolution), np.float32)


class RandomPolicy(ZeroPolicy):
    """Uniform actions in [-1, 1], independent in every cell and step.

    Args:
        resolution: Action grid R.
        seed: Seed of its own generator.
    """

    def __init__(self, resolution: int, seed: int) -> None:
        super().__init__(resolution)
        self.generator = np.random.default_rng(seed)

    def _actions(self, count: int) -> np.ndarray:
        actions = self.generator.uniform(-1, 1, (count, 2, self.resolution, self.resolution))
        return actions.astype(np.float32)


def evaluate(
    name: str, policy: PolicyPredictor, env: VecEnv, episodes: int, *, deterministic: bool, seed: int
) -> Result:
    """Run episodes without learning.

    Neither the environments of a training run nor torch's generator are touched, and the same seed gives the same
    episodes: element i of the batch starts from layout ``seed + EVALUATION_SEED + i``.

    Args:
        name: Of the policy, for the result.
        policy: Anything with stable-baselines3's ``predict``.
        env: Environments used for evaluation only.
        episodes: How many.
        deterministic: Act without noise.
        seed: Of the run.
    """
    successes: list[bool] = []

    def note_success(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(bool(local["info"]["is_success"]))

    env.seed(seed + EVALUATION_SEED)
    cuda = list(range(torch.cuda.device_count()))
    with torch.random.fork_rng(devices=cuda):
        torch.manual_seed(seed + EVALUATION_SEED)
        returns, _ = evaluate_policy(
            policy, env, episodes, deterministic=deterministic, callback=note_success, return_episode_rewards=True
        )
    assert isinstance(returns, list)
    success = float(np.mean(successes)) if successes else None
    action_space = env.action_space
    assert action_space.shape is not None
    return Result(name, action_space.shape[-1], tuple(float(value) for value in returns), success)


def compare(config: Config, policies: Mapping[str, ActorPolicy], episodes: int) -> list[Result]:
    """Evaluate trained policies beside zero and random action, all on the same particle layouts.

    Args:
        config: The run's options.
        policies: By name, each with its own resolution. Zero and random action use the coarsest.
        episodes: Episodes of each.
    """
    coarsest = config.resolutions[0]
    seed = config.seed + EVALUATION_SEED  # layouts that neither trained a policy nor chose the best one
    env = make_env(config, coarsest, episodes)
    untrained = {"zero action": ZeroPolicy(coarsest), "random action": RandomPolicy(coarsest, config.seed)}
    results = [
        evaluate(name, policy, env, episodes, deterministic=True, seed=seed) for name, policy in untrained.items()
    ]
    for name, trained in policies.items():
        resolution = trained.spec.resolutions[-1]
        if env.action_space.shape != (2, resolution, resolution):
            env = make_env(config, resolution, episodes)
        deterministic = trained.deterministic_by_default
        results.append(evaluate(name, trained, env, episodes, deterministic=deterministic, seed=seed))
    return results


def to_rows(results: list[Result]) -> list[dict[str, Any]]:
    """Results as JSON values."""
    return [
        {
            "policy": result.name,
            "action": f"{result.resolution}x{result.resolution}",
            "episodes": len(result.returns),
            "mean": round(result.mean, 3),
            "std": round(result.std, 3),
            "returns": [round(value, 3) for value in result.returns],
            "success": result.success,
        }
        for result in results
    ]


def format_table(config: Config, results: list[Result]) -> str:
    """Results as a plain text table: mean and standard deviation of the return over the episodes."""
    counts = {len(result.returns) for result in results}
    title = f"{config.task}, return over {'/'.join(map(str, sorted(counts)))} episodes"
    lines = [title, f"{'policy':<16}{'action':>8}{'mean':>10}{'± std':>9}{'lowest':>10}{'highest':>10}"]
    for result in results:
        grid = f"{result.resolution}x{result.resolution}"
        spread = f"{result.mean:>10.1f}{result.std:>9.1f}{min(result.returns):>10.1f}{max(result.returns):>10.1f}"
        success = "" if result.success is None else f"   success {result.success:.0%}"
        lines.append(f"{result.name:<16}{grid:>8}{spread}{success}")
    return "\n".join(lines)
