"""Windows of differentiable simulation, within which episodes end and start anew (SHAC; Xu et al., ICLR 2022).

The smooth reward that gradients maximise in place of a task's own is first.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cfp.config import EVALUATION_SEED, WindowConfig
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import DIVERGED, TorchVecEnv, first_limits, reward_error
from cfp.errors import ConfigError, NonFiniteError
from cfp.resumable import Resumable
from dittogym import TorchEnv, core
from dittogym.copies import to_host
from dittogym.pieces import largest_piece
from dittogym.rewards import Reward, Transition
from dittogym.spec import TaskSpec
from torchmpm import tree

#: What ``WindowCollector.scalars`` returns, and what it means.
WINDOW_METRICS = {
    "rollout/return": "mean undiscounted true return of the episodes that ended since the last row; empty if none did",
    "train/reward": "mean training reward of a step, before its scale",
    "train/true_reward": "mean true reward of a step, at the particle count of training",
    "train/value": "mean value of the window's states by the target critic, and of the ends of its episodes",
    "train/episodes": "episodes ended in this stage",
    "train/terminated": "training episodes of this stage that terminated early",
    "train/nonfinite": "simulations that were not finite and were reset",
    "train/dropped": "gradients of single actions that were not finite and were left out",
}
#: Reward for a mean speed of 1 m/s.
SPEED_WEIGHT = 60.0
#: Neighbours of each sampled particle whose distance is tracked, and how many particles are sampled at most.
NEIGHBOURS, MAX_SAMPLES = 6, 500
#: Particles nearer than this, m, belong together.
RADIUS = 0.03
#: Fraction of ``RADIUS`` by which they may drift apart at no cost.
TOLERANCE = 0.25
#: Memory for the gradients of a window on a GPU, with what going back through it needs, in what its steps keep.
BACKWARD = 1.25


# The training reward.


@tree.register
@dataclass(frozen=True)
class Neighbours:
    """Pairs of a robot's particles that were close to each other; tearing shows in them before the body is split."""

    index: Tensor  # (B, K) numbers of the sampled particles
    neighbours: Tensor  # (B, K, M) their nearest other samples, numbers among the samples
    distance: Tensor  # (B, K, M), m, when they were found
    is_close: Tensor  # (B, K, M) bool, whether they were nearer than `RADIUS`

    @classmethod
    @torch.no_grad()
    def find(cls, x: Tensor) -> Neighbours:
        """Find neighbours among a robot's particles (B, N, 2), m."""
        count = min(MAX_SAMPLES, x.shape[1])
        index = torch.linspace(0, x.shape[1] - 1, count, device=x.device).long()
        samples = x[:, index] - x.mean(1, keepdim=True)  # cdist loses digits far from the origin
        nearest = torch.cdist(samples, samples).topk(min(NEIGHBOURS + 1, count), largest=False)
        distance, neighbours = nearest.values[..., 1:], nearest.indices[..., 1:]  # the first is the particle itself
        return cls(index.expand(len(x), -1), neighbours, distance, distance < RADIUS)

    def drift(self, x: Tensor) -> Tensor:
        """Mean over close pairs, (B,), of the square of ``(d - d_0) / RADIUS - TOLERANCE`` where it is positive."""
        samples = x.gather(1, self.index[..., None].expand(-1, -1, 2))
        index = self.neighbours.flatten(1)[..., None].expand(-1, -1, 2)
        gap = samples.gather(1, index).view(*self.neighbours.shape, 2) - samples[:, :, None]
        distance = (gap.square().sum(-1) + 1e-12).sqrt()
        excess = ((distance - self.distance) / RADIUS - TOLERANCE).clamp_min(0.0) * self.is_close
        return excess.square().sum((1, 2)) / self.is_close.sum((1, 2)).clamp_min(1)


def discount_rate(gamma: float) -> float:
    """1 - gamma, at least 0.01: a value sums up the rewards of 1 / (1 - gamma) steps, here at most 100."""
    return max(1.0 - gamma, 1e-2)


def split_cost(split: Tensor, limit: float, margin: float, weight: float) -> Tensor:
    """Cost (B,) of robots' spread (B,), m, beyond a fraction ``margin`` of the ``limit`` at which they are torn."""
    return weight * (split / limit - margin).clamp_min(0.0).square()


