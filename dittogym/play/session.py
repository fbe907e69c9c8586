"""A simulation that is played with, and what messages from the page do to it."""

from __future__ import annotations

import base64
import inspect
import io
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from dittogym.action import bicubic, from_grid_indexing, patch_corner, to_grid_indexing
from dittogym.geometry import NODES
from dittogym.model import check_stability
from dittogym.physics import physics_values
from dittogym.play import protocol
from dittogym.play.hand import Grip, press, tensor_point, wave
from dittogym.play.scene import describe
from dittogym.render.colours import SCALES, particle_values
from dittogym.tasks import TASKS, task_name
from dittogym.torch_env import TorchEnv
from dittogym.window import centre_in_window

#: Names of the bits of a frame's flags.
FLAGS = ("playing", "terminated", "truncated", "success", "invalid")
#: Episodes that are shorter than this start in slow motion, s.
SHORT = 2.0
#: Most control steps of an action sequence that is kept, the last ones.
LONGEST = 20_000


class Policy(Protocol):
    """A policy that can be played with; one with a method ``attached`` is given the environment, to see its state."""

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions."""

    @property
    def deterministic_by_default(self) -> bool:
        """Whether it acts without noise."""

    @property
    def description(self) -> dict[str, Any]:
        """What it comes from; ``environment`` says how its actions are laid out."""

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> tuple[Any, Any]:
        """Actions (B, 2, R, R) for observations (B, 3, 64, 64), and the policy's memory."""


