"""The stable-baselines3 face of `dittogym.TorchEnv`: a batch of robots as one `VecEnv`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, cast

import gymnasium
import numpy as np
import torch
from gymnasium import Space
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from torch import Tensor

import dittogym.env
from cfp.errors import NonFiniteError
from dittogym import TorchEnv
from dittogym.autoreset import autoreset_step


class BatchedEnv(Protocol):
    """What `TorchVecEnv` needs of an environment; `dittogym.TorchEnv` has it."""

    num_envs: int
    action_resolution: int
    device: Any
    env_state: Any
    generators: Any

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Observations (B, 3, 64, 64) and info; ``options["reset_mask"]`` (B,) picks the elements to reset."""

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Observation, reward, terminated, truncated (each with leading B) and info for actions (B, 2, R, R)."""

    def render(self, index: int = 0) -> np.ndarray:
        """Picture of one element, uint8 (512, 512, 3)."""


class TorchVecEnv(VecEnv):
    """Batched environment with same-step autoreset, as stable-baselines3 expects it.

    An element whose episode ended is reset within the same step: the returned observation is the new episode's first,
    and ``info["terminal_observation"]`` keeps the last one. ``info["TimeLimit.truncated"]`` is true whenever the time
    limit was reached, also if the element terminated in that very step; the reference implementation bootstraps there.
    An element whose state is no longer finite (``info["finite"]`` false) ends as terminated and is reset.

    Args:
        env: The environment; it is stepped without gradients.
        spaces: Of observations and actions, if they are not images.
    """

    def __init__(self, env: BatchedEnv, spaces: tuple[Space[Any], Space[Any]] | None = None) -> None:
        """Take over an environment."""
        self.torch_env = env
        self.render_mode = "rgb_array"
        own = dittogym.env.spaces(cast(TorchEnv, env)) if spaces is None else spaces
        super().__init__(env.num_envs, *own)
        self._actions: Tensor | None = None

    @torch.no_grad()
    def reset(self) -> VecEnvObs:
        """Start a new episode everywhere; what ``seed()`` and ``set_options()`` gave is used once.

        Returns:
            uint8 (B, 3, 64, 64).

        Raises:
            ValueError: The environment refuses the options, or they are not the same for all elements. Values for each
                element stand within them, see `dittogym.TorchEnv.reset`.
        """
        options = self._options[0] if self._options else {}
        if len(self._options) != self.num_envs or not all(_same(options, other) for other in self._options):
            raise ValueError(
                f"options: got {self._options}, allowed are one for all elements, or the same {self.num_envs} times"
            )
        observation, info = self.torch_env.reset(seed=self._seeds[0], options=options or None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = self._split_info(info)
        return _to_numpy(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions (B, 2, R, R), float.

        Raises:
            NonFiniteError: One is NaN or infinite, as those of a policy are that has diverged.
        """
        if not np.isfinite(actions).all():
            raise NonFiniteError("an action is not finite: the policy has diverged; the last checkpoint is untouched")
        self._actions = torch.as_tensor(actions, dtype=torch.float32, device=self.torch_env.device)

    @torch.no_grad()
    def step_wait(self) -> VecEnvStepReturn:
        """Step with the remembered actions; returns observation, reward (B,) float32, done (B,) bool, infos."""
        assert self._actions is not None, "step_async comes first"
        step = autoreset_step(self.torch_env, self._actions)
        self._actions = None
        infos, done = self._split_info(step.info), _to_numpy(step.done)
        if done.any():
            finals, timed_out = _to_numpy(step.final_observation), _to_numpy(step.truncated)
            for index in np.flatnonzero(done):
                infos[index]["terminal_observation"] = finals[index]
                infos[index]["TimeLimit.truncated"] = bool(timed_out[index])
        return _to_numpy(step.observation), _to_numpy(step.reward.float()), done, infos

    def _split_info(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        """Turn one dictionary of tensors with leading B into B dictionaries of numbers."""
        columns = {key: value.tolist() for key, value in info.items() if isinstance(value, Tensor)}
        terms = {key: value.tolist() for key, value in info.get("reward_terms", {}).items()}
        infos: list[dict[str, Any]] = []
        for index in range(self.num_envs):
            element: dict[str, Any] = {key: value[index] for key, value in columns.items()}
            if terms:
                element["reward_terms"] = {key: value[index] for key, value in terms.items()}
            infos.append(element)
        return infos

    def state_dict(self) -> Any:
        """All that an episode in progress needs to go on, as tensors in plain containers; see `load_state_dict`."""
        return _to_plain(self.torch_env.env_state)

    def load_state_dict(self, state: Any) -> None:
        """Put a state of `state_dict` back; call ``reset`` with the same seed first, so that later resets agree too.

        Raises:
            ValueError: The state is not one of this environment.
        """
        self.torch_env.env_state = _from_plain(self.torch_env.env_state, state)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One uint8 picture (512, 512, 3) per element."""
        return [self.torch_env.render(index) for index in range(self.num_envs)]

    def close(self) -> None:
        """Nothing to release: the environment holds no window and no file."""

    def _indices(self, indices: VecEnvIndices) -> list[int]:
        if indices is None:
            return list(range(self.num_envs))
        return list(indices) if isinstance(indices, Iterable) else [indices]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, repeated for each element asked for."""
        owner = self if attr_name == "render_mode" else self.torch_env
        return [getattr(owner, attr_name) for _ in self._indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the whole batch; elements cannot differ.

        Raises:
            ValueError: Only some elements were named.
        """
        if self._indices(indices) != list(range(self.num_envs)):
            raise ValueError(f"indices: got {indices}, allowed None (the elements of a batch share their attributes)")
        setattr(self.torch_env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once and repeat its result for each element asked for."""
        result = getattr(self.torch_env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No element is wrapped, whatever the ``wrapper_class``."""
        return [False for _ in self._indices(indices)]


def _to_numpy(tensor: Tensor) -> np.ndarray:
    """A copy, so that what is stored cannot change when the environment reuses its memory."""
    array: np.ndarray = tensor.detach().cpu().numpy().copy()
    return array


def _same(one: Any, other: Any) -> bool:
    """Whether two options are equal, in which there may be arrays and tensors."""
    if one is other:
        return True
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    one, other = (value.detach().cpu() if isinstance(value, Tensor) else value for value in (one, other))
    return np.array_equal(one, other)


def _to_plain(value: Any) -> Any:
    """Turn nested dataclasses, named tuples and mappings of tensors into lists and dictionaries of tensors."""
    if dataclasses.is_dataclass(value):
        return {field.name: _to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_to_plain(item) for item in value]
    return value.detach().cpu().clone() if isinstance(value, Tensor) else value


def _from_plain(pattern: Any, value: Any) -> Any:
    """Undo `_to_plain` with the types, shapes and devices of a pattern."""
    if dataclasses.is_dataclass(pattern) and not isinstance(pattern, type):
        values = {
            field.name: _from_plain(getattr(pattern, field.name), value[field.name])
            for field in dataclasses.fields(pattern)
        }
        return dataclasses.replace(pattern, **values)
    if isinstance(pattern, Mapping):
        return {key: _from_plain(item, value[key]) for key, item in pattern.items()}
    if isinstance(pattern, tuple):
        items = [_from_plain(*pair) for pair in zip(pattern, value, strict=True)]
        return pattern._make(items) if hasattr(pattern, "_make") else tuple(items)
    if isinstance(pattern, Tensor):
        if pattern.shape != value.shape:
            raise ValueError(f"environment state: got a tensor {tuple(value.shape)}, allowed {tuple(pattern.shape)}")
        return value.to(pattern)
    return value


def monitored(env: BatchedEnv) -> VecMonitor:
    """Wrap an environment for training or `evaluate_policy`: adds ``info["episode"]`` with return and length."""
    return VecMonitor(TorchVecEnv(env))
