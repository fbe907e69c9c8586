"""Evaluating policies: their returns on environments used for nothing else, beside those of untrained policies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from scipy import stats
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from cfp.agent.actor_policy import Memory, Observation, Start
from cfp.config import EVALUATION_SEED, RunConfig
from cfp.envs.make import make_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.policy_protocols import Policy, SeesState

Noise = Literal["default", "with", "without", "both"]
"""With action noise or without; default: as the run that trained a policy evaluates it."""


def attached(policy: PolicyPredictor, env: VecEnv) -> PolicyPredictor:
    """A policy for an environment of `make_env`: one that sees the state is shown it, any other stays as it is."""
    inner = env.unwrapped
    if isinstance(policy, SeesState) and isinstance(inner, TorchVecEnv):
        return policy.attached(inner.torch_env)
    return policy


@dataclass(frozen=True)
class SingleThreaded:
    """A policy that acts with one thread: with several, torch adds up convolutions in another order."""

    policy: PolicyPredictor

    def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, Memory]:
        """Actions of the policy."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return self.policy.predict(*args, **kwargs)
        finally:
            torch.set_num_threads(threads)


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
        return float(stats.t.ppf(0.975, count - 1) * np.std(self.returns, ddof=1) / math.sqrt(count))


def evaluation_seed(config: RunConfig) -> int:
    """Seed of the layouts of final evaluations, on which no policy was trained or chosen."""
    return config.seed + 2 * EVALUATION_SEED


@dataclass(frozen=True)
class UntrainedPolicy:
    """Draws actions (B, 2, R, R) by their shape, whatever it sees."""

    resolution: int
    draw: Callable[[tuple[int, ...]], Any]

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Actions for a batch of observations."""
        actions: np.ndarray = self.draw((len(observation), 2, self.resolution, self.resolution))
        return actions.astype(np.float32), state


def evaluate(
    name: str, policy: PolicyPredictor, env: VecEnv, episodes: int, *, deterministic: bool, seed: int
) -> Result:
    """Run episodes without learning, element i of the batch from layout ``seed + i``; torch's generator is not touched.

    The same seed gives the same episodes; with reference parity, whose resets show what was before, in a new ``env``.
    """
    elements: list[int] = []
    successes: list[bool] = []

    def note(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"]:
            elements.append(local["i"])
            if "is_success" in local["info"]:
                successes.append(bool(local["info"]["is_success"]))

    acting = SingleThreaded(attached(policy, env))
    env.seed(seed)
    with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        torch.manual_seed(seed)
        returns, _ = evaluate_policy(
            acting, env, episodes, deterministic=deterministic, callback=note, return_episode_rewards=True
        )
    assert isinstance(returns, list)
    ordered = np.asarray(returns)[np.argsort(elements, kind="stable")]  # they come as the episodes end
    success = float(np.mean(successes)) if successes else None
    assert env.action_space.shape is not None
    return Result(name, env.action_space.shape[-1], tuple(ordered.tolist()), success)


def compare(config: RunConfig, policies: Mapping[str, Policy], episodes: int, noise: Noise = "default") -> list[Result]:
    """Evaluate policies beside zero and random action on the same layouts; one made for a single layout also there."""
    coarsest, seed = config.resolution(1), evaluation_seed(config)
    uniform = partial(np.random.default_rng(config.seed).uniform, -1, 1)

    def evaluated(name: str, policy: Policy | UntrainedPolicy, deterministic: bool) -> Result:
        env = make_env(config, policy.resolution, episodes)
        return evaluate(name, policy, env, episodes, deterministic=deterministic, seed=seed)

    results = [
        evaluated("zero action", UntrainedPolicy(coarsest, np.zeros), True),
        evaluated("random action", UntrainedPolicy(coarsest, uniform), True),
    ]
    for name, trained in policies.items():
        deterministic = trained.deterministic_by_default if noise == "default" else noise == "without"
        grid = trained.description.get("resolution", trained.resolution)
        for quiet in (False, True) if noise == "both" else (deterministic,):
            label = f"{name}, {'mean' if quiet else 'noisy'}" if noise == "both" else name
            results.append(replace(evaluated(label, trained, quiet), resolution=grid))
        if "layout" in trained.description:
            alone, own = make_env(config, trained.resolution, 1), trained.description["layout"]
            results.append(evaluate("  own layout", trained, alone, 1, deterministic=deterministic, seed=own))
    return results
