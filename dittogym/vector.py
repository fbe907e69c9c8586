"""The batched Gymnasium environment: many simulations advanced in one call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from dittogym.bodies.positions import Seed
from dittogym.copies import to_device
from dittogym.env import RENDER_FPS, Shell, as_numpy, as_tensor, spaces, step_to_host
from dittogym.snapshots import Snapshot
from dittogym.spec import TaskSpec
from dittogym.tasks import usual_horizon
from dittogym.torch_env import TorchEnv, find_mask
from torchmpm import checks


class AutoresetStep(NamedTuple):
    """A step of a batch with a leading B throughout; all but the observation and ``reset_info`` on the host."""

    observation: Tensor  # Of new episodes where done
    reward: np.ndarray  # (B,)
    terminated: np.ndarray  # (B,) bool
    truncated: np.ndarray  # (B,) bool
    done: np.ndarray  # (B,) bool, elements whose episode ended and that were reset
    info: dict[str, np.ndarray]  # Of the step
    finals: dict[int, np.ndarray]  # Of elements whose episode ended, the observation after the step
    reset_info: dict[str, Any]  # Of all elements after the reset, still tensors; empty if no episode ended


def autoreset_step(env: Any, action: Tensor, max_episode_steps: float | np.ndarray | None) -> AutoresetStep:
    """Step all elements, and reset those whose episode has ended; ``max_episode_steps`` may differ, (B,).

    A GPU is waited for once, by the copy of all quantities of the step, and again where an episode has ended.
    """
    observation, (reward, terminated, truncated, steps), info = step_to_host(env, action)
    if max_episode_steps is not None:
        truncated = steps >= max_episode_steps
    done, finals, reset_info = terminated | truncated, {}, {}
    if done.any():
        ended = np.flatnonzero(done)
        images = as_numpy(observation[to_device(ended, observation.device)])
        finals = dict(zip(ended.tolist(), images, strict=True))
        observation, reset_info = env.reset(options={"reset_mask": torch.from_numpy(done)})
    return AutoresetStep(observation, reward, terminated, truncated, done, info, finals, reset_info)


class BatchEnv(Shell, VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """``num_envs`` simulations behind Gymnasium's vector interface.

    Args:
        task: A task name, ``"MODULE:NAME"``, or a :class:`dittogym.TaskSpec`.
        num_envs: B, the number of simulations.
        autoreset_mode: A ``gymnasium.vector.AutoresetMode`` or its value. With ``NEXT_STEP`` (``"NextStep"``), which
            Gymnasium's vector wrappers need, an episode that has ended is reset by the next call of :meth:`step`, which
            ignores its action. With ``SAME_STEP`` (``"SameStep"``) it is reset by the same call, and the last
            observation and info are ``info["final_obs"]`` and ``info["final_info"]``. With ``DISABLED``
            (``"Disabled"``) it goes on until :meth:`reset`.
        render_mode: ``None``, or ``"rgb_array"`` for :meth:`render`.
        render_muscles: Colour the robots by their muscles in pictures.
        render_size: Pixels per side of pictures, from 16 to 8192.
        max_episode_steps: Control steps after which episodes are truncated; -1 for no limit, ``None`` for the task's
            horizon. The horizon that the task has without options, which Gymnasium passes if none is given, stands for
            the horizon with them.
        options: All other arguments of :class:`dittogym.TorchEnv`.

    Attributes:
        torch_env: The :class:`dittogym.TorchEnv` behind it.
        single_observation_space: ``Box(0, 255, (3, 64, 64), uint8)``; ``observation_space`` has a leading B.
        single_action_space: ``Box(-1, 1, (2, R, R), float32)``; ``action_space`` has a leading B.

    Raises:
        ValueError: A mode is unknown, ``max_episode_steps`` is out of range, or as in :class:`dittogym.TorchEnv`.
        TypeError: As in :class:`dittogym.TorchEnv`.

    Examples:
        >>> import dittogym, gymnasium
        >>> envs = gymnasium.make_vec("dittogym/kick-coarse-v0", num_envs=3, particles="lite")
        >>> observations, infos = envs.reset(seed=0)
        >>> observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
        >>> observations.shape, rewards.shape, infos["object_displacement"].shape
        ((3, 3, 64, 64), (3,), (3,))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        task: str | TaskSpec,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_muscles: bool = True,
        render_size: int = 512,
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        self._set_pictures(render_mode, render_muscles, render_size)
        if max_episode_steps not in (None, -1):
            checks.whole("max_episode_steps", max_episode_steps, 1)
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode must be one of {modes}, got {autoreset_mode!r}") from error
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.torch_env = TorchEnv(task, num_envs, **options)
        self.num_envs = num_envs
        own, usual = self.torch_env.spec.horizon, usual_horizon(task)
        # Gymnasium passes the limit of the id, whatever the task's options say.
        limit = own if max_episode_steps in (None, usual) else max_episode_steps
        self._horizon = math.inf if limit == -1 else limit
        self.single_observation_space, self.single_action_space = spaces(self.torch_env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    @torch.no_grad()
    def reset(self, *, seed: Seed = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, see :meth:`dittogym.TorchEnv.reset`, whose errors it raises.

        Args:
            seed: Seed from which new initial positions are drawn: element i has the seed ``seed + i`` or ``seed[i]``.
            options: The options of :meth:`dittogym.TorchEnv.reset`, such as ``"reset_mask"``.

        Returns:
            The observations (B, 3, 64, 64) uint8 of all elements, and ``info`` in Gymnasium's form, in which a mask
            ``_name`` (B,) bool beside the entry ``name`` says for which elements it holds.
        """
        observation, info = self.torch_env.reset(seed=seed, options=options)
        first_seed = seed[0] if isinstance(seed, Sequence | np.ndarray) else seed
        super().reset(seed=None if first_seed is None else int(first_seed))
        self._ended &= ~find_mask("reset_mask", (options or {}).get("reset_mask"), self.num_envs)
        return as_numpy(observation), _with_masks(as_numpy(info), np.ones(self.num_envs, dtype=bool))

    @torch.no_grad()
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all simulations by one control step, see :meth:`dittogym.TorchEnv.step`.

        Args:
            actions: (B, 2, R, R) numbers in [-1, 1]; larger ones saturate.

        Returns:
            The observations (B, 3, 64, 64) uint8, rewards (B,) float64, terminations (B,) bool, truncations (B,) bool,
            and ``info`` with the entries of :meth:`dittogym.TorchEnv.step` as arrays, in the form that :meth:`reset`
            describes; the reward terms have keys such as ``"reward_terms/velocity"``.

        Raises:
            ValueError: The actions have another shape or are not finite.
            RuntimeError: The environment was not reset yet.
        """
        action = as_tensor(actions, self.torch_env)
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return self._step_then_reset(action)
        step = autoreset_step(self.torch_env, action, self._horizon)
        result, done = _restarted(step.info, as_numpy(step.reset_info), step.done), step.done
        if step.finals:
            final = np.empty(self.num_envs, dtype=object)
            for i, image in step.finals.items():
                final[i] = image
            result |= {"final_obs": final, "_final_obs": done}
            result |= {"final_info": _with_masks(step.info, done), "_final_info": done}
        rewards = step.reward.astype(np.float64)
        return as_numpy(step.observation), rewards, step.terminated, step.truncated, result

    def _step_then_reset(self, action: torch.Tensor) -> tuple[Any, ...]:
        """A step after which, in the mode ``NEXT_STEP``, elements that had ended before it are reset."""
        fresh = self._ended.copy()
        ended = to_device(fresh, action.device)
        action = action.masked_fill(ended[:, None, None, None], 0.0)  # ignored, and may hold NaN
        observation, (reward, terminated, _, steps), info = step_to_host(self.torch_env, action)
        rewards = np.where(fresh, 0.0, reward.astype(np.float64))
        ends, limits = terminated & ~fresh, (steps >= self._horizon) & ~fresh
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            self._ended = ends | limits
        start: dict[str, Tensor] = {}
        if fresh.any():
            observation, start = self.torch_env.reset(options={"reset_mask": fresh})
        return as_numpy(observation), rewards, ends, limits, _restarted(info, as_numpy(start), fresh)

    def load(self, snapshot: Snapshot, mask: np.ndarray | None = None) -> np.ndarray:
        """Restore a snapshot, see :meth:`dittogym.TorchEnv.load`, whose errors it raises.

        An element that was to be reset by the next step continues from the snapshot instead.

        Args:
            snapshot: What :meth:`save` returned here, or in an environment with the same options.
            mask: (B,) bool, true for the elements to load; ``None`` loads all.

        Returns:
            The observations (B, 3, 64, 64) uint8 of all elements.
        """
        observation = self.torch_env.load(snapshot, mask)
        self._ended &= ~find_mask("mask", mask, self.num_envs)
        return as_numpy(observation)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture (S, S, 3) uint8 in RGB of each simulation in mode ``"rgb_array"``, else ``None``.

        S is the ``render_size``.
        """
        return None if self.render_mode is None else tuple(map(self._picture, range(self.num_envs)))


def _restarted(info: dict[str, Any], start: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Info of a step in which some elements (B,) were reset: theirs is that of the reset, without a step's entries."""
    result = _with_masks(info, ~mask)
    for name, value in start.items():
        result[name] = _where(mask, value, info[name])
        result["_" + name] = np.ones_like(mask)
    return result


def _with_masks(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Info in Gymnasium's form: for each entry, ``_name`` says for which elements it holds; those of others are 0."""
    result: dict[str, Any] = {}
    for name, value in info.items():
        result[name], result["_" + name] = _where(mask, value, np.zeros((), value.dtype)), mask.copy()
    return result


def _where(mask: np.ndarray, value: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``value`` of the elements in ``mask`` (B,), ``other`` of those outside."""
    return np.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, other)
