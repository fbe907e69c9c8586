"""A simulation that is played with, and what messages from the page do to it."""

from __future__ import annotations

import base64
import inspect
import io
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from cfp.play import protocol
from cfp.play.hand import Direction, Grip, press, reach, wave
from dittogym.action import bicubic, from_grid_layout, patch_corner, to_grid_layout, trained_layout
from dittogym.bodies.drawings import with_body
from dittogym.bodies.positions import probe
from dittogym.bodies.shapes import Figure
from dittogym.core import check_stability
from dittogym.geometry import NODES, centre_in_window
from dittogym.physics import check_effect, physics_values
from dittogym.render.recording import Recording, attached
from dittogym.render.scene import Shot, describe
from dittogym.snapshots import Snapshot
from dittogym.spec import BodySpec
from dittogym.tasks import TASKS, headline, make_spec, task_name
from dittogym.torch_env import TorchEnv

#: Names of the bits of a frame's flags.
FLAGS = ("playing", "terminated", "truncated", "success", "invalid")
#: Episodes that are shorter than this start in slow motion, s.
SHORT = 2.0
#: Control steps that are kept for files, the first ones after a reset.
LONGEST = 3000
CHANGED_MATTER = "other matter or gravity"
#: Channels of an action image, by the name of their muscles.
CHANNELS = {"both": slice(0, 2), "horizontal": slice(0, 1), "vertical": slice(1, 2)}
#: Loads a policy with ``predict(observation, memory, episode_start, deterministic)``, as stable-baselines3 has it, and
#: the ``resolution`` of its actions.
LoadPolicy = Callable[[], Any]
Answers = list[dict[str, Any]]


@dataclass
class History:
    """What has happened since the last reset."""

    seed: int  # Of the particles
    recording: Recording
    touched: list[str]  # Changes that replaying the actions does not reproduce
    actions: list[np.ndarray] = field(default_factory=list)
    total: float = 0.0  # Return
    terminated: bool = False
    truncated: bool = False
    success: bool = False
    invalid: bool = False
    memory: Any = None  # Of the policy

    def copy(self) -> History:
        """The same, with lists that do not grow with those of an episode that goes on."""
        shots, rewards = self.recording.shots.copy(), self.recording.rewards.copy()
        recording = replace(self.recording, shots=shots, rewards=rewards)
        return replace(self, recording=recording, touched=self.touched.copy(), actions=self.actions.copy())

    def note(self, change: str) -> None:
        """Remember a change that replaying the actions does not reproduce."""
        if change not in self.touched:
            self.touched.append(change)


