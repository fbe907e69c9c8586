"""`dittogym.TorchEnv` as a `VecEnv` of stable-baselines3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import Space
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from torch import Tensor

from cfp.errors import NonFiniteError
from dittogym import env as dittogym_env
from dittogym.copies import to_device
from dittogym.vector import autoreset_step
from torchmpm import checks, tree

#: What is wrong with actions that are not finite.
DIVERGED = "an action is not finite: the policy has diverged"


class TorchVecEnv(VecEnv):
    """A batch of simulations as a vectorised environment of stable-baselines3, a ``VecEnv``.

    An element whose episode ends is reset in the same step: the step returns the first observation of the next episode,
    and the last observation is ``info["terminal_observation"]``. ``info["TimeLimit.truncated"]`` is true at the time
    limit even if the task ends the episode there, as in the reference implementation. A state that is not finite
    terminates the episode.

    Args:
        env: A `dittogym.TorchEnv`, or an object with its interface; it is stepped without gradients.
        spaces: Spaces of observations and actions of an element; None for those of `dittogym.TorchEnv`.
        max_episode_steps: Control steps after which episodes are truncated, at most the task's horizon; None for the
            horizon.
        tensors: Observations are tensors on the device, and actions may be tensors. From a GPU, only numbers and the
            last images of episodes are then copied to the host.
        stagger: For training, with ``max_episode_steps``: after a reset of all elements, the first episode of element i
            is already truncated after a fraction ``(i + 1) / B`` of these steps, so that a batch always holds
            beginnings and ends of episodes.

    Raises:
        ValueError: ``max_episode_steps`` is not a whole number from 1.
        TypeError: ``env`` is a Gymnasium environment.

    Examples:
        >>> import cfp, dittogym
        >>> env = cfp.TorchVecEnv(dittogym.TorchEnv("run", num_envs=4, particles="lite"), max_episode_steps=200)
        >>> env.reset().shape
        (4, 3, 64, 64)
    """

    def __init__(
        self,
        env: Any,
        spaces: tuple[Space[Any], Space[Any]] | None = None,
        max_episode_steps: int | None = None,
        tensors: bool = False,
        stagger: bool = False,
    ) -> None:
        if isinstance(env, gymnasium.Env | gymnasium.vector.VectorEnv):
            raise TypeError(f"env must be a TorchEnv, such as env.unwrapped.torch_env, got {env!r}")
        self.torch_env, self.tensors, self.stagger = env, tensors, stagger
        if max_episode_steps is not None:  # -1 would end every episode in its first step
            max_episode_steps = min(checks.whole("max_episode_steps", max_episode_steps, 1), env.spec.horizon)
        self.max_episode_steps = max_episode_steps
        self.render_mode = "rgb_array"
        super().__init__(env.num_envs, *(spaces or dittogym_env.spaces(env)))
        self._actions: Tensor | None = None
        self._are_finite: bool | Tensor = True  # these actions
        self._limits = self._first_limits()

    def _first_limits(self) -> np.ndarray | None:
        limit = self.max_episode_steps
        if limit is None:
            return None
        if not self.stagger:
            return np.full(self.num_envs, limit)
        return first_limits(self.num_envs, limit, torch.device("cpu")).numpy()

    @torch.no_grad()
    def reset(self) -> VecEnvObs:
        """Start new episodes in all elements, with the seed and options set since the last reset.

        Returns:
            uint8 (B, 3, 64, 64), a tensor with ``tensors``.

        Raises:
            ValueError: The options are not one dictionary for all elements, see `dittogym.TorchEnv.reset`.
        """
        options = self._options[0] if self._options else {}
        shared = len(self._options) == self.num_envs and all(other is options for other in self._options)
        if any(self._options) and not shared:
            raise ValueError(f"options must be one dictionary for all {self.num_envs} elements, got {self._options}")
        observation, info = self.torch_env.reset(seed=self._seeds[0], options=options or None)
        self._reset_seeds()
        self._reset_options()
        self._limits = self._first_limits()
        self.reset_infos = _split(dittogym_env.as_numpy(info))
        return self._as_returned(observation)

    def _as_returned(self, observation: Tensor) -> Any:
        # A copy, because the environment may use its memory again.
        return observation.clone() if self.tensors else dittogym_env.as_numpy(observation)

    def step_async(self, actions: Any) -> None:
        """Set the actions (B, 2, R, R), float, of the next step; with ``tensors`` they may be a tensor.

        Raises:
            NonFiniteError: An action is NaN or infinite; of a tensor, ``step_wait`` raises it.
        """
        if isinstance(actions, Tensor):
            self._are_finite = actions.isfinite().all()
            self._actions = torch.where(self._are_finite, actions, 0.0)
            return
        if not np.isfinite(actions).all():
            raise NonFiniteError(DIVERGED)
        self._actions, self._are_finite = to_device(np.array(actions, np.float32), self.torch_env.device), True

    @torch.no_grad()
    def step_wait(self) -> VecEnvStepReturn:
        """Step with these actions; returns observation, reward (B,) float32, done (B,) bool, and infos.

        Raises:
            NonFiniteError: A reward is NaN or infinite, or an action of ``step_async`` was.
        """
        assert self._actions is not None, "step_async must be called first"
        step = autoreset_step(self.torch_env, self._actions, self._limits)
        self._actions = None
        if not self._are_finite:  # on a GPU, which the step has waited for already
            raise NonFiniteError(DIVERGED)
        reward, head = step.reward.astype(np.float32), "reward_terms/"
        if not np.isfinite(reward).all():
            terms = {name.removeprefix(head): each for name, each in step.info.items() if name.startswith(head)}
            raise reward_error(terms)
        if self._limits is not None:
            self._limits[step.done] = self.max_episode_steps
        infos = _split(step.info)
        for index, image in step.finals.items():
            infos[index]["terminal_observation"] = image
            infos[index]["TimeLimit.truncated"] = bool(step.truncated[index])
        return self._as_returned(step.observation), reward, step.done, infos

    def state_dict(self) -> list[Tensor]:
        """Tensors of the episodes in progress, with a leading B; see `load_state_dict`."""
        return [value.detach().cpu().clone() for value in self._state()]

    def _state(self) -> list[Tensor]:
        limits = [] if self._limits is None else [torch.from_numpy(self._limits)]
        return [*tree.leaves(self.torch_env.env_state), *limits]

    def load_state_dict(self, state: list[Tensor]) -> None:
        """Restore a state of `state_dict`, tensors with a leading B.

        Call ``reset`` with the same seed before, so that later resets agree too.

        Raises:
            ValueError: The state is not one of this environment.
        """
        shapes, expected = ([tuple(value.shape) for value in values] for values in (state, self._state()))
        if shapes != expected:
            raise ValueError(f"state must hold tensors of shapes {expected}, got {shapes}")
        values = iter(state)
        self.torch_env.env_state = tree.map(lambda value: next(values).to(value), self.torch_env.env_state)
        if self._limits is not None:
            self._limits = next(values).numpy().copy()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One picture, uint8 (512, 512, 3), per element."""
        return [self.torch_env.render(index) for index in range(self.num_envs)]

    def close(self) -> None:
        """Do nothing: the environment holds no window and no file."""

    def _owner(self, attr_name: str) -> Any:
        return self if attr_name == "render_mode" else self.torch_env

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Attribute of the batch, repeated for each requested element."""
        return [getattr(self._owner(attr_name), attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the whole batch.

        Raises:
            ValueError: Only some elements are requested.
        """
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"indices must be None, got {indices}: the elements of a batch share their attributes")
        setattr(self._owner(attr_name), attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once and repeat its result for each requested element."""
        result = getattr(self.torch_env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Always False, for any ``wrapper_class``: elements are not wrapped one by one."""
        return [False for _ in self._get_indices(indices)]


def _split(info: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Turn one dictionary of arrays with a leading B into B dictionaries of numbers."""
    columns = [array.tolist() for array in info.values()]
    return [dict(zip(info, row, strict=True)) for row in zip(*columns, strict=True)]


def reward_error(terms: Mapping[str, Any]) -> NonFiniteError:
    """The error about a reward that is not finite, with its ``terms``: where the simulation is not, it is a number."""
    names = [name for name, values in terms.items() if not torch.as_tensor(values).isfinite().all()]
    reason = "the reward function of the task returned NaN or an infinite number"
    return NonFiniteError(f"a reward is not finite: {reason}" + (f" for {', '.join(names)}" if names else ""))


def keeps_tensors(env: Any) -> bool:
    """Whether a vectorised environment is, or wraps, a `TorchVecEnv` whose observations are tensors."""
    return bool(getattr(getattr(env, "unwrapped", env), "tensors", False))


def first_limits(num_envs: int, max_steps: int, device: torch.device) -> Tensor:
    """Steps (B,) after which the first episodes are truncated: a fraction ``(i + 1) / B`` of those of later ones."""
    return (torch.arange(1, num_envs + 1, device=device) * max_steps // num_envs).clamp(min=1)


def monitored(env: Any, max_episode_steps: int | None = None, tensors: bool = False) -> VecMonitor:
    """Wrap an environment for training; adds return and length as ``info["episode"]``."""
    return VecMonitor(TorchVecEnv(env, max_episode_steps=max_episode_steps, tensors=tensors, stagger=True))
