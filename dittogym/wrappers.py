"""Other resolutions of actions and observations, for single and vector environments."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import cv2
import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from torchmpm import checks

AnyEnv = gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any]


def action_resolution(env: AnyEnv, size: int) -> Any:
    """Wrap an environment so that it takes coarser actions, which are enlarged by bicubic interpolation.

    For an environment that is still to be made, use the option ``resolution=size`` of :func:`gymnasium.make`, with
    which actions are interpolated to the nodes of the grid only once.

    Args:
        env: A single or a vector environment of Gymnasium.
        size: Rows and columns of the new actions, at most those of the actions of ``env``.

    Returns:
        The wrapped environment, with actions (..., 2, size, size).

    Raises:
        ValueError: ``size`` is not a whole number in this range.
        TypeError: ``env`` is not a Gymnasium environment with a ``Box`` of actions.
    """
    box, small = _spaces(env, "action_space", size)
    enlarge = functools.partial(_enlarged, small=small, largest=box.shape[-1])
    if isinstance(env, VectorEnv):
        batch = batch_space(small, env.num_envs)
        return gymnasium.wrappers.vector.TransformAction(env, enlarge, batch, small)
    return gymnasium.wrappers.TransformAction(env, enlarge, small)


def observation_resolution(env: AnyEnv, size: int) -> Any:
    """Wrap an environment so that it returns coarser observations, averaged over areas.

    Args:
        env: A single or a vector environment of Gymnasium.
        size: Rows and columns of the new observations, at most those of the observations of ``env``.

    Returns:
        The wrapped environment, with observations (..., 3, size, size).

    Raises:
        ValueError: ``size`` is not a whole number in this range.
        TypeError: ``env`` is not a Gymnasium environment with a ``Box`` of observations.
    """
    _, small = _spaces(env, "observation_space", size)
    reduce = functools.partial(_resized, size=small.shape[-1], interpolation=cv2.INTER_AREA)
    if isinstance(env, VectorEnv):
        return _VectorObservation(env, reduce, small)
    return gymnasium.wrappers.TransformObservation(env, reduce, small)


class _VectorObservation(VectorWrapper):
    """Like Gymnasium's ``TransformObservation``, which refuses environments that reset in the same step."""

    def __init__(
        self, env: VectorEnv[Any, Any, Any], function: Callable[[np.ndarray], np.ndarray], space: gymnasium.spaces.Box
    ) -> None:
        super().__init__(env)
        self._function, self.single_observation_space = function, space
        self.observation_space = batch_space(space, env.num_envs)

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = self.env.reset(**arguments)
        return self._function(observation), info

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            final = np.empty_like(info["final_obs"])
            for i in np.flatnonzero(info["_final_obs"]):
                final[i] = self._function(info["final_obs"][i])
            info = {**info, "final_obs": final}
        return self._function(observation), reward, terminated, truncated, info


def _spaces(env: AnyEnv, name: str, size: int) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The space of a single environment's images, and that of resized ones.

    Both have the same range, which another wrapper may have changed.
    """
    box = getattr(env, "single_" + name if isinstance(env, VectorEnv) else name, None)
    if not isinstance(box, gymnasium.spaces.Box):
        kind = type(env).__name__
        raise TypeError(f"env must be a Gymnasium environment of images (TorchEnv has resolution=...), got {kind}")
    size = checks.whole("size", size, 1, box.shape[-1])
    low, high = box.low.min().item(), box.high.max().item()
    return box, gymnasium.spaces.Box(low, high, (*box.shape[:-2], size, size), box.dtype.type)


def _enlarged(action: np.ndarray, small: gymnasium.spaces.Box, largest: int) -> np.ndarray:
    """Actions of ``small``, or a batch of them, at the resolution of the environment."""
    if np.shape(action)[-2:] != small.shape[-2:]:
        raise ValueError(f"action must end in the shape {small.shape[-2:]}, got {np.shape(action)}")
    return _resized(np.asarray(action, np.float32), largest, cv2.INTER_CUBIC).clip(small.low.min(), small.high.max())


def _resized(images: np.ndarray, size: int, interpolation: int) -> np.ndarray:
    """Resize the last two axes of (..., H, W)."""
    planes = images.reshape(-1, *images.shape[-2:])
    resized = np.stack([cv2.resize(plane, (size, size), interpolation=interpolation) for plane in planes])
    return resized.reshape(*images.shape[:-2], size, size)