def training_reward(
    config: WindowConfig,
    env: TorchEnv,
    previous_centre: Tensor,
    reward: Tensor,
    info: dict[str, Any],
    neighbours: Neighbours,
) -> Tensor:
    """Training reward (B,) of the environment's last step."""
    terms = info["reward_terms"]
    if config.reward == "speed":
        seconds = env.model.substeps * env.model.solver.dt
        reward = SPEED_WEIGHT / seconds * (info["com"] - previous_centre)[:, 0] + terms["failure"]
        if "action" in terms:
            reward = reward + terms["action"]
    limit = env.spec.split_limit
    if limit is not None and config.split_weight:
        reward = reward - split_cost(info["split"], limit, config.split_margin, config.split_weight)
    if config.integrity_weight:
        reward = reward - config.integrity_weight * neighbours.drift(env.state.x[:, : env.model.num_robot_particles])
    if config.piece_weight:
        whole = largest_piece(env.state.x[:, : env.model.num_robot_particles], env.env_state.origin)
        reward = reward - config.piece_weight * (1.0 - torch.from_numpy(whole).to(reward))
    return config.reward_scale * torch.where(info["finite"], reward, terms["failure"])


def has_gradient(env: TorchEnv) -> bool:
    """Whether a term of the task's own reward, made smooth, has a gradient in the next action.

    The reward as a whole always has one: the environment adds a cost of actions and of tearing.
    """
    differentiable: list[bool] = []

    def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
        outcome = env.spec.reward_fn(transition, spec)
        differentiable.extend(term.requires_grad for term in outcome.terms.values())
        return outcome

    shape = (env.num_envs, *env.action_shape)
    with torch.enable_grad():
        action = torch.zeros(shape, dtype=env.dtype, device=env.device, requires_grad=True)
        core.step(replace(env.model, spec=replace(env.spec, reward_fn=reward_fn)), env.env_state, action, soft=True)
    return any(differentiable)


# Windows and their episodes.


class Window(NamedTuple):
    """T control steps of B simulations, with their autograd graph."""

    observations: Tensor  # (T, B, ...) inputs of the critic, detached
    rewards: Tensor  # (T, B) training rewards
    next_values: Tensor  # (T, B) values of the states after each step, or of the end of the episode
    done: Tensor  # (T, B) bool, whether the episode was over after the step
    true_reward: float  # mean of the task's own rewards


class Outcome(NamedTuple):
    """Which episodes of a batch are over after a step, and what else the host has to know of the step."""

    done: Tensor  # (B,) bool
    values: dict[str, np.ndarray]  # by name: the same, and what `Episodes.end_step` was given; copied in one piece
    infos: list[dict[str, Any]]  # return and length of each episode that is over, as stable-baselines3's Monitor has it


class Episodes(Resumable):
    """Ends the episodes of an environment and starts new ones.

    Episodes are truncated after ``max_episode_steps``; the first one of element i of the batch already after a fraction
    ``(i + 1) / B`` of them, so that the simulations are of different ages. A simulation that is not finite ends like
    any other, and is counted.
    """

    values = ("limit", "returns", "num_started", "counts", "recent_returns")

    def __init__(self, env: TorchEnv, seed: int, max_episode_steps: int, num_layouts: int) -> None:
        # Conditions follow from the seed as layouts do, so each episode needs a seed of its own.
        self.env, self.num_layouts = env, num_layouts if env.conditions is None else EVALUATION_SEED - env.num_envs
        count = env.num_envs
        self.first_seed = seed + count
        env.reset(seed=[self.first_seed + i % self.num_layouts for i in range(count)])
        self.max_steps = min(max_episode_steps, env.spec.horizon)
        self.limit = first_limits(count, self.max_steps, env.device)
        self.returns = torch.zeros(count, dtype=env.dtype, device=env.device)
        self.recent_returns: list[float] = []  # undiscounted; of the episodes since the list was last emptied
        self.num_started = count
        self.counts = {"episodes": 0, "terminated": 0, "nonfinite": 0}

    def end_step(self, reward: Tensor, terminated: Tensor, finite: Tensor, **others: Tensor) -> Outcome:
        """Add the rewards (B,) of a step to the returns, and start new episodes where they are over, on other layouts.

        Args:
            reward: Of the step, (B,).
            terminated: Which episodes the step has ended, (B,) bool.
            finite: Which simulations can go on, (B,) bool.
            others: What else the host is to read of the step.
        """
        self.returns = self.returns + reward  # not in place: a saved state may hold it
        length = self.env.env_state.steps
        done = terminated | (length >= self.limit)
        own = {"done": done, "terminated": terminated, "finite": finite, "return": self.returns, "length": length}
        values = to_host(own | others)
        infos, seeds = [dict[str, Any]() for _ in range(self.env.num_envs)], [0] * self.env.num_envs
        for i in np.flatnonzero(values["done"]).tolist():
            infos[i]["episode"] = {"r": float(values["return"][i]), "l": int(values["length"][i])}
            self.counts["episodes"] += 1
            self.counts["terminated"] += int(values["terminated"][i])
            self.counts["nonfinite"] += int(not values["finite"][i])
            self.recent_returns.append(float(values["return"][i]))
            seeds[i] = self.first_seed + self.num_started % self.num_layouts
            self.num_started += 1
        if values["done"].any():
            self.env.reset(seed=seeds, options={"reset_mask": values["done"]})
        self.returns = torch.where(done, 0.0, self.returns)
        self.limit = torch.where(done, self.max_steps, self.limit)
        return Outcome(done, values, infos)

    def scalars(self) -> dict[str, float | None]:
        """Counts, and the mean of `recent_returns`."""
        scalars: dict[str, float | None] = {f"train/{name}": float(count) for name, count in self.counts.items()}
        return scalars | {"rollout/return": float(np.mean(self.recent_returns)) if self.recent_returns else None}

    def state_dict(self) -> dict[str, Any]:
        """The episodes in progress, and what the next ones depend on."""
        return super().state_dict() | {"env": TorchVecEnv(self.env).state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state)
        TorchVecEnv(self.env).load_state_dict(state["env"])


