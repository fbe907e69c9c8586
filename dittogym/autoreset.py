"""Steps of a batch after which ended episodes begin anew, for Gymnasium's and stable-baselines3's vector interfaces."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor


class AutoresetStep(NamedTuple):
    """A step of a batch with a leading B throughout.

    Attributes:
        observation: Of new episodes where ``done``.
        final_observation: After the step, before any reset.
        reward: (B,).
        terminated: (B,) bool.
        truncated: (B,) bool.
        done: (B,) bool, elements whose episode ended and that were reset.
        info: Of the step.
        reset_info: Of all elements after the reset; ``None`` if no episode ended.
    """

    observation: Tensor
    final_observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    done: Tensor
    info: dict[str, Any]
    reset_info: dict[str, Any] | None


def autoreset_step(env: Any, action: Tensor, max_episode_steps: float | None = None) -> AutoresetStep:
    """Step all elements, and reset those whose episode has ended.

    Args:
        env: A :class:`dittogym.TorchEnv`, or another environment with its ``step`` and ``reset``.
        action: (B, 2, R, R).
        max_episode_steps: Steps after which an episode is truncated; ``None`` leaves it to the environment.
    """
    observation, reward, terminated, truncated, info = env.step(action)
    if max_episode_steps is not None:
        truncated = env.env_state.steps >= max_episode_steps
    done, final_observation, reset_info = terminated | truncated, observation, None
    if bool(done.any()):
        final_observation = observation.clone()  # an environment may reuse its memory
        observation, reset_info = env.reset(options={"reset_mask": done})
    return AutoresetStep(observation, final_observation, reward, terminated, truncated, done, info, reset_info)
