"""Evaluating policies: their returns on episodes used for nothing else, beside those of untrained policies.

Episodes are played side by side on all cores, each with the result, to the last bit, that it has when played alone. On
a CPU every episode has an environment and a thread of its own: the simulation then takes the same path whatever else is
played, and an episode that has ended costs nothing. Policies act one after the other, because torch's generator, from
which they take their noise, belongs to the whole process.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import islice
from threading import Event, Lock
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.special import stdtrit  # scipy.stats takes a second to import
from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import EVALUATION_SEED, RunConfig
from cfp.envs.make import choose_device, make_torch_env
from cfp.envs.vec_env import DIVERGED, reward_error
from cfp.errors import NonFiniteError
from cfp.messages import progress_bar
from cfp.policy import Memory, Observation, Policy, Start
from dittogym import Conditions, TorchEnv
from dittogym.action import trained_layout
from dittogym.copies import to_device, to_host
from dittogym.env import as_numpy
from dittogym.pieces import largest_piece
from dittogym.render.recording import attached, generators_kept, seed_noise
from dittogym.spec import TaskSpec
from torchmpm import checks

#: With action noise or without; default: as the run that trained a policy evaluates it.
Noise = Literal["default", "with", "without", "both"]
#: How tables name a policy that was made for one start: on that start, and on those of the other policies.
PLAN, REPLAYED = "plan", "plan, replayed from another start"


def evaluation_seed(config: RunConfig) -> int:
    """Seed of the layouts of final evaluations, on which no policy was trained or chosen."""
    return config.seed + 2 * EVALUATION_SEED


def without_noise(policy: Policy, noise: Noise) -> bool:
    """Whether a policy acts without noise."""
    return policy.deterministic_by_default if noise == "default" else noise == "without"


def is_plan(policy: Policy) -> bool:
    """Whether a policy is a plan: actions made for one start, whose seed its description names."""
    return "layout" in policy.description


def name_in_table(name: str, policy: Policy) -> str:
    """How a table of results names a policy, on starts that are the same for all policies."""
    return REPLAYED if is_plan(policy) else name


def decision_grid(policy: Policy) -> int:
    """Rows and columns on which a policy decides; one of several stages returns an enlarged blend."""
    return int(policy.description.get("resolution", policy.resolution))


@dataclass(frozen=True)
class UntrainedPolicy:
    """Slack muscles, or actions uniform in [-1, 1], independent in every cell and step, from torch's generator."""

    kind: Literal["zero", "random"]
    resolution: int  # rows and columns R of its actions

    uses_image = False

    @property
    def deterministic_by_default(self) -> bool:
        """Whether it always does the same."""
        return self.kind == "zero"

    @property
    def description(self) -> dict[str, Any]:
        """It comes from no training."""
        return {}

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Actions (B, 2, R, R), or (2, R, R) for a single image; ``deterministic`` changes nothing."""
        single = isinstance(observation, np.ndarray) and observation.ndim == 3
        shape = (*(() if single else (len(observation),)), 2, self.resolution, self.resolution)
        actions = torch.zeros(shape) if self.kind == "zero" else 2.0 * torch.rand(shape) - 1.0
        return actions.numpy(), state


class FunctionPolicy:
    """A function of the observation alone; raises a `TypeError` for anything else."""

    def __init__(self, function: Any) -> None:
        if not callable(function):
            raise TypeError(f"policy must be a function or have a method predict, got {type(function).__name__}")
        self.function = function

    @torch.no_grad()
    def predict(self, observation: Observation, *_: Any, **__: Any) -> tuple[np.ndarray, Memory]:
        """Actions of the function, and no memory."""
        return np.asarray(self.function(observation)), None


# Playing episodes.


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


class Played(NamedTuple):
    """How an episode of an evaluation went.

    Attributes:
        total: Undiscounted return.
        success: Whether the task was solved in the last step; None where the task does not define success.
        torn: Whether the limit on the robot's spread ended the episode.
        piece: Share of the robot in its largest piece after the last step, from 0 to 1, see
            `dittogym.pieces.largest_piece`.
        mean_piece: The same share, mean over the steps.
        terms: Sum of each weighted term of the reward over the episode, by name; they add up to ``total``.
    """

    total: float
    success: bool | None
    torn: bool
    piece: float
    mean_piece: float
    terms: Mapping[str, float] = {}


@dataclass(frozen=True, eq=False)
class Trial:
    """Some episodes of one policy, on the layouts from ``seed`` on."""

    name: str
    resolution: int  # of the grid on which it decides
    policy: PolicyPredictor
    make_env: Callable[[int], TorchEnv]  # of a number of simulations
    episodes: int
    deterministic: bool
    seed: int
    together: bool = False  # all episodes in one environment, on devices that are faster that way; or each in its own

    def spans(self) -> list[tuple[int, int]]:
        """First layout and number of layouts of each environment."""
        if self.together:
            return [(self.seed, self.episodes)]
        return [(self.seed + k, 1) for k in range(self.episodes)]

    def play(self, first: int, count: int, before_step: Callable[[], None]) -> list[Played]:
        """Play the episodes of a span, that of the first layout first."""
        env = self.make_env(count)
        acting = SeededPolicy(attached(self.policy, env), first, before_step)
        with torch.no_grad():
            observation, _ = env.reset(seed=first)
        memory, starts = None, np.ones(count, bool)
        totals = np.zeros(count, np.float32)  # added up as stable-baselines3 does
        terms: dict[str, np.ndarray] = {}
        pieces: list[np.ndarray] = []
        played: dict[int, Played] = {}
        while len(played) < count:
            chosen, memory = acting.predict(as_numpy(observation), memory, starts, deterministic=self.deterministic)
            if not np.isfinite(chosen).all():
                raise NonFiniteError(DIVERGED)
            action = to_device(np.array(chosen, np.float32), env.device)
            with torch.no_grad():
                observation, reward, terminated, truncated, info = env.step(action)
            step = {"reward": reward, "done": terminated | truncated}
            step |= {name: info[name] for name in info.keys() & {"split", "is_success"}}
            values = to_host(step | {f"term {name}": value for name, value in info["reward_terms"].items()})
            if not np.isfinite(values["reward"]).all():
                raise reward_error(info["reward_terms"])
            starts = values["done"]
            totals += values["reward"].astype(np.float32)
            for name in info["reward_terms"]:
                terms[name] = terms.get(name, 0.0) + values[f"term {name}"]
            pieces.append(largest_piece(env.state.x[:, : env.model.num_robot_particles], env.env_state.origin))
            for i in np.flatnonzero(starts).tolist():
                if i in played:
                    continue
                limit, piece = env.spec.split_limit, [shares[i] for shares in pieces]
                played[i] = Played(
                    total=float(totals[i]),
                    success=bool(values["is_success"][i]) if "is_success" in values else None,
                    torn=limit is not None and bool(values["split"][i] > limit),
                    piece=float(piece[-1]),
                    mean_piece=float(np.mean(piece)),
                    terms={name: float(sums[i]) for name, sums in terms.items()},
                )
            if starts.any() and len(played) < count:
                with torch.no_grad():  # so that what has ended stays a robot, and not what is left of one
                    observation, _ = env.reset(options={"reset_mask": torch.from_numpy(starts)})
        return [played[i] for i in range(count)]


def make_trial(
    config: RunConfig,
    name: str,
    policy: Policy,
    episodes: int,
    *,
    deterministic: bool,
    seed: int,
    conditions: Conditions | None = None,
) -> Trial:
    """Episodes of a policy in the environment of a run, under conditions if given."""
    return Trial(
        name=name,
        resolution=decision_grid(policy),
        policy=policy,
        make_env=lambda count: make_torch_env(config, policy.resolution, count, conditions=conditions),
        episodes=episodes,
        deterministic=deterministic,
        seed=seed,
        together=torch.device(choose_device(config.device)).type != "cpu",
    )


class EpisodesStopped(Exception):
    """Another episode failed, or the program is being stopped."""


# Their returns.


def t_interval(values: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of a mean (Student's t); None for fewer than two values."""
    count = len(values)
    if count < 2:
        return None
    return float(stdtrit(count - 1, 0.975) * np.std(values, ddof=1) / math.sqrt(count))


