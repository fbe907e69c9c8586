"""An episode as data, from which films, filmstrips and replays are made."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, fields
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from PIL import Image

from dittogym.action import trained_layout
from dittogym.files import replacing
from dittogym.render.film import UNITS, check_available, possible_rate, write_film
from dittogym.render.frame import frame, pace, written_return
from dittogym.render.replay import SHOWN, replay_page
from dittogym.render.scene import REST, Scene, Shot, check_view, describe
from torchmpm import checks

#: Chooses actions (B, 2, R, R) from observations (B, 3, 64, 64).
Act: TypeAlias = Callable[[np.ndarray], Any]
#: Of :class:`FilmOptions` those that have an effect, by suffix.
OPTIONS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(UNITS, ("size", "rate", "speed", "zoom", "muscles")),
    ".png": ("size", "zoom", "muscles", "pictures"),
    ".html": ("speed",),
}
#: Playback speeds, as a fraction of real time, and the shortest film for which one of them is chosen, s.
SPEEDS = tuple(mantissa / 10**exponent for exponent in range(6) for mantissa in (1.0, 0.5, 0.2))
SHORTEST = 4.0


@dataclass(frozen=True, kw_only=True)
class FilmOptions:
    """Options of films, filmstrips and replays.

    Films take all but ``pictures``, filmstrips take ``size``, ``zoom``, ``muscles`` and ``pictures``, and replays take
    ``speed``.

    Attributes:
        size: Pixels per side of a picture, from 16 to 8192.
        rate: Pictures per second of a film, at least 0.01.
        speed: Speed of playback, 1 for real time; ``None`` for :attr:`Recording.default_speed`.
        zoom: A picture shows ``1 / zoom`` metres, at most 20 m; ``None`` for 0.56 m, a little more than the robot
            observes.
        muscles: Colour the robot by its muscles: contraction red, expansion blue.
        pictures: Number of pictures of a filmstrip, at equal intervals from the start to the end.

    Raises:
        ValueError: An option is out of range.
    """

    size: int = 512
    rate: float = 30.0
    speed: float | None = None
    zoom: float | None = None
    muscles: bool = True
    pictures: int = 6

    def __post_init__(self) -> None:
        check_view(self.size, self.zoom)
        checks.number("rate", self.rate, least=0.01)  # a GIF can show a picture for ten minutes
        if self.speed is not None:
            checks.number("speed", self.speed, above=0.0)
        checks.flag("muscles", self.muscles)
        checks.whole("pictures", self.pictures, 1)


@dataclass(eq=False, repr=False)
class Recording:
    """One episode of one simulation, as :meth:`dittogym.TorchEnv.film` returns it. A notebook shows its replay.

    Attributes:
        scene: The static parts of the scene.
        shots: T + 1 moments: the start, and one after each of the T steps.
        rewards: T rewards.
        observation: (3, 64, 64) uint8, the last observation.
        success: Whether the task is solved in the last step; ``None`` where it does not define success.
    """

    scene: Scene
    shots: list[Shot] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    observation: np.ndarray | None = None
    success: bool | None = None

    def __repr__(self) -> str:
        """Task, steps and return; the data would fill pages."""
        return f"Recording({self.scene.task!r}, steps={len(self.rewards)}, total_reward={sum(self.rewards):.1f})"

    @property
    def duration(self) -> float:
        """Simulated time of the episode, s."""
        return len(self.rewards) * self.scene.dt

    @property
    def default_speed(self) -> float:
        """The first speed of 1 (real time), 0.5, 0.2, 0.1, ... with which a film takes four seconds or more."""
        return next((speed for speed in SPEEDS if self.duration / speed >= SHORTEST), SPEEDS[-1])

    def picture(
        self,
        time: float,
        *,
        size: int = 512,
        zoom: float | None = None,
        muscles: bool = True,
        caption: tuple[str, str] | None = None,
        legend: bool = False,
    ) -> np.ndarray:
        """Draw a moment; between two steps, particles move on straight lines.

        Args:
            time: Time since the reset, s; a time outside the episode stands for its start or end.
            size: S, pixels per side, from 16 to 8192.
            zoom: The picture shows ``1 / zoom`` metres, as in :meth:`dittogym.TorchEnv.render`.
            muscles: Colour the robot by its muscles: contraction red, expansion blue.
            caption: Two texts, for the upper left and the upper right corner; ``None`` for no text.
            legend: Explain the colours below the caption.

        Returns:
            (S, S, 3) uint8 in RGB.

        Raises:
            ValueError: ``time`` is not a number, ``size`` or ``zoom`` is out of range, or ``muscles`` is not True or
                False.
        """
        checks.number("time", time)
        at = float(np.clip(time / self.scene.dt, 0, len(self.shots) - 1))
        before, after = self.shots[int(at)], self.shots[min(int(at) + 1, len(self.shots) - 1)]
        if (part := np.float32(at - int(at))) > 1e-6:
            names = ("x", "origin", "view", "centre")
            moved = {n: (1 - part) * getattr(before, n) + part * getattr(after, n) for n in names}
            before = after._replace(**moved)
        if "muscle" not in before.values:  # nothing has acted yet, and muscles are at rest
            rest = np.full(self.scene.bodies[0].count, REST, np.uint8)
            before = before._replace(values=before.values | {"muscle": rest})
        return frame(self.scene, before, size, zoom, muscles, caption, legend)

    def save(self, path: str | os.PathLike[str], **options: Any) -> Path:
        """Write a film, a filmstrip or a replay.

        Args:
            path: The file, whose suffix chooses the kind: ``.mp4``, ``.gif`` or ``.webp`` for a film; ``.png`` for a
                filmstrip, pictures beside each other; ``.html`` for a replay, a page that plays the episode in any
                browser, also without a network.
            options: Options of :class:`FilmOptions`. Here, those that this kind of file does not take have no effect,
                so that several files can share them; ``film`` of an environment refuses them.

        Returns:
            The path.

        Raises:
            ValueError: ``path`` has another suffix, or an option is out of range.
            TypeError: There is no such option.
            dittogym.render.film.VideoUnavailable: An MP4 without the extra ``video``, or with an ffmpeg that fails.
        """
        path, chosen = check_path(path), FilmOptions(**options)
        if path.suffix == ".html":
            with replacing(path) as aside:
                aside.write_text(self.page(chosen.speed), encoding="utf-8")
        elif path.suffix == ".png":
            with replacing(path) as aside:
                Image.fromarray(self._strip(chosen)).save(aside)
        else:
            rate = possible_rate(path.suffix, chosen.rate)
            write_film(path, self._frames(chosen, rate), rate)
        return path

    def page(self, speed: float | None = None) -> str:
        """Return the replay as an HTML page.

        Args:
            speed: Speed of playback at the beginning, 1 for real time; ``None`` for :attr:`default_speed`.

        Raises:
            ValueError: ``speed`` is not positive.
        """
        speed = FilmOptions(speed=speed).speed or self.default_speed
        return replay_page(self.scene, self.shots, self.rewards, self.success, speed)

    def _frames(self, options: FilmOptions, rate: float) -> Iterator[np.ndarray]:
        """The pictures of a film with task, time, return, playback speed and the meaning of colours."""
        speed = options.speed or self.default_speed
        returns = np.cumsum([0.0, *self.rewards])
        for number in range(round(self.duration / speed * rate) + 1):
            time = min(number * speed / rate, self.duration)
            total = written_return(returns[min(round(time / self.scene.dt), len(self.rewards))])
            caption = f"{self.scene.task}   {self._clock(time)}", f"return {total}   {pace(speed)}"
            yield self._picture(time, options, caption, legend=True)

    def _strip(self, options: FilmOptions) -> np.ndarray:
        gap = np.full((options.size, max(1, options.size // 64), 3), 255, np.uint8)
        strip = []
        for time in np.linspace(0, self.duration, options.pictures):
            strip += [self._picture(time, options, (self._clock(time), "")), gap]
        return np.concatenate(strip[:-1], axis=1)

    def _picture(self, time: float, options: FilmOptions, caption: tuple[str, str], legend: bool = False) -> np.ndarray:
        size, zoom, muscles = options.size, options.zoom, options.muscles
        return self.picture(time, size=size, zoom=zoom, muscles=muscles, caption=caption, legend=legend)

    def _clock(self, time: float) -> str:
        """A time in s with so many digits that steps can be told apart."""
        return f"{time:.{max(2, int(np.ceil(-np.log10(self.scene.dt) - 1e-9)))}f} s"

    def _repr_html_(self) -> str:
        page = escape(self.page())
        return f'<iframe srcdoc="{page}" width="600" height="800" style="border:0; max-width:100%"></iframe>'


def check_path(path: str | os.PathLike[str]) -> Path:
    """The path of a film, a filmstrip or a replay; a ``ValueError`` if it has another suffix."""
    if Path(path).suffix not in OPTIONS:
        raise ValueError(f"path must end in one of {', '.join(OPTIONS)}, got {str(path)!r}")
    return Path(path)


def check_film(path: Any, options: Mapping[str, Any]) -> None:
    """Check the arguments of :meth:`Recording.save` for a single file, of which none may be without effect."""
    if unknown := options.keys() - (names := [option.name for option in fields(FilmOptions)]):
        raise TypeError(f"options of a film must be among {', '.join(names)}, got {sorted(unknown)}")
    FilmOptions(**options)
    if path is None:
        if options:
            raise TypeError(f"path must be given with {', '.join(options)}, got None")
        return
    suffix = check_path(path).suffix
    if suffix == ".mp4":
        check_available()
    if unused := [name for name in options if name not in OPTIONS[suffix]]:
        allowed = ", ".join(OPTIONS[suffix])
        raise ValueError(f"{unused[0]} must not be given with a path that ends in {suffix}, which takes {allowed}")


def film(
    env: Any, act: Act, path: Any, seed: Any, index: int = 0, *, max_steps: int | None = None, **options: Any
) -> Recording:
    """Record an episode, see :func:`record`, and save it if a ``path`` is given, see :meth:`Recording.save`."""
    check_film(path, options)  # before the episode
    recording = record(env, act, seed, index, max_steps)
    if path is not None:
        recording.save(path, **options)
    return recording


def record(env: Any, act: Act, seed: Any = 0, index: int = 0, max_steps: int | None = None) -> Recording:
    """Play an episode.

    Args:
        env: A :class:`dittogym.TorchEnv`, which is reset.
        act: Chooses the actions.
        seed: Of the reset.
        index: Which element of the batch is recorded, until its episode ends.
        max_steps: Stop after this many steps if the episode is longer.
    """
    if max_steps is not None:
        checks.whole("max_steps", max_steps, 1)
    recording = Recording(describe(env.model))
    for observation, _, end in islice(play(env, act, seed, index), None if max_steps is None else max_steps + 1):
        recording.shots.append(env.shot(index, SHOWN))
        recording.observation = observation[index]
        if end is not None:
            reward, _, _, info = end
            recording.rewards.append(float(reward[index]))
            recording.success = bool(info["is_success"][index]) if "is_success" in info else None
    return recording


@torch.no_grad()
def play(env: Any, act: Act, seed: Any, index: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray | None, Any]]:
    """Play an episode: after the reset and after each step the observations, the actions, and what else it returned.

    Args:
        env: A :class:`dittogym.TorchEnv`, which is reset.
        act: Chooses the actions.
        seed: Of the reset, and of the noise that ``act`` takes from torch's generators, which are left as they were.
        index: Which element of the batch to play to the end of its episode.

    Raises:
        ValueError: ``act`` returns something else than actions.
    """
    observation, _ = env.reset(seed=seed)
    images, ended, step = observation.cpu().numpy(), False, 0
    own = seed if seed is None or np.ndim(seed) == 0 else seed[index]
    yield images, None, None
    while not ended:
        with generators_kept(own is not None):
            if own is not None:
                seed_noise(int(own), step)
            chosen = act(images)
        step += 1
        try:
            action = torch.as_tensor(chosen, device=env.device)
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"policy must return actions, got {type(chosen).__name__}: {error}") from error
        observation, *end = env.step(action)
        images, ended = observation.cpu().numpy(), bool(end[1][index] | end[2][index])
        action = action.float() if action.dtype == torch.bfloat16 else action  # which NumPy does not have
        yield images, action.cpu().numpy(), end


def generators_kept(enabled: bool = True) -> AbstractContextManager[None]:
    """Restore torch's generators at the end, if ``enabled``."""
    # To read the generator of a GPU that is not in use would occupy it.
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    return torch.random.fork_rng(devices, enabled)


