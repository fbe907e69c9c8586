"""The single Gymnasium environment: a :class:`dittogym.TorchEnv` with a batch of one."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec

from dittogym.bodies.json_values import to_values
from dittogym.bodies.positions import MAX_SEED
from dittogym.copies import to_device, to_host
from dittogym.render.frame import frame, pace
from dittogym.render.recording import Act, Recording, as_function, film
from dittogym.render.scene import check_size, describe
from dittogym.snapshots import Snapshot
from dittogym.spec import TaskSpec
from dittogym.tasks import usual_horizon
from dittogym.torch_env import TorchEnv
from torchmpm import ParticleState, checks

#: Pictures per second of a video; a control step is 0.01 s, so motion is shown three times slower.
RENDER_FPS = 30


def spaces(env: TorchEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Observation and action space of one simulation."""
    observation = gymnasium.spaces.Box(0, 255, env.observation_shape, np.uint8)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, env.action_shape, np.float32)


def as_tensor(action: Any, env: TorchEnv, single: bool = False) -> torch.Tensor:
    """An array of actions as a tensor; ``single``: one action, which becomes a batch of one."""
    if np.ma.is_masked(action):
        raise ValueError(f"action must be numbers, got a masked array with {np.ma.count_masked(action)} masked entries")
    expected = env.action_shape if single else (env.num_envs, *env.action_shape)
    try:
        array = np.asarray(action)
    except (RuntimeError, TypeError, ValueError) as error:  # rows of different lengths, sparse tensors
        raise ValueError(f"action must be numbers of shape {expected}, got {type(action).__name__}: {error}") from error
    if array.dtype.kind not in "fiu" or array.shape != expected:
        other = array.shape == (*expected[:-2], *array.shape[-1:] * 2) != expected
        hint = f"; make the environment with resolution={array.shape[-1]}" if other else ""
        raise ValueError(f"action must be numbers of shape {expected}, got {array.dtype} of shape {array.shape}{hint}")
    # A copy: torch takes neither negative strides nor foreign byte orders.
    numbers = np.float64 if env.dtype is torch.float64 else np.float32
    array = np.array(array[None] if single else array, numbers, order="C")
    return to_device(array, env.device)


def flat(info: dict[str, Any]) -> dict[str, torch.Tensor]:
    """An ``info`` without nesting: reward terms have keys such as ``reward_terms/velocity``."""
    terms = {f"reward_terms/{name}": value for name, value in info.get("reward_terms", {}).items()}
    return {name: value for name, value in info.items() if name != "reward_terms"} | terms


def as_numpy(value: torch.Tensor | dict[str, Any]) -> Any:
    """Copies of a tensor, or of all in an ``info``, as arrays, which the user may write to."""
    return to_host(flat(value)) if isinstance(value, dict) else to_host({"": value})[""]


def first(value: Any) -> Any:
    """The first element of an array, or of all in an ``info``; numbers come out as NumPy scalars.

    Bools are Python's, because Gymnasium's wrappers do not recognise those of NumPy.
    """
    if isinstance(value, dict):
        return {name: first(entry) for name, entry in value.items()}
    return bool(value[0]) if isinstance(value[0], np.bool_) else value[0]


def step_to_host(env: TorchEnv, action: torch.Tensor) -> tuple[torch.Tensor, list[np.ndarray], dict[str, np.ndarray]]:
    """A step of a batch, of which all but the observations is copied in one piece, so that a GPU is waited for once.

    Returns:
        The observations, still a tensor; rewards, terminated, truncated and steps taken, (B,) each; and ``info``.
    """
    observation, reward, terminated, truncated, info = env.step(action)
    own = {"_reward": reward, "_terminated": terminated, "_truncated": truncated, "_steps": env.env_state.steps}
    arrays = to_host(flat(info) | own)
    return observation, [arrays.pop(name) for name in own], arrays