@dataclass(frozen=True)
class Result:
    """The result of an evaluation, as `cfp.evaluate_policy` returns it.

    Attributes:
        name: Name of the policy in tables.
        resolution: R of its action grid.
        episodes: The episodes in the order of their seeds, so that results of two policies can be compared in pairs.
    """

    name: str
    resolution: int
    episodes: tuple[Played, ...]

    @property
    def returns(self) -> tuple[float, ...]:
        """Undiscounted returns of the episodes."""
        return tuple(episode.total for episode in self.episodes)

    @property
    def mean(self) -> float:
        """Mean return of the episodes."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the returns over the episodes, of the sample and not of its mean."""
        return float(np.std(self.returns))

    @property
    def interval(self) -> float | None:
        """Half the width of the 95 % confidence interval of the mean (Student's t); None for one episode."""
        return t_interval(self.returns)

    @property
    def terms(self) -> dict[str, float]:
        """What each weighted term of the reward contributes to the mean return, by name."""
        return {name: _mean(each.terms[name] for each in self.episodes) for name in self.episodes[0].terms}

    @property
    def success(self) -> float | None:
        """Share of successful episodes; None where the task does not define success."""
        return None if self.episodes[0].success is None else _mean(bool(each.success) for each in self.episodes)

    @property
    def success_whole(self) -> float | None:
        """Share of the episodes that succeed and are not torn; None where the task does not define success."""
        defined = self.episodes[0].success is not None
        return _mean(bool(each.success) and not each.torn for each in self.episodes) if defined else None

    @property
    def torn(self) -> float:
        """Share of the episodes that the limit on the robot's spread ended."""
        return _mean(each.torn for each in self.episodes)

    @property
    def piece(self) -> float:
        """Share of the robot in its largest piece after the last step, mean over the episodes."""
        return _mean(each.piece for each in self.episodes)

    @property
    def mean_piece(self) -> float:
        """Share of the robot in its largest piece, mean over all steps and episodes."""
        return _mean(each.mean_piece for each in self.episodes)


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def evaluate(
    trials: Sequence[Trial],
    steps: int,
    should_stop: Callable[[], bool] = lambda: False,
    name: str = "evaluation",
) -> list[Result]:
    """Evaluate policies without learning; torch's generator is left as it was.

    A trial gives the same result whatever the number of threads and whatever is evaluated beside it.

    Args:
        trials: Episodes, all played side by side.
        steps: Steps of an episode at most, for the progress bar.
        should_stop: Asked before each step; once it is true, the evaluation ends in `EpisodesStopped`.
        name: What the progress bar is called.
    """
    spans = [(trial, *span) for trial in trials for span in trial.spans()]
    threads, stop = torch.get_num_threads(), Event()
    # On a GPU one at a time: nobody may draw random numbers while an environment records its operations.
    workers = 1 if any(trial.together for trial in trials) else min(threads, len(spans))
    total = steps * sum(trial.episodes for trial in trials)
    # Beside the bar of a training (leave=None) it vanishes at the end.
    bar = progress_bar(total=total, desc=name, leave=None)

    def play_span(trial: Trial, first: int, count: int) -> list[Played]:
        taken = 0

        def before_step() -> None:
            nonlocal taken
            if stop.is_set() or should_stop():
                raise EpisodesStopped
            taken += count
            bar.update(count)

        torch.set_num_threads(1)
        episodes = trial.play(first, count, before_step)
        bar.update(steps * count - taken)
        return episodes

    with bar, generators_kept(), ThreadPoolExecutor(workers or 1) as pool:
        futures = [pool.submit(play_span, *span) for span in spans]
        try:
            for future in wait(futures, return_when=FIRST_EXCEPTION).done:
                future.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)
    played = (episode for future in futures for episode in future.result())
    return [Result(trial.name, trial.resolution, tuple(islice(played, trial.episodes))) for trial in trials]


