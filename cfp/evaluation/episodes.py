"""Episodes played side by side on all cores, each with the result, to the last bit, that it has when played alone.

On a CPU every episode has an environment and a thread of its own: the simulation then takes the same path whatever
else is played, and an episode that has ended costs nothing. Policies act one after the other, because torch's
generator, from which they take their noise, belongs to the whole process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from cfp.agent.actor_policy import Memory
from cfp.envs.disturbances import Disturbed
from cfp.envs.vec_env import TorchVecEnv
from cfp.policy_protocols import DisturbablePolicy, SeesState
from dittogym.render.recording import seed_noise


def attached(policy: PolicyPredictor, env: VecEnv) -> PolicyPredictor:
    """A policy for an environment: one that sees the state is shown it, one with decisions of its own is disturbed."""
    inner = env.unwrapped
    if isinstance(policy, DisturbablePolicy) and isinstance(env, Disturbed):
        policy, env.disturbs_actions = policy.through(env.disturb), False
    if isinstance(policy, SeesState) and isinstance(inner, TorchVecEnv):
        return policy.attached(inner.torch_env)
    return policy


class SeededPolicy:
    """A policy whose noise depends on nothing but the layout and the number of the step.

    It acts with one thread, because with several torch adds up convolutions in another order.

    Args:
        policy: The policy.
        layout: Seed of the (first) layout.
        before_step: Called before each step.
    """

    _turn = Lock()

    def __init__(self, policy: PolicyPredictor, layout: int, before_step: Callable[[], None] = lambda: None) -> None:
        self.policy, self.layout, self.before_step = policy, layout, before_step
        self.steps = 0

    def predict(self, *args: Any, **kwargs: Any) -> tuple[np.ndarray, Memory]:
        """Actions of the policy; reseeds torch's generator."""
        self.before_step()
        threads = torch.get_num_threads()
        with self._turn:
            torch.set_num_threads(1)
            try:
                seed_noise(self.layout, self.steps)
                self.steps += 1
                return self.policy.predict(*args, **kwargs)
            finally:
                torch.set_num_threads(threads)


@dataclass(frozen=True)
class Episode:
    """How an episode went."""

    total: float  # its undiscounted return
    success: bool | None  # None where the task does not define success


@dataclass(frozen=True, eq=False)
class Trial:
    """Some episodes of one policy, on the layouts from ``seed`` on."""

    name: str
    resolution: int  # of the grid on which it decides
    policy: PolicyPredictor
    make_env: Callable[[int, int], VecEnv]  # from the first layout and the number of layouts
    episodes: int
    deterministic: bool
    seed: int
    batch: int = 1  # episodes in one environment; more only on devices that are faster that way

    def spans(self) -> list[tuple[int, int]]:
        """First layout and number of layouts of each environment."""
        return [
            (self.seed + first, min(self.batch, self.episodes - first)) for first in range(0, self.episodes, self.batch)
        ]

    def play(self, first: int, count: int, before_step: Callable[[], None]) -> list[Episode]:
        """Play the episodes of a span, that of the first layout first."""
        env = self.make_env(first, count)
        played: dict[int, bool | None] = {}

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"]:
                played[local["i"]] = local["info"].get("is_success")

        acting = SeededPolicy(attached(self.policy, env), first, before_step)
        env.seed(first)
        returns, _ = evaluate_policy(
            acting, env, count, deterministic=self.deterministic, callback=note, return_episode_rewards=True
        )
        assert isinstance(returns, list)
        ended = dict(zip(played, returns, strict=True))  # both in the order in which the episodes ended
        return [Episode(float(ended[i]), played[i]) for i in range(count)]


class EpisodesStopped(Exception):
    """Another episode failed, or the program is being stopped."""


def play(
    trials: Sequence[Trial], steps: int | None = None, should_stop: Callable[[], bool] = lambda: False
) -> list[list[Episode]]:
    """Play the episodes of all trials, those of each in the order of their layouts.

    Args:
        trials: What to play.
        steps: Steps of an episode at most, to show a progress bar on a terminal; None shows none.
        should_stop: Asked before each step; once it is true, the episodes end in `EpisodesStopped`.
    """
    spans = [(trial, *span) for trial in trials for span in trial.spans()]
    threads, stop = torch.get_num_threads(), Event()
    workers = min(threads, len(spans)) if all(trial.batch == 1 for trial in trials) else 1
    total = (steps or 0) * sum(count for *_, count in spans)
    bar = tqdm(total=total, unit="step", disable=None if total else True)  # None: only a terminal shows it

    def play_span(trial: Trial, first: int, count: int) -> list[Episode]:
        taken = 0

        def before_step() -> None:
            nonlocal taken
            if stop.is_set() or should_stop():
                raise EpisodesStopped
            taken += count
            bar.update(count)

        torch.set_num_threads(1)
        episodes = trial.play(first, count, before_step)
        bar.update((steps or 0) * count - taken)
        return episodes

    with bar, torch.random.fork_rng(devices=range(torch.cuda.device_count())), ThreadPoolExecutor(workers or 1) as pool:
        futures = {key: pool.submit(partial(play_span, *key)) for key in spans}
        try:
            for future in wait(futures.values(), return_when=FIRST_EXCEPTION).done:
                future.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)
    return [
        [each for first, count in trial.spans() for each in futures[trial, first, count].result()] for trial in trials
    ]