class Session:
    """One robot to play with.

    Args:
        task: A task name or ``"MODULE:NAME"``.
        policies: Functions that load policies, by the names they have on the page.
        policy: Name of the one that acts at first.
        seed: Of the particles.
        options: All arguments of :class:`dittogym.TorchEnv` but ``num_envs``.

    Raises:
        ValueError: An option is out of range.
        TypeError: The task has no such option.
    """

    invalid: bool
    terminated: bool
    truncated: bool
    total: float
    terms: Mapping[str, Tensor]

    def __init__(
        self,
        task: str,
        policies: Mapping[str, Callable[[], Policy]] | None = None,
        policy: str | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        self.task, self.policies, self.seed = task, dict(policies or {}), seed
        self.options = {"resolution": "fine", **options}
        self.env = TorchEnv(task, 1, **self.options)
        self.own_resolution = self.env.action_resolution
        self.control_step = self.env.model.substeps * self.env.model.solver.dt
        short = self.env.spec.horizon * self.control_step < SHORT
        self.playing, self.speed = True, 0.1 if short else 1.0
        self.colour = "deformation" if policy is None else "muscle"
        self.policy: Policy | None = None
        self.policy_name: str | None = None
        self.hand = protocol.Hand(None)
        self.grip: Grip | None = None
        self.direction: Any = None
        self.physics: dict[str, Any] = {}
        self.moment: Any = None
        self._frames = self.num_steps = 0
        self._reset(seed)
        if policy is not None:
            self._apply_policy(protocol.Policy(policy))

    def describe(self) -> dict[str, Any]:
        """What the page needs to know about the task, as JSON values."""
        known = inspect.signature(TASKS[task_name(self.task)]).parameters
        draws = [kind for kind in protocol.Draw.kinds if kind == "body" or kind in known]
        names: dict[str, Any] = {
            "policies": list(self.policies),
            "policy": self.policy_name,
            "draws": draws,
            "flags": FLAGS,
        }
        names |= {"speed": self.speed, "colour": self.colour}
        return describe(self.env.model) | names | self.layout()

    def layout(self) -> dict[str, Any]:
        """What the sizes of a frame's arrays depend on."""
        return {"resolution": self.env.action_resolution, "gate": self.gate.shape[-1], "terms": list(self.terms)}

    def apply(self, message: protocol.Message) -> list[dict[str, Any]]:
        """Do what a message says, and return what to answer, as JSON values.

        Raises:
            ValueError: It cannot be done, and nothing has changed.
        """
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            answers = getattr(self, f"_apply_{type(message).__name__.lower()}")(message) or []
        return [*answers, *({"type": "notice", "message": str(warning.message)} for warning in caught)]

    def advance(self) -> None:
        """Take one control step, unless the state is no longer valid.

        Raises:
            Exception: Whatever a task or a policy of the user's does wrong; time is stopped.
        """
        if self.invalid:
            return
        playing, self.playing = self.playing, False  # until it has worked
        action = self._next_action()
        self._pull()
        with torch.no_grad():
            batch = torch.from_numpy(action)[None]
            self.observation, reward, terminated, truncated, info = self.env.step(batch)
        if len(self.actions) == LONGEST:
            self._note(f"only the last {LONGEST} steps")
        self.actions.append(action)
        self.num_steps += 1
        self.terms = info["reward_terms"]
        if not (self.terminated or self.truncated):
            self.total += float(reward[0])
        self.rows.append([self.total, *(float(term[0]) for term in self.terms.values())])
        self.terminated, self.truncated = self.terminated or bool(terminated[0]), self.truncated or bool(truncated[0])
        self.success = bool(info["is_success"][0]) if "is_success" in info else False
        self.invalid = not bool(info["finite"][0])
        self.playing = playing and not self.invalid

    def frame(self, rate: float) -> bytes:
        """The present moment for the page, at ``rate`` simulated seconds per second; see `protocol.pack_frame`."""
        state, self._frames = self.env.env_state, self._frames + 1
        origin = state.origin[0].cpu().numpy().astype(np.float64)
        flags = sum(getattr(self, name) << bit for bit, name in enumerate(FLAGS))
        scale = SCALES[self.colour]
        values = np.zeros(self.env.num_particles)
        own = particle_values(self.env.model, state, 0, self.env.actuation, self.colour)
        values[: len(own)] = (own - scale.low) / (scale.high - scale.low)
        colours = (255 * np.clip(np.where(np.isfinite(values), values, 0.0), 0.0, 1.0)).round().astype(np.uint8)
        positions = protocol.quantise(state.particles.x[0].cpu().numpy().astype(np.float64), origin)
        action = (127 * np.clip(self.action, -1.0, 1.0)).round().astype(np.int8)
        gate = (255 * np.clip(self.gate, 0.0, 1.0)).round().astype(np.uint8)
        rows = np.array(self.rows, np.float32)
        self.rows.clear()
        numbers = (*origin, *state.centre[0].tolist(), *self._corner(), self.total, rate)
        arrays = (positions, colours, self.observation[0].cpu().numpy(), action, gate)
        counters = self._frames, int(state.steps[0]), self.hand.id, flags
        return protocol.pack_frame(counters, numbers, rows, arrays)

    def _reset(self, seed: int | None) -> None:
        self.observation, _ = self.env.reset(seed=seed, options={"physics": self.physics})
        self.seed = self.seed if seed is None else seed
        self.terminated = self.truncated = self.success = self.invalid = False
        self.total, self.grip, self.memory = 0.0, None, None
        self.rows: list[list[float]] = []
        self.terms = {}
        self.actions: deque[np.ndarray] = deque(maxlen=LONGEST)
        self.touched: list[str] = []
        self.action: np.ndarray = np.zeros(self.env.action_shape, np.float32)
        self.painted = self.action
        self.gate = np.zeros((2, 0, 0), np.float32)

    def _next_action(self) -> np.ndarray:
        """What policy, paint, waves and hand add up to, float32 (2, R, R) in [-1, 1]."""
        size, action = self.env.action_resolution, np.asarray(self.painted)
        if self.policy is not None:
            action = action + self._decide(self.policy)
        if self.direction is not None:
            action = action + wave(self.direction, int(self.env.env_state.steps[0]), size)
        if self.hand.tool in ("contract", "expand"):
            sign = 1.0 if self.hand.tool == "contract" else -1.0
            point = np.array((self.hand.x, self.hand.y))
            action = action + sign * press(point, self._corner(), self.env.spec.patch / NODES, size)
        self.action = np.ascontiguousarray(np.clip(action, -1.0, 1.0), np.float32)
        return self.action

    def _decide(self, policy: Policy) -> np.ndarray:
        start = np.array([self.memory is None and not self.actions])
        images = self.observation.cpu().numpy()
        explain = getattr(policy, "predict_with_gate", None)
        if explain is None:
            chosen, self.memory = policy.predict(images, self.memory, start, policy.deterministic_by_default)
        else:
            chosen, gate = explain(images, policy.deterministic_by_default)
            self.gate = self.gate if gate is None else np.asarray(self._convert(torch.as_tensor(gate)))[0]
        return np.asarray(self._convert(torch.as_tensor(chosen)))[0]

    def _pull(self) -> None:
        """Let the hand pull at matter, which it takes hold of the first time."""
        if self.hand.tool != "pull":
            self.grip = None
            return
        state = self.env.env_state
        point = tensor_point(self.hand.x, self.hand.y, state.particles.x)
        self.grip = self.grip or Grip.take(state.particles, point)
        if self.grip is not None:
            self.env.env_state = replace(state, particles=self.grip.pull(state.particles, point))
            self._note("pulled by hand")

    def _note(self, change: str) -> None:
        """Remember that something other than actions has acted since the reset."""
        if change not in self.touched:
            self.touched.append(change)

    def _corner(self) -> np.ndarray:
        """Lower left corner (2,) of the action image in the world, m."""
        state, spec = self.env.env_state, self.env.spec
        corner = patch_corner(centre_in_window(spec.reach, state.centre, state.origin), spec.patch, NODES)
        return (state.origin[0] + corner[0] / NODES).cpu().double().numpy()

    def _use(self, resolution: int) -> None:
        """Go on with actions of another resolution; the painted action is wiped."""
        if resolution == self.env.action_resolution:
            return
        env = TorchEnv(self.task, 1, **{**self.options, "resolution": resolution})
        env.reset(seed=self.seed, options={"physics": self.physics})
        env.env_state = self.env.env_state
        self.env, self.painted = env, np.zeros(env.action_shape, np.float32)
        self.action = self.painted

    def _apply_play(self, message: protocol.Play) -> None:
        self.playing = message.playing and not self.invalid

    def _apply_speed(self, message: protocol.Speed) -> None:
        self.speed = float(message.factor)

    def _apply_step(self, message: protocol.Step) -> None:
        self.playing = False
        self.advance()

    def _apply_reset(self, message: protocol.Reset) -> list[dict[str, Any]]:
        self._reset(message.seed)
        return [{"type": "reset"}]

    def _apply_hand(self, message: protocol.Hand) -> None:
        if message.tool != self.hand.tool:
            self.grip = None
        self.hand = message

    def _apply_paint(self, message: protocol.Paint) -> None:
        size = self.env.action_resolution
        rows, columns = np.array(message.cells).T
        if max(rows.max(), columns.max()) >= size:
            raise ValueError(f"cells must be rows and columns below {size}, got {int(max(rows.max(), columns.max()))}")
        painted = self.painted.copy()
        painted[message.directions[message.muscles], rows, columns] = message.value
        self.painted = painted
        if not self.playing:
            self.action = painted

    def _apply_clear(self, message: protocol.Clear) -> None:
        self.painted = np.zeros_like(self.painted)

    def _apply_wave(self, message: protocol.Wave) -> None:
        self.direction = message.direction

    def _apply_policy(self, message: protocol.Policy) -> list[dict[str, Any]]:
        if message.name is not None and message.name not in self.policies:
            raise ValueError(f"name must be one of {', '.join(self.policies) or 'none'}, got {message.name!r}")
        policy = None if message.name is None else self.policies[message.name]()
        self._use(self.own_resolution if policy is None else policy.resolution)
        if policy is not None:
            told = policy.description.get("environment", {})
            layout: Any = told.get("action_layout") or ("grid" if told.get("parity") == "reference" else "image")
            own = self.env.action_layout
            self._convert = lambda action: from_grid_indexing(to_grid_indexing(action, layout), own)
            attached = getattr(policy, "attached", None)
            policy = policy if attached is None else attached(self.env)
        self.policy, self.policy_name, self.memory = policy, message.name, None
        self.gate = np.zeros((2, 0, 0), np.float32)
        return [{"type": "policy", "name": message.name}]

    def _apply_colour(self, message: protocol.Colour) -> None:
        protocol.one_of("by", message.by, tuple(SCALES))
        self.colour = message.by

    def _apply_matter(self, message: protocol.Matter) -> None:
        spec, model, state = self.env.spec, self.env.model, self.env.env_state
        physics: dict[str, Any] = {}
        if message.stiffness != 1:
            physics |= {"mu": message.stiffness * spec.mu, "lam": message.stiffness * spec.lam}
        if message.yield_stress != 1:
            physics["yield_stress"] = message.yield_stress * spec.yield_stress
        if message.gravity != -spec.gravity[1]:
            physics["gravity"] = (spec.gravity[0], -message.gravity)
        values = physics_values(physics, 1, self.env.num_particles, state.centre[:, 0])
        check_stability(model, values)
        if physics != self.physics:
            self._note("other matter or gravity")
        self.physics = physics
        self.env.env_state = replace(state, physics=values)

    def _apply_save(self, message: protocol.Save) -> list[dict[str, Any]]:
        file, name = io.BytesIO(), f"{self.env.spec.name}-{int(self.env.env_state.steps[0])}"
        if message.what == "moment":
            self.moment = self.env.save()
            torch.save(self.moment, file)
            name += ".pt"
        else:
            if not self.actions:
                raise ValueError("actions must be those of at least one step, got none since the reset")
            np.savez_compressed(file, actions=self._sequence(), seed=self.seed, touched=np.array(self.touched, str))
            name += "-actions.npz"
        return [{"type": "file", "name": name, "content": base64.b64encode(file.getvalue()).decode()}]

    def _sequence(self) -> np.ndarray:
        """The actions since the reset (T, 2, R, R); those of several resolutions as executed, on the patch."""
        if len({action.shape for action in self.actions}) == 1:
            return np.stack(self.actions)
        patch = self.env.spec.patch
        return np.stack([bicubic(torch.from_numpy(action), patch).numpy() for action in self.actions])

    def _apply_back(self, message: protocol.Back) -> list[dict[str, Any]]:
        if self.moment is None:
            raise ValueError("there is no moment to go back to: save one first")
        self.observation = self.env.load(self.moment)
        self.terminated = self.truncated = self.success = self.invalid = False
        self.grip = None
        self._note("went back to a saved moment")
        return []

    def _apply_draw(self, message: protocol.Draw) -> list[dict[str, Any]]:
        options = {**self.options, message.what: message.picture()}
        env = TorchEnv(self.task, 1, **{**options, "resolution": self.env.action_resolution})
        old, self.env = self.env, env
        try:
            self._reset(self.seed)
        except ValueError:
            self.env = old
            raise
        self.options, self.moment = options, None
        self._apply_policy(protocol.Policy(self.policy_name))
        return [{"type": "hello", **self.describe()}, {"type": "reset"}]


def timed_steps(session: Session, due: int, budget: float) -> int:
    """Take up to ``due`` control steps within a ``budget`` of seconds, but at least one; returns their number."""
    start = time.perf_counter()
    taken = 0
    while taken < due and session.playing and (taken == 0 or time.perf_counter() - start < budget):
        session.advance()
        taken += 1
    return taken