def evaluate_policy(
    policy: PolicyPredictor | Callable[[np.ndarray], Any],
    task: str | TaskSpec,
    episodes: int = 20,
    *,
    seed: int = 2 * EVALUATION_SEED,
    deterministic: bool = False,
    **options: Any,
) -> Result:
    """Evaluate any policy as this package evaluates its own: by return, success, and matter in one piece.

    The result is the same, to the last bit, with any number of cores.

    Args:
        policy: A policy of this package; a model of stable-baselines3; another object with the method
            ``predict(observation, state, episode_start, deterministic)``, which returns actions (B, 2, R, R) and a
            memory or ``None``; or a function of the observation alone. Observations are (B, 3, 64, 64) uint8.
        task: A task name, ``"MODULE:NAME"``, or a `dittogym.TaskSpec`.
        episodes: Number of episodes.
        seed: Seed of the first episode; the others have the numbers after it. From the default seed on, episodes start
            from positions on which no policy of this package was trained.
        deterministic: Act without noise.
        options: Options of the environment, such as ``particles`` and ``conditions``, see `dittogym.TorchEnv`.
            ``resolution`` and ``action_layout`` are those of the policy, if it has them, unless they are given.

    Returns:
        Returns, successes and other measures of the episodes.

    Raises:
        TypeError: The policy is of another kind, or the task has no such option.
        ValueError: An argument is out of range, or an action has another shape.
        cfp.NonFiniteError: An action or a reward is NaN or infinite.

    Examples:
        >>> import cfp, dittogym
        >>> late = dittogym.Conditions(latency=1)
        >>> result = cfp.evaluate_policy(cfp.load("shapematch"), "shapematch", 2, particles="lite", conditions=late)
        >>> len(result.returns), result.mean > 300
        (2, True)
    """
    checks.whole("episodes", episodes, 1)
    checks.whole("seed", seed, 0)
    own = {"resolution": getattr(policy, "resolution", None), "action_layout": trained_layout(policy)}
    options = {name: value for name, value in own.items() if value is not None} | options
    acting = policy if hasattr(policy, "predict") else FunctionPolicy(policy)

    def make_env(count: int) -> TorchEnv:
        return TorchEnv(task, count, **options)

    env = make_env(1)  # refuses options before threads begin, and knows the horizon
    together = env.device.type != "cpu"
    trial = Trial("policy", env.action_resolution, acting, make_env, episodes, deterministic, seed, together)
    return evaluate([trial], env.spec.horizon)[0]


