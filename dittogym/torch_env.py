"""Batched, differentiable environments: torch in, torch out."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dittogym import conditions as varied
from dittogym import core
from dittogym.action import ActionLayout, to_grid_layout
from dittogym.bodies.positions import InitialPositions, Particles, Seed, get_state, particle_counts, set_state
from dittogym.conditions import Conditions, Drawn, as_conditions
from dittogym.copies import to_device
from dittogym.core import EnvState, make_model
from dittogym.cuda_graph import Replayed
from dittogym.observation import SHAPE
from dittogym.physics import Physics, check_effect, merged, physics_values
from dittogym.render.frame import frame, png
from dittogym.render.recording import Recording, as_function, film
from dittogym.render.scene import QUANTITIES, Shot, describe, take
from dittogym.rewards import features_of
from dittogym.snapshots import Snapshot, check_snapshot, constants_of
from dittogym.spec import CONTROL_STEP, DT, TaskSpec
from dittogym.tasks import make_spec
from torchmpm import ParticleState, checks, tree
from torchmpm.checks import Segment
from torchmpm.tree import transforming

DTYPES = {"float32": torch.float32, "float64": torch.float64}
#: Simulations in which a task's functions are tried.
TRIALS = 3
RESET_OPTIONS = ("physics", "positions", "reset_mask")


class TorchEnv:
    """``num_envs`` independent simulations of one task, advanced together.

    An observation is an image (3, 64, 64) of the half metre around the robot, row 0 at the top: occupancy, and velocity
    to the right and upwards. It is an integer image without gradient, unless :meth:`step` is called with ``soft=True``.
    Rewards and states keep their autograd graph as long as gradients are enabled; :meth:`detach` cuts it. Elements of
    the batch are not reset automatically: one whose episode has ended goes on until :meth:`reset`. Element i of a batch
    that is reset with seed s equals a single environment that is reset with seed s + i.

    Before the first :meth:`reset` there is no state, and what needs one raises a RuntimeError.

    Args:
        task: A task name, ``"MODULE:NAME"``, or a :class:`dittogym.TaskSpec`.
        num_envs: B, the number of simulations.
        resolution: R, rows and columns of an action: ``"coarse"`` or ``"fine"``, which are numbers of the task, or a
            number from 1 to ``TaskSpec.patch``.
        particles: ``"full"``, the paper's number; ``"lite"``, about 2,000 evenly spread ones; the number of the robot's
            particles, to which that of an object is in proportion; or the numbers (robot, object).
        substeps: Substeps in a control step; ``None`` stands for as many as take 10 ms.
        dt: Duration of a substep, s. The task's damping per second stays the same.
        dtype: Precision of the physics: ``"float32"`` or ``"float64"``, or torch's dtypes.
        device: ``"cpu"`` or ``"cuda"``, or torch's devices.
        backend: Backend of the solver, ``"auto"``, ``"native"`` or ``"eager"``, see :class:`torchmpm.Solver`.
        action_layout: With ``"image"`` an action pixel (row, column) acts where that pixel of the observation looks;
            with ``"grid"``, as in the reference implementation, the indices are (x, y), to the right and upwards.
            ``None`` stands for ``"image"``.
        resample: Draw new particles at every reset, not only at a seeded one; no effect where
            ``TaskSpec.starts_alike``.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
        conditions: Ranges from which each episode draws its start, the constants of its matter and its disturbances, a
            :class:`dittogym.Conditions` or a mapping with its fields; ``None``: all are the task's own.
        task_options: ``body``, ``obstacles``, and options of the task such as ``target`` of SHAPE MATCH; see
            :func:`dittogym.make_spec`.

    Attributes:
        spec: The task, a :class:`dittogym.TaskSpec`.
        num_envs: B, the number of simulations.
        observation_shape: (3, 64, 64).
        action_shape: (2, R, R).
        action_resolution: R, rows and columns of an action.
        action_layout: ``"image"`` or ``"grid"``.
        dtype: Precision of the physics, as torch's dtype.
        device: Where it runs, as torch's device.
        conditions: The :class:`dittogym.Conditions`, or ``None``.
        model: The :class:`dittogym.core.Model`, for the functions of :mod:`dittogym.core`.

    Raises:
        ValueError: An argument is out of range, the matter is not stable, or the task's functions return what they must
            not.
        TypeError: The task has no such option, or its functions return something of another kind.

    Examples:
        >>> import dittogym, torch
        >>> env = dittogym.TorchEnv("run", num_envs=4, particles="lite")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape
        torch.Size([4, 3, 64, 64])
        >>> action = torch.zeros(4, *env.action_shape, requires_grad=True)
        >>> observation, reward, terminated, truncated, info = env.step(action)
        >>> reward.sum().backward()
        >>> action.grad.shape
        torch.Size([4, 2, 8, 8])
    """

    observation_shape = SHAPE

    def __init__(
        self,
        task: str | TaskSpec,
        num_envs: int = 1,
        resolution: str | int = "coarse",
        *,
        particles: Particles = "full",
        substeps: int | None = None,
        dt: float = DT,
        dtype: str | torch.dtype = "float32",
        device: str | torch.device = "cpu",
        backend: str = "auto",
        action_layout: ActionLayout | None = None,
        resample: bool = False,
        segment: Segment = "auto",
        conditions: Conditions | Mapping[str, Any] | None = None,
        **task_options: Any,
    ) -> None:
        self.spec = make_spec(task, **task_options)
        self.num_envs, substeps = checks.whole("num_envs", num_envs, 1), find_substeps(dt, substeps)
        checks.flag("resample", resample)
        if (name := str(dtype).removeprefix("torch.")) not in DTYPES:
            raise ValueError(f"dtype must be one of {tuple(DTYPES)}, got {name!r}")
        self.dtype, self.device = DTYPES[name], find_device(device)
        self.action_resolution = find_resolution(self.spec, resolution)
        self.action_shape = (2, self.action_resolution, self.action_resolution)
        if action_layout not in ("image", "grid", None):
            raise ValueError(f"action_layout must be 'image', 'grid' or None, got {action_layout!r}")
        self.action_layout: ActionLayout = action_layout or "image"
        counts = particle_counts(self.spec, particles)
        self.model = make_model(self.spec, counts, substeps, backend, segment, float(dt))
        random = self.model.full_size  # with full counts, both as in the reference
        self._initial_positions = InitialPositions(self.spec, counts, self.num_envs, random=random, resample=resample)
        self._like = torch.empty(self.num_envs, dtype=self.dtype, device=self.device)
        trial = InitialPositions(self.spec, counts, TRIALS, random=False, resample=False)
        positions = trial.draw(0, np.ones(TRIALS, bool), None, self._like).positions
        self._task_state = core.check_rewards(self.model, positions)
        self.device = self._like.device  # "cuda" with the number of the current device
        self._physics: Physics = {}
        self.conditions = as_conditions(conditions)
        if self.conditions is not None:
            varied.check_fit(self.conditions, self.spec, self.action_resolution)
            self._check_stability({})
        self._env_state: EnvState | None = None
        self._observation: Tensor | None = None
        self._actuation: Tensor | None = None
        # On a GPU: NaN if an action since the last reset was not finite, else 0.
        self._nonfinite_action = (
            None if self.device.type == "cpu" else torch.zeros((), dtype=self.dtype, device=self.device)
        )
        # What a user wrote, such as materials and reward functions, is called in every step.
        recordable = self.device.type == "cuda" and self.model.solver.kernels.unsupported(self.device) is None
        self._replayed = Replayed(core.simulate) if recordable and backend != "eager" else None

    def __repr__(self) -> str:
        return f"TorchEnv({self.spec.name!r}, {self.num_envs}, {self.action_resolution}, device={str(self.device)!r})"

    @property
    def num_particles(self) -> int:
        """N, the number of particles of all bodies."""
        return self.model.solver.num_particles

    @property
    def env_state(self) -> EnvState:
        """Everything that moves, for the functions of :mod:`dittogym.core`; assign a state to continue from it.

        An environment without conditions ignores those of an assigned state; one with conditions needs them.

        Raises:
            RuntimeError: The environment was not reset yet; or, on assignment, a transform of ``torch.func`` is active.
            TypeError: On assignment: the value is not a :class:`dittogym.core.EnvState`.
            ValueError: On assignment: the state has other sizes, another dtype or device, or lacks the task's state or
                conditions.
        """
        if self._env_state is None:
            raise RuntimeError("call reset() first: the environment has no state yet")
        return self._env_state

    @env_state.setter
    def env_state(self, value: EnvState) -> None:
        _refuse_transforms("TorchEnv.env_state")
        checks.instance("env_state", value, EnvState)
        theirs = value.particles
        kind = theirs.batch_size, theirs.num_particles, theirs.dtype, theirs.device
        own = self.num_envs, self.num_particles, self.dtype, self.device
        if kind != own:
            raise ValueError(f"env_state must be of {own} (simulations, particles, dtype, device), got {kind}")
        if missing := self._task_state - value.task_state.keys():
            raise ValueError(f"env_state must have the task state of this task, got none of {sorted(missing)}")
        self._env_state, self._actuation, self._observation = self._with_own_conditions("env_state", value), None, None

    def _with_own_conditions(self, name: str, state: EnvState) -> EnvState:
        """A state as this environment has it: without conditions where it has none."""
        if self.conditions is None:
            return replace(state, conditions={})
        own = varied.draw(self.conditions, state.steps, self.action_shape, self._like)
        sizes, expected = ({key: tuple(each.shape[1:]) for key, each in c.items()} for c in (state.conditions, own))
        if sizes != expected:
            raise ValueError(f"{name} must be of an environment with such conditions and actions, got another")
        return state

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """States of the random generators that draw positions, by element; assign them to restore a training.

        Each is that of a Mersenne Twister: ``key`` (624,) and ``pos`` ().

        Raises:
            RuntimeError: On assignment: an element has no generator yet, as it was not reset.
        """
        return {element: get_state(each) for element, each in self._initial_positions.generators.items()}

    @generators.setter
    def generators(self, states: Mapping[int, Mapping[str, Tensor]]) -> None:
        generators = self._initial_positions.generators
        if missing := [element for element in states if element not in generators]:
            raise RuntimeError(f"call reset() first: elements {missing} have no random generator yet")
        for element, state in states.items():
            set_state(generators[element], state)

    @property
    def state(self) -> ParticleState:
        """The particles of all simulations."""
        return self.env_state.particles

    def observation(self) -> Tensor:
        """Return the last observation (B, 3, 64, 64) uint8, drawn anew if a state was assigned; do not write to it."""
        if self._observation is None:
            self._observation = self._seen(core.observe(self.model, self.env_state), self.env_state)
        return self._observation

    def _seen(self, image: Tensor, state: EnvState) -> Tensor:
        """An image as the policy gets it."""
        if self.conditions is None or not self.conditions.hides_pixels:
            return image
        return varied.seen(state.conditions, state.steps, image)

    def detach(self) -> None:
        """Detach the state, including the constants of the last reset, from the autograd graph."""
        self._env_state = tree.detach(self.env_state)

    def save(self) -> Snapshot:
        """Return a snapshot of all simulations, which :meth:`load` restores; it keeps the autograd graph."""
        state, observation = tree.map(Tensor.clone, (self.env_state, self.observation()))
        return Snapshot(state, observation, self._constants)

    @functools.cached_property
    def _constants(self) -> dict[str, str]:
        return constants_of(self.model, self._like)

    def load(self, snapshot: Snapshot, mask: Any = None) -> Tensor:
        """Restore a snapshot; the simulation continues bit for bit as it did before.

        Not part of a snapshot are the positions and constants that the next reset uses, the count of a Gymnasium
        ``TimeLimit``, and the values of learned materials. The random numbers of conditions are part of it: elements
        that were loaded from the same simulation draw the same conditions until a seeded reset.

        Args:
            snapshot: A snapshot of this environment or of one with the same options. That of a single simulation is
                loaded into every element.
            mask: (B,) bool, true for the elements to load; ``None`` loads all.

        Returns:
            The observation (B, 3, 64, 64) uint8 of all elements.

        Raises:
            ValueError: The snapshot is of another task or variant, other numbers of particles, other substeps, another
                type, device or batch size, or lacks the conditions that this environment has; or ``mask`` is not (B,)
                bool.
            TypeError: ``snapshot`` is not a :class:`dittogym.snapshots.Snapshot`.
            RuntimeError: ``mask`` leaves elements out, and the environment was not reset yet.
        """
        checks.instance("snapshot", snapshot, Snapshot)
        chosen = find_mask("mask", mask, self.num_envs)
        check_snapshot(snapshot, self._constants, self.num_envs)
        index = torch.arange(self.num_envs, device=self.device) % len(snapshot.state.steps)
        given = self._with_own_conditions("snapshot", snapshot.state)
        state, observation = tree.map(lambda t: t[index], (given, snapshot.observation))
        actuation = None
        if not chosen.all():
            mine, where = self.env_state, to_device(chosen, self.device)
            physics = merged(self.spec, mine.physics, state.physics, where, self._like)
            state, mine = (replace(each, physics=physics) for each in (state, mine))
            state, observation = tree.where(where, (state, observation), (mine, self.observation()))
            actuation = self._actuation_without(where)
        self.env_state = state
        self._actuation, self._observation = actuation, observation.clone()
        return observation

    def _actuation_without(self, mask: Tensor) -> Tensor | None:
        """The actuation of the last step, which pictures show, zero where the mask (B,) holds."""
        return None if self._actuation is None else self._actuation.masked_fill(mask[:, None, None, None], 0.0)

    def reset(self, *, seed: Seed = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes. A reset that raises an error changes nothing.

        Args:
            seed: A number from 0 to 2**32 - 1 seeds element i with ``seed + i``, a sequence seeds it with ``seed[i]``;
                a seeded element draws new positions. Without a seed, or where ``seed[i]`` is ``None``, an element uses
                its last positions again, unless the environment was made with ``resample=True``. Conditions are drawn
                in either case; those of a seed are always the same.
            options: A mapping that may hold three entries. ``"positions"``: initial positions (N, 2) or (B, N, 2) in
                the world, m, robot first, used until the next seed, with ``resample`` until the next reset; particles
                keep their masses and undeformed volumes. ``"physics"``: constants of the matter, see ``given`` of
                :func:`dittogym.physics.physics_values`, used until a reset gives others; ``{}`` stands for the task's
                own. ``"reset_mask"``: (B,) bool, true for the elements to reset; as a NumPy array it does not have to
                be copied from a GPU. Gradients in positions and constants reach back to this reset; later resets use
                their values without gradients.

        Returns:
            The observation (B, 3, 64, 64) uint8 of all elements, and ``info`` with ``com``, ``split``, ``finite`` and,
            in tasks with an object, ``object_com``, as :meth:`step` returns them.

        Raises:
            ValueError: A seed is out of range; an option is unknown, has the wrong shape, puts particles outside the
                window, or makes matter too stiff for the substeps; the first reset leaves elements out; or, on a GPU, a
                step since the last reset got an action that is not finite.
            RuntimeError: A transform of ``torch.func`` or a trace of ``make_fx`` is active.
        """
        _refuse_transforms("TorchEnv.reset")
        options = reset_options(options)
        mask = find_mask("reset_mask", options.get("reset_mask"), self.num_envs)
        whole = bool(mask.all())
        if self._env_state is None and not whole:
            raise ValueError("reset_mask must reset all elements the first time")
        self._refuse_earlier_actions()
        physics = self._physics
        if (given := options.get("physics")) is not None:
            values = physics_values(given, self.num_particles, self._like)
            check_effect(self.spec, values)
            where = to_device(mask, self.device)
            physics = values if whole else merged(self.spec, physics, values, where, self._like)
            self._check_stability(physics)
        starts = self._initial_positions.draw(seed, mask, options.get("positions"), self._like)
        index = to_device(np.flatnonzero(mask), self.device)
        conditions, all_physics = self._draw_conditions(seed, physics)
        chosen = tree.map(Tensor.clone if whole else lambda t: t[index], (starts.positions, all_physics, conditions))
        fresh, observation = self._begin(*chosen, np.flatnonzero(mask) if starts.given else None)
        info = core.info_of(self.model, fresh, fresh.start)
        actuation = None
        if not whole:
            old, where = self.env_state, to_device(mask, self.device)
            now = features_of(old.particles, self.model.num_robot_particles)
            kept = replace(old, physics={}), self.observation(), core.info_of(self.model, old, now)
            others = replace(fresh, physics={}), observation, info
            fresh, observation, info = tree.map(lambda every, some: every.index_copy(0, index, some), kept, others)
            fresh = replace(fresh, physics=merged(self.spec, old.physics, all_physics, where, self._like))
            actuation = self._actuation_without(where)
        # Gradients in positions and constants reach back to this reset only, not to the next that uses them.
        if starts is not self._initial_positions:
            self._initial_positions = replace(starts, positions=starts.positions.detach().clone())
        self._physics = tree.map(lambda t: t.detach().clone(), physics)
        self._env_state, self._actuation, self._observation = fresh, actuation, observation
        return observation.clone(), tree.map(lambda t: t.detach().clone(), info)

    def _draw_conditions(self, seed: Seed, physics: Physics) -> tuple[Drawn, Physics]:
        """The conditions of the next episodes of all elements, and the constants of the matter in them."""
        if self.conditions is None:
            return {}, physics
        before = None if self._env_state is None else self._env_state.conditions
        seeds = varied.next_seeds(self._initial_positions.seeds(seed), before, self.device)
        drawn = varied.draw(self.conditions, seeds, self.action_shape, self._like)
        return drawn, varied.physics_of(self.conditions, drawn, self.spec, physics, self._like)

    def _check_stability(self, physics: Physics) -> None:
        """Refuse matter that needs shorter substeps, as it is or with factors at the ends of the conditions."""
        core.check_stability(self.model, physics)
        if self.conditions is None:
            return
        try:
            for end in (0, 1):  # a small mu is unstable with a negative lam
                extreme = varied.extreme_physics(self.conditions, end, self.spec, physics, self._like)
                core.check_stability(self.model, extreme)
        except ValueError as error:
            changed = {name: getattr(self.conditions, name) for name in self.conditions.changes(self.spec)}
            raise ValueError(f"conditions must leave the matter stable, got {changed}, with which {error}") from error

    def _begin(
        self, positions: Tensor, physics: Physics, conditions: Drawn, elements: np.ndarray | None
    ) -> tuple[EnvState, Tensor]:
        """State and observation of new episodes; positions of ``elements`` that a user gave may be moved too far."""
        if self.conditions is None:
            return core.reset(self.model, positions, physics)
        velocity = None
        if self.conditions.moves_start:
            positions = varied.start(conditions, positions, self.model.num_robot_particles)
            if elements is not None:
                self._initial_positions.check_inside(positions, elements)
            velocity = conditions["velocity"]
        state, image = core.reset(self.model, positions, physics, velocity)
        state = replace(state, conditions=conditions)
        return state, self._seen(image, state)

    def step(self, action: Tensor, *, soft: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance every simulation by one control step.

        On a GPU this returns before the step is done, and does not wait for what only the device knows: an action that
        is not finite ends its episode with the reward :data:`dittogym.core.FAILURE_REWARD`, and the next reset, of any
        elements, raises the error. Without gradients, the third step is recorded as a CUDA graph, which later steps
        replay; the task's reward function is not part of it.

        Args:
            action: (B, 2, R, R) floating point, muscle stress as a fraction of the task's largest, from -1, expansion,
                to 1, contraction; ``[:, 0]`` along material x and ``[:, 1]`` along material y. Values beyond [-1, 1]
                saturate after the interpolation to the grid.
            soft: Return the smooth observation and reward, for gradients; ``info["true_reward"]`` is then the reward.

        Returns:
            Five values. The observation (B, 3, 64, 64) uint8; with ``soft`` in floating point, from 0 to 255 and
            differentiable. The reward (B,). Whether the task ended the episode, ``terminated`` (B,) bool. Whether the
            horizon is reached, ``truncated`` (B,) bool. And ``info`` with a leading B throughout: ``reward_terms``,
            the weighted terms of the reward by name, (B,) each; ``com`` (B, 2), the robot's centre of mass, m;
            ``split`` (B,), its radius of gyration, m; ``finite`` (B,) bool, false if a number is not finite, matter is
            :data:`dittogym.core.FAR` away, or all of the robot is outside the window; ``object_com`` (B, 2), m, in
            tasks with an object; ``is_success`` (B,) bool in tasks that define it; and the task's own quantities.

        Raises:
            ValueError: The action has the wrong shape or type or, on the CPU, is not finite.
            RuntimeError: The environment was not reset yet, or this is called under a transform of ``torch.func`` or in
                a backward pass.
        """
        _refuse_transforms("TorchEnv.step")
        if torch._C._current_graph_task_id() != -1:
            raise RuntimeError(
                "TorchEnv.step must not be called in a backward pass, as torch.utils.checkpoint does to repeat a step "
                "from the state after it: use dittogym.core.step with its model, which keeps nothing"
            )
        checks.flag("soft", soft)
        action, state = self._checked(action), self.env_state
        if self.conditions is not None:
            drawn = tree.without_inference(state.conditions)
            action, drawn = varied.act(self.conditions, drawn, state.steps, action)
            state = replace(state, conditions=drawn)
        action = to_grid_layout(action, self.action_layout)
        simulate = core.simulate if self._replayed is None or torch.is_grad_enabled() else self._replayed
        result = core.judge(self.model, simulate(self.model, state, action), soft=soft)
        info: dict[str, Any] = {"reward_terms": dict(result.terms), **result.info}
        info |= {} if result.success is None else {"is_success": result.success}
        info |= {"true_reward": result.true_reward} if soft else {}
        image, smooth = self._seen(result.observation, result.state), result.soft_observation
        self._observation = image.clone()  # what is returned belongs to the caller
        self._env_state, self._actuation = result.state, result.actuation.detach()
        observation = image if smooth is None else self._seen(smooth, result.state)
        return observation, result.reward, result.terminated, result.state.steps >= self.spec.horizon, info

    def _checked(self, action: Tensor) -> Tensor:
        """The action in the type and on the device of the simulations, if it is finite and of the right shape."""
        if not isinstance(action, Tensor) or not action.is_floating_point():
            kind = action.dtype if isinstance(action, Tensor) else type(action).__name__
            hint = "" if isinstance(action, Tensor) else "; torch.as_tensor(action) makes a tensor of an array"
            raise ValueError(f"action must be a floating point tensor, got {kind}{hint}")
        if action.layout is not torch.strided or action.is_meta:
            raise ValueError(f"action must hold dense numbers, got a tensor of {action.layout} on {action.device}")
        if tuple(action.shape) != (shape := (self.num_envs, *self.action_shape)):
            hint = "the first number is that of the simulations, num_envs"
            if tuple(action.shape[-3:]) != self.action_shape:
                hint = "the option resolution of the environment sets its last two numbers"
            raise ValueError(f"action must have shape {shape}, got {tuple(action.shape)}; {hint}")
        action = action.to(self.device, self.dtype)
        if self._nonfinite_action is not None:
            self._nonfinite_action = self._nonfinite_action + (action.detach() * 0.0).sum()
        # A sum that is finite spares the test of every entry; one of finite entries may overflow.
        elif not math.isfinite(float(action.detach().sum())) and (wrong := int((~torch.isfinite(action)).sum())):
            raise ValueError(f"action must be finite, got {wrong} entries that are NaN or infinite")
        return action

    def _refuse_earlier_actions(self) -> None:
        """Raise the error that steps on a GPU would have had to wait for."""
        if self._nonfinite_action is not None and math.isnan(float(self._nonfinite_action)):
            self._nonfinite_action = torch.zeros_like(self._nonfinite_action)
            raise ValueError("action must be finite, got NaN or infinite entries in a step since the last reset")

    def soft_observation(self) -> Tensor:
        """Return the smooth observation (B, 3, 64, 64) of the present state, from 0 to 255 in floating point.

        See :func:`dittogym.core.soft_observation`.
        """
        return self._seen(core.soft_observation(self.model, self.env_state), self.env_state)

    def shot(self, index: int = 0, quantities: Sequence[str] = QUANTITIES) -> Shot:
        """Return what pictures show of the present moment of one simulation.

        Args:
            index: Element of the batch.
            quantities: Which quantities of the particles to compute: any of ``"muscle"``, ``"deformation"`` and
                ``"speed"``, see :class:`dittogym.render.scene.Shot`.

        Raises:
            IndexError: There is no such element.
            KeyError: There is no such quantity.
        """
        return take(self.model, self.env_state, index, self._actuation, quantities)

    def render(self, index: int = 0, *, muscles: bool = True, size: int = 512, zoom: float | None = None) -> np.ndarray:
        """Draw one simulation.

        Args:
            index: Element of the batch.
            muscles: Colour the robot by the actuation of the last step: contraction red, expansion blue.
            size: S, pixels per side, from 16 to 8192.
            zoom: The picture shows ``1 / zoom`` metres, so that 1 is the whole window, and at most 20 m; ``None``
                stands for 0.56 m, a little more than the robot observes.

        Returns:
            A picture (S, S, 3) uint8 in RGB.

        Raises:
            IndexError: There is no such element.
            ValueError: ``size`` or ``zoom`` is out of range, or ``muscles`` is not True or False.
        """
        return frame(describe(self.model), self.shot(index, ("muscle",)), size, zoom, muscles)

    def film(
        self, policy: Any, path: str | os.PathLike[str] | None = None, *, seed: Seed = 0, index: int = 0, **options: Any
    ) -> Recording:
        """Reset the environment, play an episode, and record one of the simulations until its episode ends.

        Args:
            policy: A function from observations, a NumPy array (B, 3, 64, 64) uint8, to actions (B, 2, R, R); or an
                object with the method ``predict(observation, state)`` of stable-baselines3, which returns actions and
                the next state, such as :func:`cfp.load` returns.
            path: A film (``.mp4``, ``.gif``, ``.webp``), a filmstrip (``.png``) or a replay (``.html``) to write;
                ``None`` writes nothing.
            seed: Seed of the reset and, unless it is ``None``, of the policy's noise.
            index: Element of the batch.
            options: ``max_steps``, after which the recording ends, and options of the file, such as ``size``, ``speed``
                and ``zoom``, see :class:`dittogym.render.recording.FilmOptions`.

        Returns:
            The recording, from which further films can be saved. A notebook shows it.

        Raises:
            ValueError: An option is out of range, the file does not take it, ``path`` has another suffix, the policy
                returns no actions, or it was trained with another ``action_layout``.
            TypeError: The policy is neither a function nor has a method ``predict``, there is no such option, or
                options of a file are given without ``path``.
            IndexError: There is no such element.
            dittogym.render.film.VideoUnavailable: An MP4 without the extra ``video``, or with an ffmpeg that fails.

        Examples:
            >>> import dittogym, numpy as np
            >>> env = dittogym.TorchEnv("run", particles=300, substeps=10)
            >>> recording = env.film(lambda observation: np.zeros((1, 2, 8, 8)), seed=0, max_steps=5)
            >>> len(recording.rewards)  # recording.save("run.webp") writes a film
            5
        """
        return film(self, as_function(policy, self), path, seed, index, **options)

    def _repr_png_(self) -> bytes | None:
        """What a notebook shows once there is a state: all simulations, row by row."""
        if self._env_state is None:
            return None
        columns = math.ceil(math.sqrt(self.num_envs))
        size, rows = max(16, min(512, 1024 // columns)), math.ceil(self.num_envs / columns)
        sheet = np.full((rows, size + 2, columns, size + 2, 3), 255, np.uint8)  # with a white line between them
        for index in range(self.num_envs):
            row, column = divmod(index, columns)
            sheet[row, :size, column, :size] = self.render(index, size=size)
        return png(sheet.reshape(rows * (size + 2), columns * (size + 2), 3))


def find_resolution(spec: TaskSpec, resolution: str | int, name: str = "resolution") -> int:
    """Action cells per axis; ``name`` is that of the argument."""
    named = {"coarse": spec.coarse, "fine": spec.fine}
    size: Any = named.get(resolution) if isinstance(resolution, str) else resolution
    if isinstance(size, bool) or not isinstance(size, Integral) or not 1 <= int(size) <= spec.patch:
        raise ValueError(f"{name} must be 'coarse', 'fine' or 1 to {spec.patch}, got {resolution!r}")
    return int(size)


def find_substeps(dt: float, substeps: int | None) -> int:
    """Substeps of ``dt`` s in a control step; ``None`` stands for as many as take :data:`CONTROL_STEP`."""
    checks.number("dt", dt, above=0.0)
    if substeps is not None:
        return checks.whole("substeps", substeps, 1)
    ratio = CONTROL_STEP / dt
    count = round(ratio) if math.isfinite(ratio) else 0
    if not math.isclose(count * dt, CONTROL_STEP):
        raise ValueError(f"dt must divide the control step of {CONTROL_STEP} s if substeps is not given, got {dt}")
    return count


def find_mask(name: str, given: Any, num_envs: int) -> np.ndarray:
    """A mask of elements, (B,) bool, of its own memory on the host; ``None`` stands for all."""
    if given is None:
        return np.ones(num_envs, dtype=bool)
    try:
        mask = np.array(given.detach().cpu().numpy() if isinstance(given, Tensor) else given)
    except (TypeError, ValueError, RuntimeError):
        mask = None
    if mask is None or mask.dtype != bool or mask.shape != (num_envs,):
        raise ValueError(f"{name} must be bool of shape ({num_envs},), got {given!r}")
    return mask


def find_device(device: str | torch.device) -> torch.device:
    """The device that the option ``device`` names."""
    try:
        found = torch.device(device)
    except (TypeError, RuntimeError):
        found = None
    if found is None or found.type not in ("cpu", "cuda"):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {device!r}")
    count = torch.cuda.device_count() if found.type == "cuda" else 1
    if (found.index or 0) >= count:
        raise ValueError(f"device must be available, got {device!r}, but torch finds {count} of this kind")
    return found


def reset_options(options: Any) -> dict[str, Any]:
    """The options of a reset; the allowed names are :data:`RESET_OPTIONS`."""
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a mapping that may hold {', '.join(RESET_OPTIONS)}, got {options!r}")
    if unknown := options.keys() - set(RESET_OPTIONS):
        raise ValueError(f"options may hold {', '.join(RESET_OPTIONS)}, got {', '.join(map(repr, unknown))}")
    return dict(options)


def _refuse_transforms(name: str) -> None:
    """Refuse to keep tensors that end with the transform or trace that they were made in."""
    if transforming():
        raise RuntimeError(
            f"{name} must not be used under a transform of torch.func or a trace of make_fx, whose tensors the "
            "environment would keep: use dittogym.core.reset and dittogym.core.step with its model, which keep nothing"
        )