def seed_noise(seed: int, step: int) -> None:
    """Seed torch's generators for the noise of a policy in a step of the episode with this seed."""
    number = int(np.random.SeedSequence((seed, step)).generate_state(1)[0])
    torch.default_generator.manual_seed(number)  # torch.manual_seed takes 150 times as long, for devices not in use
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(number)


def attached(policy: Any, env: Any) -> Any:
    """A policy for an environment: one that acts on the state of the simulation is shown that of ``env``."""
    return policy.attached(env) if hasattr(policy, "attached") else policy


def as_function(policy: Any, env: Any) -> Act:
    """A policy as a function of observations.

    Args:
        policy: A function, or an object with ``predict(observation, state)`` as stable-baselines3's, which returns
            actions and the next state. If its ``deterministic_by_default`` is true, it is also given
            ``deterministic=True``.
        env: The :class:`dittogym.TorchEnv` in which it acts.

    Raises:
        TypeError: It is neither.
        ValueError: It was trained with another ``action_layout``.
    """
    if (trained := trained_layout(policy)) not in (None, env.action_layout):
        allowed = f"action_layout {env.action_layout!r} of the environment"
        raise ValueError(f"policy must be one for {allowed}, got one for {trained!r}")
    policy = attached(policy, env)
    if not hasattr(policy, "predict"):
        if not callable(policy):
            raise TypeError(f"policy must be a function or have a method predict, got {type(policy).__name__}")
        return policy
    options = {"deterministic": True} if getattr(policy, "deterministic_by_default", False) else {}
    memory: Any = None

    def act(observation: np.ndarray) -> Any:
        nonlocal memory
        action, memory = policy.predict(observation, memory, **options)
        return action

    return act