class WindowCollector(Resumable):
    """Collects windows from an environment.

    Gradients with respect to the action of one simulation in one step that are not finite are left out and counted.

    Args:
        env: The environment; its episodes begin here.
        observe: Inputs (B, ...) of the critic in the present state.
        config: Seed, layouts and length of the episodes, training reward, control steps T of a window, and discount
            factor.
    """

    parts = ("episodes",)
    values = ("dropped",)

    def __init__(self, env: TorchEnv, observe: Callable[[], Tensor], config: WindowConfig) -> None:
        self.env, self.observe = env, observe
        self.episodes = Episodes(env, config.seed, config.max_episode_steps, config.num_layouts)
        self.config = config
        self.success_reward = config.reward_scale * config.success_reward
        self.dropped = 0  # in the windows whose scalars were read
        self._dropped_now = torch.zeros((), dtype=torch.int64, device=env.device)
        self._is_measured = env.device.type == "cpu"  # the memory that a step keeps for gradients

    def collect(
        self,
        act: Callable[[Tensor], Tensor],
        value: Callable[[Tensor], Tensor],
        after_step: Callable[[np.ndarray, list[dict[str, Any]]], bool],
    ) -> Window | None:
        """Collect the next window.

        Args:
            act: Actions (B, 2, R, R) to execute, from the critic's inputs; it may look at the environment instead.
            value: Values (B,) of the critic's inputs.
            after_step: Called after each control step, with the episodes that are over, (B,) bool, and one dictionary
                for each, as stable-baselines3 calls callbacks; False ends the window.

        Returns:
            The window; None if ``after_step`` ended it.

        Raises:
            NonFiniteError: Actions or rewards are not finite.
            ConfigError: A GPU has too little free memory for the gradients of a window.
        """
        env, true_reward = self.env, 0.0
        steps: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        observation, neighbours = self.observe(), Neighbours.find(self._robot_positions())
        for _ in range(self.config.window):
            centre, memory = env.env_state.centre, 0 if self._is_measured else torch.cuda.memory_allocated(env.device)
            action = self._guarded(act(observation))
            _, smooth_reward, terminated, _, info = env.step(action, soft=True)
            reward = training_reward(self.config, env, centre, smooth_reward, info, neighbours).float()
            next_observation = self.observe()
            success = info.get("is_success", terminated.new_zeros(()))
            reward = reward + torch.where(success, self.success_reward, 0.0)
            final_value = torch.where(success, self.success_reward / discount_rate(self.config.gamma), 0.0)
            next_value = torch.where(terminated, final_value, value(next_observation))
            true_rewards = info["true_reward"].detach()
            if not self._is_measured and torch.is_grad_enabled():
                check_gradient_memory(env, self.config.window, torch.cuda.memory_allocated(env.device) - memory)
                self._is_measured = True
            further = {"true_reward": true_rewards.mean(), "acts": action.detach().isfinite().all()}
            outcome = self.episodes.end_step(true_rewards, terminated, info["finite"], **further)
            steps.append((observation.detach(), reward, next_value, outcome.done))
            if not outcome.values["acts"]:
                raise NonFiniteError(DIVERGED)
            if not np.isfinite(outcome.values["true_reward"]):
                raise reward_error(info["reward_terms"])
            true_reward += float(outcome.values["true_reward"])
            if outcome.values["done"].any():
                neighbours = tree.where(outcome.done, Neighbours.find(self._robot_positions()), neighbours)
                next_observation = tree.where(outcome.done, self.observe(), next_observation)
            observation = next_observation
            if not after_step(outcome.values["done"], outcome.infos):
                env.detach()
                return None
        observations, rewards, next_values, done = (torch.stack(values) for values in zip(*steps, strict=True))
        return Window(observations, rewards, next_values, done, true_reward / self.config.window)

    def scalars(self, window: Window) -> dict[str, float | None]:
        """What to log of a window, see `WINDOW_METRICS`; warns if most of its gradients were left out."""
        means = {"reward": window.rewards.detach().mean(), "value": window.next_values.detach().mean()}
        values = to_host(means | {"dropped": self._dropped_now})
        self._dropped_now = torch.zeros_like(self._dropped_now)
        self.dropped += int(values["dropped"])
        if values["dropped"] > window.rewards.numel() / 2:
            reason = "the reward or the simulation has no finite derivative there"
            warnings.warn(f"most gradients of a window are not finite and were left out: {reason}", stacklevel=2)
        return self.episodes.scalars() | {
            "train/reward": float(values["reward"]) / self.config.reward_scale,
            "train/true_reward": window.true_reward,
            "train/value": float(values["value"]),
            "train/dropped": float(self.dropped),
        }

    def _robot_positions(self) -> Tensor:
        return self.env.state.x[:, : self.env.model.num_robot_particles].detach()

    def _guarded(self, action: Tensor) -> Tensor:
        """The same actions, through which only finite gradients go back."""
        if action.device.type == "cpu" and not bool(action.isfinite().all()):  # on a GPU, known after the step
            raise NonFiniteError(DIVERGED)
        if not action.requires_grad:
            return action
        view = action.view_as(action)
        view.register_hook(self._drop_nonfinite)
        return view

    def _drop_nonfinite(self, gradient: Tensor) -> Tensor:
        finite = gradient.isfinite().flatten(1).all(1)
        self._dropped_now = self._dropped_now + (~finite).sum()
        return torch.where(finite[:, None, None, None], gradient, 0.0)