class Shell:
    """What both Gymnasium environments have around their :class:`dittogym.TorchEnv`."""

    torch_env: TorchEnv
    metadata: dict[str, Any]
    _spec: EnvSpec | None = None

    def _set_pictures(self, render_mode: str | None, render_muscles: bool, render_size: int) -> None:
        modes = self.metadata["render_modes"]
        if render_mode not in (None, *modes):
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")
        checks.flag("render_muscles", render_muscles)
        check_size("render_size", render_size)
        self.render_mode, self.render_muscles, self.render_size = render_mode, render_muscles, render_size

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made the environment from, with options that JSON can hold."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and replace(spec, kwargs={name: to_values(value) for name, value in spec.kwargs.items()})

    @property
    def state(self) -> ParticleState:
        """The particles of all simulations."""
        return self.torch_env.state

    def save(self) -> Snapshot:
        """Return a snapshot, which ``load`` restores, see :meth:`dittogym.TorchEnv.save`."""
        return self.torch_env.save()

    def _picture(self, index: int) -> np.ndarray:
        return self.torch_env.render(index, size=self.render_size, muscles=self.render_muscles)

    def _repr_png_(self) -> bytes | None:
        return self.torch_env._repr_png_()


class Env(Shell, gymnasium.Env[np.ndarray, np.ndarray]):
    """One simulation behind the Gymnasium interface.

    An environment of :func:`gymnasium.make` leaves the time limit to Gymnasium's wrapper, so an id of your own needs
    ``max_episode_steps`` in :func:`gymnasium.register`; one that is made directly truncates episodes itself.

    Args:
        task: A task name, ``"MODULE:NAME"``, or a :class:`dittogym.TaskSpec`.
        render_mode: ``None``; ``"rgb_array"``, for :meth:`render`; or ``"human"`` for a window, which needs pygame. In
            the window, space pauses, the right arrow takes a single step, and q or Escape closes it, after which the
            simulation goes on without a window.
        render_muscles: Colour the robot by its muscles in pictures.
        render_size: Pixels per side of pictures and of the window, from 16 to 8192.
        options: All arguments of :class:`dittogym.TorchEnv` except ``num_envs``.

    Attributes:
        torch_env: The :class:`dittogym.TorchEnv` behind it, a batch of one.
        observation_space: ``Box(0, 255, (3, 64, 64), uint8)``.
        action_space: ``Box(-1, 1, (2, R, R), float32)``.

    Raises:
        ValueError: The render mode is unknown, or as in :class:`dittogym.TorchEnv`.
        TypeError: ``num_envs`` is given, or as in :class:`dittogym.TorchEnv`.
        ImportError: ``render_mode="human"`` without pygame.

    Examples:
        >>> import dittogym, gymnasium
        >>> env = gymnasium.make("dittogym/run-coarse-v0", particles="lite")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, env.action_space.shape
        ((3, 64, 64), (2, 8, 8))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": RENDER_FPS}

    def __init__(
        self,
        task: str | TaskSpec,
        *,
        render_mode: str | None = None,
        render_muscles: bool = True,
        render_size: int = 512,
        **options: Any,
    ) -> None:
        self._set_pictures(render_mode, render_muscles, render_size)
        if "num_envs" in options:
            batch = "gymnasium.make_vec(..., vectorization_mode='vector_entry_point') or dittogym.TorchEnv"
            raise TypeError(f"num_envs must not be given, got {options['num_envs']!r}; for a batch use {batch}")
        self.torch_env = TorchEnv(task, 1, **options)
        self._own_limit = self.torch_env.spec.horizon != usual_horizon(task)
        self.observation_space, self.action_space = spaces(self.torch_env)
        self._screen, self._return = None, 0.0
        if render_mode == "human":
            from dittogym.render.screen import Screen  # pygame is an extra

            self._screen = Screen("dittogym: " + self.torch_env.spec.name, RENDER_FPS)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode, see :meth:`dittogym.TorchEnv.reset`, whose errors it raises.

        Args:
            seed: Seed from which new initial positions are drawn, from 0 to 2**32 - 1; ``None`` uses the last positions
                again, unless the environment was made with ``resample=True``.
            options: The options of :meth:`dittogym.TorchEnv.reset`.

        Returns:
            The observation (3, 64, 64) uint8, and ``info`` as in :meth:`step`, without the entries of a step.
        """
        seed = None if seed is None else checks.whole("seed", seed, 0, MAX_SEED)
        with torch.no_grad():
            observation, info = self.torch_env.reset(seed=seed, options=options)
        super().reset(seed=seed)
        self._return = 0.0
        self._show()
        return first(as_numpy(observation)), first(as_numpy(info))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step, see :meth:`dittogym.TorchEnv.step`.

        Args:
            action: (2, R, R) numbers in [-1, 1]; larger ones saturate.

        Returns:
            The observation (3, 64, 64) uint8, the reward, whether the task ended the episode, whether the time limit
            did, and ``info`` with the entries of :meth:`dittogym.TorchEnv.step` as arrays, NumPy scalars and Python's
            bools; the reward terms have keys such as ``"reward_terms/velocity"``.

        Raises:
            ValueError: The action has another shape or is not finite.
            RuntimeError: The environment was not reset yet.
        """
        with torch.no_grad():
            batch = as_tensor(action, self.torch_env, single=True)
            image, own, info = step_to_host(self.torch_env, batch)
        reward, terminated, truncated, _ = (array[0].item() for array in own)
        self._return += reward
        self._show()
        limit = truncated and (self.spec is None or self._own_limit)  # else Gymnasium's TimeLimit truncates
        return first(as_numpy(image)), reward, terminated, limit, first(info)

    def load(self, snapshot: Snapshot) -> np.ndarray:
        """Restore a snapshot, see :meth:`dittogym.TorchEnv.load`, whose errors it raises.

        In mode ``"human"`` the return in the caption counts from here.

        Args:
            snapshot: What :meth:`save` returned here, or in an environment with the same options.

        Returns:
            The observation (3, 64, 64) uint8.
        """
        observation = self.torch_env.load(snapshot)
        self._return = 0.0
        self._show()
        return first(as_numpy(observation))

    def render(self) -> np.ndarray | None:
        """Return a picture (S, S, 3) uint8 in RGB, S the ``render_size``, in mode ``"rgb_array"``; else ``None``."""
        return self._picture(0) if self.render_mode == "rgb_array" else None

    def film(
        self, policy: Any, path: str | os.PathLike[str] | None = None, *, seed: int = 0, **options: Any
    ) -> Recording:
        """Reset the environment, play an episode and record it.

        See :meth:`dittogym.TorchEnv.film`, whose errors it raises. Wrappers have no part in it: an environment of
        ``gymnasium.make`` is filmed with ``env.unwrapped.film``.

        Args:
            policy: As in :meth:`dittogym.TorchEnv.film`, but it gets one observation (3, 64, 64) uint8 and returns one
                action (2, R, R).
            path: The file to write, as in :meth:`dittogym.TorchEnv.film`; ``None`` writes nothing.
            seed: Seed of the reset and of the policy's noise.
            options: ``max_steps`` and options of the file, as in :meth:`dittogym.TorchEnv.film`.

        Returns:
            The recording, which a notebook shows.
        """
        return film(self.torch_env, self.acting(policy), path, seed, **options)

    def acting(self, policy: Any) -> Act:
        """A policy of one robot, see :meth:`film`, as a function that the batch of one can be driven by."""
        act = as_function(policy, self.torch_env)
        return lambda images: as_tensor(act(images[0]), self.torch_env, single=True)

    @property
    def window_open(self) -> bool:
        """Whether a window is open, as it is in mode ``"human"`` until it is closed."""
        return self._screen is not None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._screen is not None:
            self._screen.close()
            self._screen = None

    def _show(self) -> None:
        if self._screen is None:
            return
        shown, torch_env = self.torch_env.shot(0, ("muscle",)), self.torch_env
        scene = describe(torch_env.model)
        caption = (
            f"{scene.task}   {shown.step * scene.dt:.2f} s   return {self._return:,.1f}",
            pace(RENDER_FPS * scene.dt),
        )
        picture = frame(scene, shown, self.render_size, muscles=self.render_muscles, caption=caption, legend=True)
        if not self._screen.show(picture):
            self.close()