def compare(config: RunConfig, policies: Mapping[str, Policy], episodes: int, noise: Noise = "default") -> list[Result]:
    """Evaluate policies beside zero and random action on the same layouts; a plan also on the one it was made for."""
    coarsest, seed = config.resolution(1), evaluation_seed(config)
    trials = [
        make_trial(config, f"{kind} action", UntrainedPolicy(kind, coarsest), episodes, deterministic=True, seed=seed)
        for kind in ("zero", "random")
    ]
    for name, trained in policies.items():
        default, shown = without_noise(trained, noise), name_in_table(name, trained)
        if is_plan(trained):
            own = trained.description["layout"]
            trials.append(make_trial(config, PLAN, trained, 1, deterministic=default, seed=own))
        for deterministic in (False, True) if noise == "both" else (default,):
            label = f"{shown}, {'mean' if deterministic else 'noisy'}" if noise == "both" else shown
            trials.append(make_trial(config, label, trained, episodes, deterministic=deterministic, seed=seed))
    return evaluate(trials, config.make_spec().horizon)


def to_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Results as JSON values."""
    return [
        {
            "policy": result.name,
            "action": f"{result.resolution}x{result.resolution}",
            "episodes": len(result.returns),
            "mean": round(result.mean, 3),
            "std": round(result.std, 3),
            "interval": None if result.interval is None else round(result.interval, 3),
            "returns": [round(value, 3) for value in result.returns],
            "success": result.success,
            "success_whole": result.success_whole,
            "torn": result.torn,
            "piece": round(result.piece, 4),
            "mean_piece": round(result.mean_piece, 4),
        }
        for result in results
    ]


def format_table(config: RunConfig, results: Sequence[Result]) -> str:
    """Results as a plain text table: mean return, its 95 % confidence interval, and the spread of the episodes."""
    counts = {len(result.returns) for result in results}
    title = f"{config.task}, return over {' or '.join(map(str, sorted(counts)))} episodes"
    width = max(16, *(len(result.name) + 2 for result in results))
    titles = f"{'action':>8}{'mean':>10}{'± 95 %':>9}{'± std':>9}{'lowest':>10}{'highest':>10}"
    lines = [title, f"{'policy':<{width}}{titles}"]
    for result in results:
        grid = f"{result.resolution}x{result.resolution}"
        interval = "–" if result.interval is None else f"{result.interval:.1f}"
        spread = f"{result.mean:>10.1f}{interval:>9}{result.std:>9.1f}"
        spread += f"{min(result.returns):>10.1f}{max(result.returns):>10.1f}"
        success = "" if result.success is None else f"   success {result.success:.0%}"
        lines.append(f"{result.name:<{width}}{grid:>8}{spread}{success}   in one piece {result.piece:.0%}")
    return "\n".join(lines)


def explain(config: RunConfig, results: Sequence[Result], chosen: bool) -> str:
    """Why the final table of a run and the evaluations during its training have different numbers.

    Args:
        config: Options of the run.
        results: The table.
        chosen: Whether the evaluations chose the policy.
    """
    sentences = []
    if chosen and config.eval_every:
        varied = any(config.conditions(stage) for stage in range(1, len(config.ends()) + 1))
        conditions = " Conditions varied in the episodes of training, and do not vary in these." if varied else ""
        starts = "" if config.make_spec().starts_alike else ", from starts that neither trained nor chose the policy"
        sentences.append(
            "Evaluations during training give other numbers: they chose the policy, so the best of them is partly "
            f"luck. This table is of other episodes{starts}.{conditions}"
        )
    if any(result.name == PLAN for result in results):
        sentences.append(
            "A plan is made for one start, and its own episode was the evaluation during training; the row below it "
            "shows what the same actions do from other starts."
        )
    return " ".join(sentences)