def check_gradient_memory(env: TorchEnv, window: int, kept: int) -> None:
    """Refuse windows that do not fit into what a GPU has free, given the bytes ``kept`` for gradients of one step."""
    free = torch.cuda.mem_get_info(env.device)[0]
    free += torch.cuda.memory_reserved(env.device) - torch.cuda.memory_allocated(env.device)
    needed = BACKWARD * kept * window
    if needed - kept > free:
        fitting = int(env.num_envs * (free + kept) / needed)
        raise ConfigError(
            f"num_envs must be at most {fitting} with window {window} on this GPU, got {env.num_envs}: a step keeps "
            f"{kept / 1e9:.2f} GB for gradients, and {free / 1e9:.1f} GB are free"
        )


def reward_warnings(config: WindowConfig) -> list[str]:
    """A line if no term of the task's own reward has a gradient in the actions, so that only the critic guides."""
    if config.reward == "speed":
        return []
    env = make_torch_env(config.for_training(), config.action_size(1), 1)
    env.reset(seed=config.seed)
    if has_gradient(env):
        return []
    return [f"the reward of {config.task} has no gradient in the actions"]


def short_horizon_loss(window: Window, gamma: float) -> Tensor:
    """Negative discounted rewards of a window and final values of its episodes, mean over simulations and steps.

    Of an episode within the window, the sum of ``gamma^t r_t`` plus ``gamma^h V(s_h)`` (Xu et al., equation 5).
    """
    steps = len(window.rewards)
    total, discount = torch.zeros_like(window.rewards[0]), torch.ones_like(window.rewards[0])
    for step, (reward, value, done) in enumerate(zip(window.rewards, window.next_values, window.done, strict=True)):
        total = total + discount * reward
        total = total + torch.where(done | (step + 1 == steps), gamma * discount * value, 0.0)
        discount = torch.where(done, 1.0, gamma * discount)
    return -total.mean() / steps


@torch.no_grad()
def td_lambda_targets(window: Window, gamma: float, td_lambda: float) -> Tensor:
    """TD(lambda) targets (T, B) of the values of a window's observations."""
    targets = torch.empty_like(window.rewards)
    target = window.next_values[-1]
    for step in reversed(range(len(targets))):
        value = window.next_values[step]
        target = torch.where(window.done[step], value, (1.0 - td_lambda) * value + td_lambda * target)
        target = targets[step] = window.rewards[step] + gamma * target
    return targets
