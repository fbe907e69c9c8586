"""Open-loop actions by gradient descent through the simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

import cfp
from baselines.common.grid import Grid, GridConfig, grid_size
from baselines.common.open_loop import OpenLoop
from baselines.trajectory.objective import make_objective
from cfp.config import RunConfig
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.algorithm import Algorithm, Scalars, Sees
from cfp.sections import EnvironmentConfig, Particles, ReportConfig
from cfp.validation import check_at_least, check_positive
from dittogym import make_spec

BETAS = (0.9, 0.98)
FINAL_RATE = 0.1
"""Share of the learning rate that is left at the end of its cosine."""
SPIKE, MEMORY = 3.0, 0.9
"""A step's gradient is clipped to this many times its usual norm, which is averaged with this momentum."""
RISE, SLOWER = 0.1, 0.7
"""An iteration whose loss exceeds the best one by this share of its size is undone, and the learning rate falls by this
factor."""
PATIENCE = 10
"""Failed iterations in a row after which training gives up."""

METRICS: dict[str, str] = {
    "train/loss": "what is minimised, mean over layouts and steps",
    "train/return": "mean return of the iteration's episodes, at the particle count of training",
    "train/gradient_norm": "norm of the gradient before it is clipped",
    "train/clipped": "share of control steps whose gradient was clipped",
    "train/learning_rate": "Adam's step size in the next iteration",
    "train/failed": "iterations of this stage that were undone",
}
"""Every scalar that `Gradient.update` logs, and what it means."""