class Session:
    """One robot to play with.

    Args:
        task: A task name or ``"MODULE:NAME"``.
        policies: What loads the policies, by the names they have on the page.
        policy: Name of the one that acts at first.
        seed: Of the particles.
        options: Arguments of :class:`dittogym.TorchEnv` but ``num_envs`` and ``action_layout``.

    Raises:
        ValueError: An option is out of range.
        TypeError: The task has no such option.
    """

    history: History
    shot: Shot
    grip: Grip | None
    direction: Direction | None = None
    policy: Any = None
    policy_name: str | None = None
    saved: tuple[Snapshot, History] | None = None

    def __init__(
        self,
        task: str,
        policies: Mapping[str, LoadPolicy] | None = None,
        policy: str | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        self.task, self.seed, self.options = task, seed, dict(action_layout="image", **options)  # that of the page
        self.policies, self.env = dict(policies or {}), TorchEnv(task, 1, **self.options)
        task_options = self.options.keys() & inspect.signature(TASKS[task_name(task)]).parameters.keys()
        #: The task with its own robot.
        self.own_spec = make_spec(task, **{name: self.options[name] for name in task_options})
        self.own_resolution = self.env.action_resolution
        self.control_step = self.env.model.substeps * self.env.model.solver.dt
        self.playing, self.speed = True, 0.1 if self.env.spec.horizon * self.control_step < SHORT else 1.0
        self.colour = "deformation" if policy is None else "muscle"
        self.hand = protocol.Hand(None)
        self.physics: dict[str, Any] = {}
        self.terms: Mapping[str, Tensor] = {}  # of the reward, as they were last
        self.num_frames = self.num_steps = 0
        self._reset(seed)
        self._choose_policy(policy)

    def describe(self) -> dict[str, Any]:
        """What the page needs to know about the task, as JSON values."""
        spec, known = self.env.spec, inspect.signature(TASKS[task_name(self.task)]).parameters
        boxes = [(*body.shape.corner, *np.add(body.shape.corner, body.shape.size).tolist()) for body in spec.bodies]
        about = {
            "title": headline(self.task)[0],
            "horizon": spec.horizon,
            "follow": spec.window.moves,
            "boxes": boxes,
            "patch": spec.patch / NODES,
            "reach": reach(spec.patch / NODES, self.env.action_resolution),
            "matter": {"mu": spec.mu, "yield_stress": spec.yield_stress, "gravity": -spec.gravity[1]},
            "draws": ["body", *(["target"] if "target" in known else [])],
            "outline": outline(self.own_spec.robot),
            "policies": list(self.policies),
            "policy": self.policy_name,
            "flags": FLAGS,
            "speed": self.speed,
            "colour": self.colour,
            "terms": list(self.terms),
            "saved": self.saved is not None,
        }
        return describe(self.env.model).as_json() | about

    def apply(self, message: protocol.Message) -> Answers:
        """Do what a message says, and return what to answer, as JSON values.

        Raises:
            ValueError: It cannot be done, and nothing has changed.
        """
        match message:
            case protocol.Play():
                self.playing = message.playing and not self.history.invalid
            case protocol.Speed():
                self.speed = message.factor
            case protocol.Step():
                self.playing = False
                self.advance()
            case protocol.Reset():
                self._reset(self.seed if message.seed is None else message.seed)
                return [{"type": "reset"}]
            case protocol.Hand():
                self.grip = self.grip if message.tool == self.hand.tool else None
                self.hand = message
                self._take_hold()  # of what is under the pointer now, even if the next step comes later
            case protocol.Paint() | protocol.Clear():
                self._paint(message)
            case protocol.Wave():
                self.direction = message.direction
            case protocol.Policy():
                return self._choose_policy(message.name)
            case protocol.Colour():
                self.colour = message.by
            case protocol.Matter():
                self._change_matter(message)
            case protocol.Save():
                return self._save(message.what)
            case protocol.Back():
                return self._go_back()
            case protocol.Draw():
                return self._draw(message)
        return []

    def advance(self) -> None:
        """Take one control step, unless the state is no longer valid.

        Raises:
            Exception: What a task or a policy of the user's does wrong; time is stopped.
        """
        history = self.history
        if history.invalid:
            return
        playing, self.playing = self.playing, False  # until it has worked
        self.action = self._next_action()
        self._pull()
        with torch.no_grad():
            self.observation, reward, terminated, truncated, info = self.env.step(torch.from_numpy(self.action)[None])
        self.num_steps, self.terms = self.num_steps + 1, info["reward_terms"]
        earned = 0.0 if history.terminated or history.truncated else float(reward[0])
        history.total += earned
        self.rows.append([history.total, *(float(term[0]) for term in self.terms.values())])
        history.terminated |= bool(terminated[0])
        history.truncated |= bool(truncated[0])
        history.success = "is_success" in info and bool(info["is_success"][0])
        history.invalid = not bool(info["finite"][0])
        self.playing, self.shot = playing and not history.invalid, self.env.shot()
        if len(history.actions) == LONGEST:
            return history.note(f"only the first {LONGEST} steps are kept")
        history.actions.append(self.action)
        history.recording.shots.append(self.shot)
        history.recording.rewards.append(earned)
        history.recording.success = history.success if "is_success" in info else None

    def frame(self, rate: float) -> bytes:
        """The present moment for the page, at ``rate`` simulated seconds per second; see :data:`protocol.HEAD`."""
        self.num_frames, shot = self.num_frames + 1, self.shot
        flags = sum(getattr(self if name == "playing" else self.history, name) << bit for bit, name in enumerate(FLAGS))
        rows = np.array(self.rows, np.float32).reshape(len(self.rows), 1 + len(self.terms))
        self.rows.clear()
        codes = np.full(len(shot.x), 127, np.uint8)
        own = shot.values.get(self.colour, codes)
        codes[: len(own)] = own
        observation, action = self.observation[0].cpu().numpy(), (127 * self.action).round().astype(np.int8)
        gate = (255 * np.clip(self.gate, 0, 1)).round().astype(np.uint8)
        counters = (self.num_frames, shot.step, self.hand.id, flags)
        sizes = (*rows.shape, len(shot.x), action.shape[-1], gate.shape[-1])
        head = protocol.HEAD.pack(*counters, *sizes, *shot.centre, *self._corner(), self.history.total, rate)
        arrays = (rows, shot.x, codes, observation, action, gate)
        return b"".join((head, *(array.tobytes() for array in arrays)))

    def _reset(self, seed: int) -> None:
        self.observation, self.seed = self.env.reset(seed=seed, options={"physics": self.physics})[0], seed
        self.grip = None
        self.rows: list[list[float]] = []
        self.painted = self.action = np.zeros(self.env.action_shape, np.float32)
        self.gate = np.zeros((2, 0, 0), np.float32)
        self.shot = self.env.shot()
        drawn = [name for name, value in self.options.items() if isinstance(value, np.ndarray | Figure)]
        touched = [CHANGED_MATTER] * bool(self.physics) + [f"a drawn {name}" for name in drawn]
        self.history = History(seed, Recording(describe(self.env.model), [self.shot]), touched)

    def _next_action(self) -> np.ndarray:
        """What policy, paint, waves and hand add up to, float32 (2, R, R) in [-1, 1]."""
        size, action = self.env.action_resolution, np.asarray(self.painted)
        if self.policy is not None:
            action = action + self._decide()
        if self.direction is not None:
            action = action + wave(self.direction, int(self.env.env_state.steps[0]), size)
        if self.hand.tool in ("contract", "expand"):
            point, sign = np.array((self.hand.x, self.hand.y)), 1.0 if self.hand.tool == "contract" else -1.0
            action = action + sign * press(point, self._corner(), self.env.spec.patch / NODES, size)
        return np.ascontiguousarray(np.clip(action, -1.0, 1.0), np.float32)

    def _decide(self) -> np.ndarray:
        """The policy's action (2, R, R); it may tell the gate, too."""
        policy, images = self.policy, self.observation.cpu().numpy()
        deterministic = getattr(policy, "deterministic_by_default", False)
        if hasattr(policy, "predict_with_gate"):
            chosen, gate = policy.predict_with_gate(images, deterministic)
            self.gate = self.gate if gate is None else self._as_image(gate)[0]
        else:
            history, start = self.history, np.array([not self.history.actions])
            chosen, history.memory = policy.predict(images, history.memory, start, deterministic)
        return self._as_image(chosen)[0]

    def _as_image(self, array: np.ndarray) -> np.ndarray:
        """What a policy returns (B, 2, R, R), oriented as the page shows it."""
        layout = trained_layout(self.policy) or "image"
        return from_grid_layout(to_grid_layout(torch.as_tensor(array), layout), "image").numpy()

    def _take_hold(self) -> None:
        """Let the hand take hold of matter that it is to pull at, unless it holds some."""
        if self.hand.tool == "pull" and self.grip is None:
            point, num_robot = self._point(), self.env.model.num_robot_particles
            self.grip = Grip.take(self.env.env_state.particles, point, num_robot)

    def _pull(self) -> None:
        """Let the hand pull at what it holds, or at what has come to it."""
        self._take_hold()
        if self.grip is not None:
            state = self.env.env_state
            pulled = self.grip.pull(state.particles, self._point(), self.control_step)
            self.env.env_state = replace(state, particles=pulled)
            self.history.note("pulled by hand")

    def _point(self) -> Tensor:
        """Where the hand is, (2,), m."""
        return self.env.env_state.centre.new_tensor((self.hand.x, self.hand.y))

    def _corner(self) -> np.ndarray:
        """Lower left corner (2,) of the action image in the world, m."""
        state, spec = self.env.env_state, self.env.spec
        corner = patch_corner(centre_in_window(spec.patch_centre, state.centre, state.origin), spec.patch, NODES)
        return (state.origin[0] + corner[0] / NODES).cpu().double().numpy()

    def _paint(self, message: protocol.Paint | protocol.Clear) -> None:
        painted = np.zeros_like(self.painted) if isinstance(message, protocol.Clear) else self.painted.copy()
        if isinstance(message, protocol.Paint):
            size, (rows, columns) = self.env.action_resolution, np.array(message.cells).T
            if (largest := int(np.max(message.cells))) >= size:
                raise ValueError(f"cells must be rows and columns below {size}, got {largest}")
            painted[CHANNELS[message.muscles], rows, columns] = message.value
        self.painted = painted
        self.action = self.action if self.playing else painted

    def _choose_policy(self, name: str | None) -> Answers:
        if name is not None and name not in self.policies:
            raise ValueError(f"name must be one of {', '.join(self.policies) or 'none'}, got {name!r}")
        policy: Any = None if name is None else self.policies[name]()
        env, resolution = self.env, self.own_resolution if policy is None else policy.resolution
        if resolution != env.action_resolution:
            env = TorchEnv(self.task, 1, **{**self.options, "resolution": resolution})
            env.reset(seed=self.seed, options={"physics": self.physics})
            env.env_state = self.env.env_state
        self.policy = attached(policy, env)
        if env is not self.env:
            self.env = env
            self.action = self.painted = np.zeros(env.action_shape, np.float32)
        self.policy_name, self.gate = name, np.zeros((2, 0, 0), np.float32)
        for history in (self.history, *(self.saved or ())[1:]):
            history.memory = None  # it belongs to the policy before
        return [{"type": "policy", "name": name, "reach": reach(self.env.spec.patch / NODES, resolution)}]

    def _change_matter(self, message: protocol.Matter) -> None:
        spec, state = self.env.spec, self.env.env_state
        physics: dict[str, Any] = {}
        if message.stiffness != 1:
            physics |= {"mu": message.stiffness * spec.mu, "lam": message.stiffness * spec.lam}
        if message.yield_stress != 1:
            physics["yield_stress"] = message.yield_stress * spec.yield_stress
        if message.gravity != -spec.gravity[1]:
            physics["gravity"] = (spec.gravity[0], -message.gravity)
        values = physics_values(physics, self.env.num_particles, state.centre[:, 0])
        check_effect(spec, values)
        check_stability(self.env.model, values)
        if physics != self.physics:
            self.history.note(CHANGED_MATTER)
        self.physics, self.env.env_state = physics, replace(state, physics=values)

    def _save(self, what: str) -> Answers:
        file, name, history = io.BytesIO(), f"{self.env.spec.name}-{self.shot.step}", self.history
        if what == "moment":
            name, self.saved = f"{name}.pt", (self.env.save(), history.copy())
            torch.save(self.saved[0], file)
        elif not history.actions:
            raise ValueError(f"{what} must be of at least one step, got none since the reset")
        elif what == "actions":
            name, actions = f"{name}-actions.npz", history.actions
            if len({action.shape for action in actions}) > 1:  # as executed, on the patch
                actions = [bicubic(torch.from_numpy(each), self.env.spec.patch).numpy() for each in actions]
            touched = np.array(history.touched, str)
            np.savez_compressed(file, actions=np.stack(actions), seed=history.seed, touched=touched)
        else:
            name += ".html"
            file.write(history.recording.page().encode())
        return [{"type": "file", "name": name, "content": base64.b64encode(file.getvalue()).decode()}]

    def _go_back(self) -> Answers:
        if self.saved is None:
            raise ValueError("there is no moment to go back to: save one first")
        snapshot, history = self.saved
        self.history, self.seed = history.copy(), history.seed  # what came after it did not happen
        self.rows.clear()
        self.observation, state = self.env.load(snapshot), self.env.env_state
        values, then = physics_values(self.physics, self.env.num_particles, state.centre[:, 0]), state.physics
        self.env.env_state = replace(state, physics=values)
        self.grip, self.shot = None, self.env.shot()
        if values.keys() != then.keys() or not all(torch.equal(values[name], then[name]) for name in values):
            self.history.note(CHANGED_MATTER)
        return [{"type": "reset"}]

    def _draw(self, message: protocol.Draw) -> Answers:
        size = round(len(message.pixels) ** 0.5)
        if size**2 != len(message.pixels):
            raise ValueError(f"pixels must be those of a square, got {len(message.pixels)}")
        picture = np.frombuffer(message.pixels, np.uint8).reshape(size, size)
        old = vars(self).copy()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                drawing = picture if message.scale == 1 else self._scaled(picture, message.scale)
                self.options = {**self.options, message.what: drawing}
                self.env = TorchEnv(self.task, 1, **{**self.options, "resolution": self.env.action_resolution})
                self._reset(self.seed)
                self._choose_policy(self.policy_name)
            except Exception:  # a task or a policy of the user's may raise anything
                vars(self).update(old)
                raise
        self.saved = None
        notices = ({"type": "notice", "message": str(warning.message)} for warning in caught)
        return [{"type": "hello", **self.describe()}, {"type": "reset"}, *notices]

    def _scaled(self, picture: np.ndarray, scale: float) -> Figure:
        """A drawn robot that is smaller than the task's own, in its place."""
        whole = with_body(self.own_spec, picture).robot.shape
        assert isinstance(whole, Figure)
        left = whole.corner[0] + 0.5 * (1 - scale) * whole.size[0]
        return replace(whole, pixel=scale * whole.pixel, corner=(left, whole.corner[1]))


def outline(body: BodySpec) -> list[list[list[float]]]:
    """Closed lines of points (x, y) around a body and its holes; its longer side has 100 units, its middle is at 0."""
    points = probe(body)
    size = np.ptp(points, axis=0)
    columns, rows = (10 + (points - points.min(0)) * (100 / size.max())).astype(int).T
    mask = np.zeros((121, 121), np.uint8)
    mask[rows, columns] = 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))  # there are gaps between the points
    lines, _ = cv2.findContours(closed, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return [(line[:, 0] - 10 - 50 * size / size.max()).round(1).tolist() for line in lines]
