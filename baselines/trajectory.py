"""Open-loop actions by gradient descent through the simulation."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from baselines.common.grid import Grid, OptimisationConfig, find_grid, long_dt
from baselines.common.open_loop import OpenLoop, OpenLoopLearner
from baselines.common.rollout import check_differentiable
from cfp.config import EnvironmentConfig, Particles, RunConfig
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError, NonFiniteError, check_at_least, check_positive
from cfp.experiment.folder import policy_path
from cfp.learner import FINAL_FRACTION, Scalars, Sees
from cfp.presets import sac_preset
from cfp.resumable import Resumable
from dittogym import TorchEnv, make_spec
from dittogym.action import bicubic
from dittogym.observation import soft_silhouette
from dittogym.tasks.shapematch import reward_fn as overlap

#: Of Adam.
BETAS = (0.9, 0.98)
#: A step's gradient is clipped to this multiple of its running mean norm, which has this momentum.
CLIP, NORM_MOMENTUM = 3.0, 0.9
#: An iteration whose loss exceeds the best one by this fraction of its size is undone, and the learning rate is
#: multiplied by this factor.
MAX_RISE, BACKOFF = 0.1, 0.7
#: Failed iterations in a row after which training gives up.
PATIENCE = 10

#: Every scalar that ``Gradient.update`` logs, and what it means.
METRICS: dict[str, str] = {
    "train/loss": "the objective, mean over layouts and steps",
    "train/return": "mean return of the iteration's episodes, at the particle count of training",
    "train/gradient_norm": "norm of the gradient before it is clipped",
    "train/clipped": "fraction of control steps whose gradient was clipped",
    "train/learning_rate": "Adam's step size in this iteration",
    "train/failed": "iterations of this stage that were undone",
}


def cosine_decay(progress: float) -> float:
    """Factor that falls from 1 to `FINAL_FRACTION` along a cosine as ``progress`` goes from 0 to 1."""
    return FINAL_FRACTION + (1.0 - FINAL_FRACTION) * 0.5 * (1.0 + math.cos(math.pi * progress))


@dataclass(frozen=True, kw_only=True)
class GradientConfig(OptimisationConfig):
    """Options of open-loop gradient descent, whose iterations simulate num_envs episodes on fixed particle layouts.

    The environment options apply to evaluations, train_particles and train_dt to the simulations in training.
    """

    algo: str = "gradient"
    """Name of the algorithm."""
    iterations: int = 150
    """Updates in the first stage."""
    grid: Grid = 16
    """Action grid R of the first stage: coarse or fine (the task's), or a number."""
    learning_rate: float = 0.05
    """Adam's step size at the beginning; it falls to a tenth along a cosine."""
    window: int = 0
    """Control steps that a gradient reaches back; 0: the whole episode."""
    train_particles: Particles = "lite"
    """Particles of the simulation in the first stage."""
    blur: tuple[float, ...] = (4.0, 2.0, 1.0, 0.0)
    """Standard deviations, in pixels, of the blur of both pictures in SHAPE MATCH, used one after the other."""
    polish: int = 0
    """Updates in a second stage, on the particles and the one layout of this seed on which it is evaluated."""
    polish_grid: Grid = "fine"
    """Action grid R of the second stage."""
    polish_learning_rate: float = 0.05
    """Adam's step size at the beginning of the second stage."""

    changeable: ClassVar[tuple[str, ...]] = ("polish", "polish_grid", "polish_learning_rate", *RunConfig.changeable)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which each stage ends."""
        horizon = make_spec(self.task).horizon
        first = self.iterations * horizon * self.num_envs
        return (first, first + self.polish * horizon) if self.polish else (first,)

    def resolution(self, stage: int) -> int:
        """Action grid R of a stage."""
        return find_grid("polish_grid", self.task, self.polish_grid) if stage > 1 else super().resolution(stage)

    def evaluation(self, stage: int) -> tuple[int, int]:
        """The second stage is evaluated on its own layout."""
        return (self.seed, 1) if stage > 1 else super().evaluation(stage)

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, iterations=self.iterations)
        check_at_least(0, window=self.window, polish=self.polish)
        check_positive(learning_rate=self.learning_rate, polish_learning_rate=self.polish_learning_rate)
        if not self.blur or min(self.blur) < 0:
            raise ConfigError(f"blur must be one or more numbers, none of them negative, got {self.blur}")


class Objective:
    """The negative smooth reward; in SHAPE MATCH the difference from the target picture, which may be blurred.

    This is the mean absolute difference of the soft silhouette and the target, both blurred. A wide blur pulls matter
    towards a target that it does not touch, a narrow one shapes the outline.
    """

    def __init__(self, env: TorchEnv, blur: tuple[float, ...]) -> None:
        self.target: Tensor | None = None
        if env.spec.target is not None and env.spec.reward_fn is overlap:
            self.target = torch.as_tensor(env.spec.target, device=env.device, dtype=env.dtype)
            self.blurs = [gaussian_matrix(sigma, len(self.target)).to(self.target) for sigma in blur]

    def phase(self, progress: float) -> int:
        """Index of the blur at a fraction of the training, 0 to 1. Losses compare within a phase only."""
        return 0 if self.target is None else min(int(progress * len(self.blurs)), len(self.blurs) - 1)

    def __call__(self, env: TorchEnv, reward: Tensor, progress: float) -> Tensor:
        """Loss (B,) of the environment after a step with rewards (B,)."""
        if self.target is None:
            return -reward
        blur = self.blurs[self.phase(progress)]
        difference = soft_silhouette(env.soft_observation()) - self.target
        return (blur @ difference @ blur.T).abs().mean((1, 2))


def gaussian_matrix(sigma: float, size: int) -> Tensor:
    """Gaussian blur along one axis as a matrix (size, size), float64, with zeros beyond the borders."""
    if sigma == 0:
        return torch.eye(size, dtype=torch.float64)
    offset = torch.arange(-4 * size, 4 * size + 1, dtype=torch.float64)
    weight = torch.exp(-0.5 * (offset / sigma) ** 2)
    distance = torch.arange(size)[:, None] - torch.arange(size)
    return weight[4 * size + distance] / weight.sum()


class Iteration(NamedTuple):
    """Result of one iteration."""

    loss: float  # mean over layouts and steps
    size: float  # mean magnitude of the same values: a loss made of rewards and costs can be zero, this cannot
    total: float  # mean return
    gradient: Tensor  # of the loss in theta, (T, 2, R, R)


class Gradient(Resumable, OpenLoopLearner):
    """Optimises the actions of a whole episode by Adam, with gradients through the simulation.

    Actions are ``tanh(theta)``, where theta (T, 2, R, R) starts at zero. Steps after the end of an episode do not
    count. An iteration is undone if its loss, gradient or state is not finite, if its gradient is zero, or if its loss
    is far above the best one, as a robot that breaks into pieces has no way back: theta then returns to the best point
    under the present blur, Adam's momentum is reset, and the learning rate is reduced for good. `baselines.fit` trains
    all stages.

    Args:
        config: Options, such as those of ``Gradient.preset(task, "quick")``.
        stage: The stage, 1 or 2.
        start: Actions with which to begin; None for zero actions.

    Raises:
        cfp.ConfigError: The reward of the task has no gradient in the actions.
    """

    sees: ClassVar[Sees] = "nothing"
    parts = ("adam",)
    values = ("theta", "best", "mean_norm", "best_loss", "best_size", "phase", "backoff", "failed", "failed_in_a_row")

    def __init__(self, config: GradientConfig, stage: int = 1, start: OpenLoop | None = None) -> None:
        self.config, self.stage, polishes = config, stage, stage > 1
        own, num_envs = (config, 1) if polishes else (config.for_training(), None)
        self.env = make_torch_env(own, config.resolution(stage), num_envs)
        self.env.reset(seed=config.seed)
        check_differentiable(self.env)
        self.initial = self.env.save()
        self.horizon = self.env.spec.horizon
        self.theta = torch.zeros(self.horizon, *self.env.action_shape, device=self.env.device)
        if start is not None:
            self.theta += _to_theta(start.actions, self.env.action_resolution).to(self.theta)
        self.theta.requires_grad_()
        self.learning_rate = config.polish_learning_rate if polishes else config.learning_rate
        self.adam = torch.optim.Adam([self.theta], self.learning_rate, BETAS)
        self.objective = Objective(self.env, config.blur[-1:] if polishes else config.blur)
        self.mean_norm = torch.zeros(self.horizon, device=self.env.device)
        self.backoff, self.failed, self.failed_in_a_row = 1.0, 0, 0
        self.best_loss, self.best_size, self.best, self.phase = math.inf, 0.0, self.theta.detach().clone(), 0

    def update(self) -> Scalars:
        """Do one iteration; a `NonFiniteError` after ten failures in a row."""
        progress = self.progress
        learning_rate = self.backoff * self.learning_rate * cosine_decay(progress)
        self.adam.param_groups[0]["lr"] = learning_rate
        if (phase := self.objective.phase(progress)) != self.phase:
            self._return_to_best()
            self.best_loss, self.phase = math.inf, phase
        loss, size, total, gradient = self.play(progress)
        scalars = {"train/learning_rate": learning_rate, "train/loss": loss, "train/return": total}
        failure = None
        if not (math.isfinite(loss) and torch.isfinite(gradient).all()):
            failure = "the return or its gradient is not finite"
        elif not gradient.any():
            failure = "the gradient is zero"
        elif loss > self.best_loss + MAX_RISE * self.best_size:
            failure = "the return is far below the best"
        if failure is None:
            if loss < self.best_loss:
                self.best_loss, self.best_size, self.best = loss, size, self.theta.detach().clone()
            scalars["train/gradient_norm"] = float(gradient.norm())
            self.theta.grad, scalars["train/clipped"] = self._clip(gradient)
            self.adam.step()
            self.failed_in_a_row = 0
        else:
            self._undo(failure)
        self.num_timesteps += self.horizon * self.env.num_envs
        return scalars | {"train/failed": float(self.failed)}

    def play(self, progress: float) -> Iteration:
        """Play one episode from the start, with the objective at a ``progress`` of 0 to 1 of the stage."""
        env, window = self.env, self.config.window or self.horizon
        actions = self.theta.detach().tanh().requires_grad_()
        env.load(self.initial)
        running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        loss = size = total = 0.0
        soft = self.objective.target is None
        window_loss = torch.zeros((), device=env.device)
        for step in range(self.horizon):
            _, reward, terminated, _, info = env.step(actions[step].expand(env.num_envs, -1, -1, -1), soft=soft)
            if not bool((info["finite"] | ~running).all()):
                return Iteration(math.nan, math.nan, math.nan, actions)
            value = torch.where(running, self.objective(env, reward, progress), 0.0)
            window_loss = window_loss + value.mean() / self.horizon
            size += float(value.detach().abs().mean()) / self.horizon
            total += float(torch.where(running, info.get("true_reward", reward).detach(), 0.0).mean())
            running = running & ~terminated
            is_last = step + 1 == self.horizon or not bool(running.any())
            if is_last or (step + 1) % window == 0:
                window_loss.backward()
                loss += float(window_loss.detach())
                window_loss = torch.zeros_like(window_loss)
                env.detach()
            if is_last:
                break
        assert actions.grad is not None
        return Iteration(loss, size, total, actions.grad * (1.0 - actions.detach().square()))

    def _clip(self, gradient: Tensor) -> tuple[Tensor, float]:
        """Clip each control step's gradient to `CLIP` times its mean norm; returns the fraction that was clipped."""
        norm = gradient.flatten(1).norm(dim=1)
        mean_norm = torch.where(self.mean_norm > 0, self.mean_norm, norm)
        limit = CLIP * mean_norm
        clipped = torch.minimum(norm, limit)
        self.mean_norm = NORM_MOMENTUM * mean_norm + (1.0 - NORM_MOMENTUM) * clipped
        scale = torch.where(norm > 0, clipped / norm, 1.0)
        return gradient * scale[:, None, None, None], float((norm > limit).float().mean())

    def _undo(self, failure: str) -> None:
        """Return to the best point with a smaller learning rate, or give up after too many failures in a row."""
        self.failed += 1
        self.failed_in_a_row += 1
        if self.failed_in_a_row >= PATIENCE:
            raise NonFiniteError(
                f"{PATIENCE} iterations in a row failed after {self.num_timesteps} environment steps of the stage: "
                f"{failure}"
            )
        self.backoff *= BACKOFF
        self._return_to_best()

    def _return_to_best(self) -> None:
        with torch.no_grad():
            self.theta.copy_(self.best)
        for state in self.adam.state.values():
            state["exp_avg"].zero_()

    @property
    def trained_policy(self) -> OpenLoop:
        """The present actions; those of the second stage name their layout."""
        return OpenLoop(self.theta.tanh(), {"layout": self.config.seed} if self.stage > 1 else {})

    @classmethod
    def create(cls, config: GradientConfig, stage: int, folder: Path) -> "Gradient":
        """The optimiser at the beginning of a stage; the second one begins with the actions of the first."""
        learner = cls(config, stage, OpenLoop.load(policy_path(folder, stage - 1)) if stage > 1 else None)
        learner.starts_trained = stage > 1
        return learner

    @staticmethod
    def preset(task: str, name: str) -> GradientConfig:
        """Defaults of a task: ``quick`` optimises with lite particles, ``paper`` in the paper's environment.

        Both are evaluated with full particles. Tasks other than SHAPE MATCH get fewer iterations of gradients that
        reach back 16 steps, on the coarse grid.
        """
        environment = sac_preset(task, name).environment
        quick, horizon = name == "quick", make_spec(task).horizon
        config = GradientConfig(
            **vars(EnvironmentConfig(num_envs=1, particles="full") if quick else environment),
            task=task,
            preset="quick" if quick else "paper",
            eval_every=50 * horizon,
            eval_episodes=3,
            eval_deterministic=True,
            checkpoint_every=10 * horizon,
            log_every=horizon,
            train_particles="lite" if quick else "full",
            train_dt=long_dt(task),
        )
        return config if task == "shapematch" else replace(config, iterations=30, grid="coarse", window=16)


def _to_theta(actions: Tensor, resolution: int) -> Tensor:
    """Parameters of a sequence of actions (T, 2, R, R) on another grid, interpolated as the environment does."""
    return torch.atanh(bicubic(actions, resolution).clamp(-0.999, 0.999))