@dataclass(frozen=True)
class GradientConfig(GridConfig):
    """A run of open-loop gradient descent. An iteration simulates num_envs episodes on fixed particle layouts.

    The environment options say how the result is judged; train_particles, where it is found.
    """

    algo: str = "gradient"
    """Which algorithm."""
    iterations: int = 150
    """Updates in the first stage."""
    grid: Grid = 16
    """Action grid R: coarse, fine (the task's), or a number."""
    learning_rate: float = 0.05
    """Adam's step size at the beginning; a cosine takes it to a tenth."""
    window: int = 0
    """Control steps that a gradient reaches back; 0: the whole episode."""
    train_particles: Particles = "lite"
    """Particles of the simulation in the first stage."""
    blur: tuple[float, ...] = (4.0, 2.0, 1.0, 0.0)
    """SHAPE MATCH: standard deviations, in pixels, by which both pictures are blurred, one after the other."""
    polish: int = 0
    """Updates in a second stage, on the particles and the one layout of this seed that judge it."""
    polish_grid: Grid = "fine"
    """Its action grid."""
    polish_learning_rate: float = 0.05
    """Its learning rate."""

    changeable: ClassVar[tuple[str, ...]] = ("polish", "polish_grid", "polish_learning_rate", *RunConfig.changeable)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which each stage ends."""
        horizon = make_spec(self.task).horizon
        first = self.iterations * horizon * self.environment.num_envs
        return (first, first + self.polish * horizon) if self.polish else (first,)

    def resolution(self, stage: int) -> int:
        """Action grid R of a stage."""
        return grid_size(self.task, self.polish_grid if stage > 1 else self.grid)

    def evaluation(self, stage: int) -> tuple[int, int]:
        """A polished policy is judged on its own layout while it is polished."""
        return (self.seed, 1) if stage > 1 else super().evaluation(stage)

    def ineffective(self) -> dict[str, str]:
        """What concerns the second stage, or a picture to become."""
        idle = super().ineffective() | (
            {} if self.polish else dict.fromkeys(("polish_grid", "polish_learning_rate"), "polish")
        )
        return idle | ({"blur": "a task that has a target"} if make_spec(self.task).target is None else {})

    def check(self) -> None:
        """Check what the types cannot, see `RunConfig.check`."""
        super().check()
        check_at_least(1, iterations=self.iterations)
        check_at_least(0, window=self.window, polish=self.polish)
        check_positive(learning_rate=self.learning_rate, polish_learning_rate=self.polish_learning_rate)
        if not self.blur or min(self.blur) < 0:
            raise ConfigError(f"blur: got {self.blur}, allowed are one or more numbers of 0 or more")


class Episode(NamedTuple):
    """What an iteration has found.

    Attributes:
        loss: Mean over layouts and steps.
        size: Mean magnitude of the same values: a loss made of rewards and costs can be zero, this is not.
        total: Mean return.
        gradient: Of theta, (T, 2, R, R).
    """

    loss: float
    size: float
    total: float
    gradient: Tensor


class Gradient(Algorithm):
    """Adam on the actions of a whole episode, through the simulation.

    Actions are ``tanh(theta)``, theta (T, 2, R, R) begins at zero. Steps after the end of an episode do not count. An
    iteration whose loss, gradient or state is not finite, or whose loss is far above the best one (a robot that breaks
    into pieces has no way back), is undone: theta returns to the best point under the present blur, Adam's momentum is
    forgotten, and the learning rate falls for good.
    """

    sees: ClassVar[Sees] = "nothing"

    def __init__(self, config: GradientConfig, stage: int = 1, start: OpenLoop | None = None) -> None:
        self.config, self.stage, polishes = config, stage, stage > 1
        environment = config.environment if polishes else config.environment.for_training(config.train_particles)
        own = replace(config, environment=environment)
        self.env = make_torch_env(own, config.resolution(stage), 1 if polishes else None)
        self.env.reset(seed=config.seed)
        self.beginning = self.env.save()  # with reference parity, another reset would keep where the last episode ended
        self.horizon = self.env.spec.horizon
        self.theta = torch.zeros(self.horizon, *self.env.action_shape, device=self.env.device)
        if start is not None:
            self.theta += _theta(start.actions, self.env.action_resolution).to(self.theta)
        self.theta.requires_grad_()
        self.rate = config.polish_learning_rate if polishes else config.learning_rate
        self.adam = torch.optim.Adam([self.theta], self.rate, BETAS)
        self.objective = make_objective(self.env, config.blur[-1:] if polishes else config.blur)
        self.usual = torch.zeros(self.horizon, device=self.env.device)
        self.slower, self.failed, self.failed_in_a_row = 1.0, 0, 0
        self.best_loss, self.best_size, self.best, self.phase = math.inf, 0.0, self.theta.detach().clone(), 0

    @staticmethod
    def preset(task: str, name: str) -> GradientConfig:
        """Defaults of a task: ``quick`` optimises at the lite tier, ``paper`` all in the paper's environment.

        Both are judged at full size. Tasks other than SHAPE MATCH get fewer iterations of gradients that reach back 16
        steps, on the coarse grid.

        Raises:
            ConfigError: No such task or preset.
        """
        environment = cfp.preset(task, name).environment
        if name == "quick":
            environment = EnvironmentConfig(num_envs=1, particles="full")
        horizon = make_spec(task).horizon
        config = GradientConfig(
            task=task,
            preset="quick" if name == "quick" else "paper",
            environment=environment,
            report=ReportConfig(50 * horizon, 3, True, checkpoint_every=10 * horizon, log_every=horizon),
            train_particles="lite" if name == "quick" else "full",
        )
        return config if task == "shapematch" else replace(config, iterations=30, grid="coarse", window=16)

    @property
    def policy(self) -> OpenLoop:
        """The present actions."""
        return OpenLoop(self.theta.tanh())

    def _progress(self) -> float:
        """How much of the stage is done, 0 to 1; a stage after one that ended early is longer, and stays at 1."""
        bounds = (0, *self.config.ends())
        return min(self.num_timesteps / (bounds[self.stage] - bounds[self.stage - 1]), 1.0)

    def update(self) -> Scalars:
        """Do one iteration.

        Raises:
            NonFiniteError: Ten iterations in a row failed.
        """
        progress = self._progress()
        cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
        rate = self.slower * self.rate * (FINAL_RATE + (1.0 - FINAL_RATE) * cosine)
        self.adam.param_groups[0]["lr"] = rate
        phase = self.objective.phase(progress)
        if phase != self.phase:
            self._return_to_best()
            self.best_loss, self.phase = math.inf, phase
        loss, size, total, gradient = self._episode(progress)
        scalars: dict[str, float | None] = {"train/learning_rate": rate, "train/loss": loss, "train/return": total}
        finite = math.isfinite(loss) and bool(torch.isfinite(gradient).all())
        if finite and loss <= self.best_loss + RISE * self.best_size:
            if loss < self.best_loss:
                self.best_loss, self.best_size, self.best = loss, size, self.theta.detach().clone()
            scalars["train/gradient_norm"] = float(gradient.norm())
            self.theta.grad, scalars["train/clipped"] = self._clip(gradient)
            self.adam.step()
            self.failed_in_a_row = 0
        else:
            self._undo()
        self.num_timesteps += self.horizon * self.env.num_envs
        return scalars | {"train/failed": float(self.failed)}

    def _episode(self, progress: float) -> Episode:
        """One episode from the start; a robot whose episode is over no longer counts, whatever becomes of it."""
        env, window = self.env, self.config.window or self.horizon
        actions = self.theta.detach().tanh().requires_grad_()
        env.load(self.beginning)
        running = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        loss = size = total = 0.0
        part = torch.zeros((), device=env.device)
        for step in range(self.horizon):
            _, reward, terminated, _, info = env.step(actions[step].expand(env.num_envs, -1, -1, -1))
            if not bool((info["finite"] | ~running).all()):
                return Episode(math.nan, math.nan, math.nan, actions)
            value = torch.where(running, self.objective(env, reward, progress), 0.0)
            part = part + value.mean() / self.horizon
            size += float(value.detach().abs().mean()) / self.horizon
            total += float(torch.where(running, reward.detach(), 0.0).mean())
            running = running & ~terminated
            ends = not bool(running.any())
            if ends or (step + 1) % window == 0 or step + 1 == self.horizon:
                part.backward()
                loss += float(part.detach())
                part = torch.zeros_like(part)
                env.detach()
            if ends:
                break
        assert actions.grad is not None
        return Episode(loss, size, total, actions.grad * (1.0 - actions.detach().square()))

    def _clip(self, gradient: Tensor) -> tuple[Tensor, float]:
        """Clip each control step's gradient to `SPIKE` times its usual norm; returns the share that was clipped."""
        norm = gradient.flatten(1).norm(dim=1)
        usual = torch.where(self.usual > 0, self.usual, norm)
        limit = SPIKE * usual
        kept = torch.minimum(norm, limit)
        self.usual = MEMORY * usual + (1.0 - MEMORY) * kept
        scale = torch.where(norm > 0, kept / norm, 1.0)
        return gradient * scale[:, None, None, None], float((norm > limit).float().mean())

    def _undo(self) -> None:
        self.failed += 1
        self.failed_in_a_row += 1
        if self.failed_in_a_row >= PATIENCE:
            raise NonFiniteError(
                f"{PATIENCE} iterations in a row came to nothing after {self.num_timesteps} environment steps of the "
                "stage; the last checkpoint is untouched"
            )
        self.slower *= SLOWER
        self._return_to_best()

    def _return_to_best(self) -> None:
        with torch.no_grad():
            self.theta.copy_(self.best)
        for state in self.adam.state.values():
            state["exp_avg"].zero_()

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the actions; a polished policy names its layout."""
        own = {"layout": self.config.seed} if self.stage > 1 else {}
        OpenLoop(self.policy.actions, description | own).save(path)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> OpenLoop:
        """Load actions."""
        return OpenLoop.load(path)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iteration depends on."""
        return {
            "theta": self.theta.detach().cpu(),
            "best": self.best.cpu(),
            "adam": self.adam.state_dict(),
            "usual": self.usual.cpu(),
            "best_size": self.best_size,
            "counts": [self.best_loss, self.phase, self.slower, self.failed, self.failed_in_a_row],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        with torch.no_grad():
            self.theta.copy_(state["theta"])
        self.best = state["best"].to(self.theta)
        self.adam.load_state_dict(state["adam"])
        self.usual = state["usual"].to(self.theta)
        self.best_loss, self.phase, self.slower, self.failed, self.failed_in_a_row = state["counts"]
        self.best_size = state["best_size"]


def _theta(actions: Tensor, resolution: int) -> Tensor:
    """Parameters of a sequence of actions (T, 2, R, R) on another grid, interpolated as the environment does."""
    larger = interpolate(actions, size=(resolution, resolution), mode="bicubic", align_corners=False)
    return torch.atanh(larger.clamp(-0.999, 0.999))
