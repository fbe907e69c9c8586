"""Batched, differentiable environments: torch in, torch out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dittogym import arguments, core
from dittogym.action import ActionIndexing, default_indexing, to_grid_indexing
from dittogym.bodies.positions import InitialPositions, Particles, Seed, get_state, particle_counts, set_state
from dittogym.model import EnvState, Parity, Snapshot, check_snapshot, make_model, next_physics
from dittogym.observation.image import SHAPE
from dittogym.physics import Physics, merged
from dittogym.render.frame import frame, png
from dittogym.render.recording import Recording, as_function, film
from dittogym.render.scene import QUANTITIES, Shot, describe, take
from dittogym.spec import DT, TaskSpec
from dittogym.tasks import make_spec
from torchmpm import ParticleState, checks, tree
from torchmpm.rollout import Segment, check_repetition


class TorchEnv:
    """``num_envs`` independent simulations of one task, advanced together.

    Rewards and states keep their autograd graph as long as gradients are enabled; :meth:`detach` cuts it. The
    observation is an integer image without gradient, unless :meth:`step` is called with ``soft=True``. Elements are not
    reset automatically: one that has ended goes on until :meth:`reset`. Element i of a batch reset with seed s is the
    single environment reset with seed s + i.

    Args:
        task: A task name or a :class:`dittogym.spec.TaskSpec`.
        num_envs: B, the number of simulations.
        resolution: ``"coarse"``, ``"fine"``, or R itself, at most the task's patch.
        particles: ``"full"``, ``"lite"`` (2,000, evenly spread), the robot's number, or (robot, object).
        substeps: Substeps in a control step; ``None``: as many as take 10 ms.
        dt: Duration of a substep, s. The task's damping per second stays the same.
        dtype: ``"float32"`` or ``"float64"``, by name or as torch's.
        device: Where it runs.
        backend: Of the solver, see :class:`torchmpm.Solver`.
        action_layout: ``"image"``: action pixel (row, column) acts where that pixel of the observation looks;
            ``"grid"``: (x, y), as in the reference implementation. ``None``: as ``parity`` has it.
        parity: ``"clean"``, or ``"reference"`` to bring back the reference's stale observation, action centre and
            ``TaskSpec.stale_memory`` after a reset, and at every particle count its random positions, unit particle
            volume and pixel raster.
        resample: Draw new particles at every reset, not only at a seeded one.
        deterministic: Refuse what does not repeat bit by bit: CUDA.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
        task_options: ``body``, ``obstacles``, and options of the task such as ``target`` of SHAPE MATCH; see
            :func:`dittogym.make_spec`.

    Raises:
        ValueError: An argument is out of range.
        TypeError: The task has no such option.

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
        action_layout: ActionIndexing | None = None,
        parity: Parity = "clean",
        resample: bool = False,
        deterministic: bool = False,
        segment: Segment = "auto",
        **task_options: Any,
    ) -> None:
        self.spec = make_spec(task, **task_options)
        self.num_envs, substeps = checks.whole("num_envs", num_envs, 1), arguments.find_substeps(dt, substeps)
        check_repetition(substeps, segment)
        for name, flag in (("resample", resample), ("deterministic", deterministic)):
            checks.flag(name, flag)
        self.dtype = arguments.choice("dtype", str(dtype).removeprefix("torch."), arguments.DTYPES)
        self.device = arguments.find_device(device)
        if deterministic and self.device.type != "cpu":
            raise ValueError(f"deterministic=True needs device 'cpu', got {device!r}")
        self.action_resolution = arguments.find_resolution(self.spec, resolution)
        self.action_shape = (2, self.action_resolution, self.action_resolution)
        self._as_reference = arguments.choice("parity", parity, {"clean": False, "reference": True})
        layouts = {"image": "image", "grid": "grid", None: default_indexing(parity)}
        self.action_layout = arguments.choice("action_layout", action_layout, layouts)
        counts = particle_counts(self.spec, particles)
        self.model = make_model(self.spec, counts, substeps, backend, parity, segment, float(dt))
        random = self.model.camera.pixels  # both as in the reference, with full counts or its parity
        self._initial_positions = InitialPositions(self.spec, counts, self.num_envs, random=random, resample=resample)
        self._like = torch.empty(self.num_envs, dtype=self.dtype, device=self.device)
        self.device = self._like.device  # with the number of what is the current device now
        self._physics: Physics = {}
        self._env_state: EnvState | None = None
        self._observation: Tensor | None = None
        self._actuation: Tensor | None = None

    def __repr__(self) -> str:
        return f"TorchEnv({self.spec.name!r}, {self.num_envs}, {self.action_resolution}, device={str(self.device)!r})"

    @property
    def num_particles(self) -> int:
        """N, particles of all bodies."""
        return self.model.solver.num_particles

    @property
    def env_state(self) -> EnvState:
        """Everything that moves, for :mod:`dittogym.core`. Assign a state to continue from it.

        Raises:
            RuntimeError: It was neither reset nor assigned.
        """
        if self._env_state is None:
            raise RuntimeError("call reset() first: the environment has no state yet")
        return self._env_state

    @env_state.setter
    def env_state(self, value: EnvState) -> None:
        arguments.refuse_transforms("TorchEnv.env_state")
        checks.instance("env_state", value, EnvState)
        theirs = value.particles
        kind = theirs.batch_size, theirs.num_particles, theirs.dtype, theirs.device
        own = self.num_envs, self.num_particles, self.dtype, self.device
        if kind != own:
            raise ValueError(f"env_state must be of {own} (simulations, particles, dtype, device), got {kind}")
        if self._env_state is not None and (missing := self._env_state.memory.keys() - value.memory.keys()):
            raise ValueError(f"env_state must have the memory of this task, got none of {sorted(missing)}")
        self._env_state, self._actuation, self._observation = value, None, None

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """States of the random generators that ``resample`` draws from, ``key`` (624,) and ``pos`` (); can be set."""
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
        """The last image (B, 3, 64, 64) uint8, computed again if the state was assigned; do not write to it."""
        if self._observation is None:
            self._observation = core.observe(self.model, self.env_state)
        return self._observation

    def detach(self, *, physics: bool = True) -> None:
        """Detach the state from the autograd graph, with ``physics=False`` except for the physics of the last reset."""
        state = tree.detach(self.env_state)
        self._env_state = state if physics else replace(state, physics=self.env_state.physics)

    def save(self) -> Snapshot:
        """Return a snapshot of all simulations, which :meth:`load` restores; it keeps the autograd graph."""
        state, observation = tree.map(Tensor.clone, (self.env_state, self.observation()))
        return Snapshot(self.model.kind, state, observation, self.model.constants)

    def load(self, snapshot: Snapshot, mask: Any = None) -> Tensor:
        """Restore a snapshot; the simulation continues bit for bit as it did before.

        Positions and physics of the next reset, a ``TimeLimit``'s count, and learned materials are not part of it.

        Args:
            snapshot: Of this environment or one like it; one of a single simulation goes into every element.
            mask: (B,) bool, load only these elements.

        Returns:
            The observation (B, 3, 64, 64) uint8.

        Raises:
            ValueError: The snapshot is of another task or variant, other numbers of particles, other substeps, another
                type, device or batch size.
        """
        checks.instance("snapshot", snapshot, Snapshot)
        chosen = arguments.find_mask("mask", mask, self.num_envs, self.device)
        check_snapshot(self.model, snapshot, self._like)
        index = torch.arange(self.num_envs, device=self.device) % len(snapshot.state.steps)
        state, observation = tree.map(lambda t: t[index], (snapshot.state, snapshot.observation))
        if not bool(chosen.all()):
            mine = self.env_state
            physics = merged(self.spec, mine.physics, state.physics, chosen, self._like)
            state, mine = (replace(each, physics=physics) for each in (state, mine))
            state, observation = tree.where(chosen, (state, observation), (mine, self.observation()))
        actuation = self._actuation_of_others(chosen)
        self.env_state = state
        self._actuation, self._observation = actuation, observation.clone()
        return observation

    def _actuation_of_others(self, mask: Tensor) -> Tensor | None:
        """The actuation of the last step, which pictures show, zero where the mask (B,) holds."""
        kept = None if bool(mask.all()) else self._actuation
        return None if kept is None else kept.masked_fill(mask[:, None, None, None], 0.0)

    def reset(self, *, seed: Seed = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes. A reset that raises an error changes nothing.

        Args:
            seed: Seeds element i with ``seed + i``, or with ``seed[i]``, and draws new positions. Without it, or
                where ``seed[i]`` is ``None``, the last positions are used again, unless ``resample`` was asked for.
            options: ``"positions"``: (N, 2) or (B, N, 2) in the world, m, robot first, used until the next seed, with
                ``resample`` until the next reset; ``"physics"``: constants of the matter, see
                :func:`dittogym.physics.physics_values`, used until given again, ``{}`` goes back to the task's own;
                ``"reset_mask"``: (B,) bool, reset only these elements. Later resets reuse values without gradients.

        Returns:
            The observation (B, 3, 64, 64) uint8 of all elements, and ``info``.

        Raises:
            ValueError: An option is unknown, has the wrong shape, puts particles outside the window, or makes matter
                too stiff for the substeps.
        """
        arguments.refuse_transforms("TorchEnv.reset")
        options = arguments.reset_options(options)
        mask = arguments.find_mask("reset_mask", options.get("reset_mask"), self.num_envs, self.device)
        if self._env_state is None and not bool(mask.all()):
            raise ValueError("reset_mask must reset all elements the first time")
        given, present = options.get("physics"), self._physics
        physics = present if given is None else next_physics(self.model, present, given, mask, self._like)
        drawn = self._initial_positions.draw(seed, mask.cpu().numpy(), options.get("positions"), self._like)
        assert drawn.positions is not None
        index = mask.nonzero()[:, 0]
        # Indexing saves the index for the backward pass, which `detach(physics=False)` would make impossible to repeat.
        own = tree.map(lambda t: t[index], physics) if len(index) < self.num_envs else physics
        fresh, observation = core.reset(self.model, drawn.positions[index], own)
        info = core.measured_info(self.model, fresh, fresh.start)
        if self._env_state is not None:
            if self._as_reference:  # its reset leaves the last episode's centre, memory and observation
                old, observation = self._env_state, self.observation()[index]
                memory = {name: old.memory[name][index].detach() for name in self.spec.stale_memory}
                fresh = replace(fresh, centre=old.centre[index].detach(), memory={**fresh.memory, **memory})
            if len(index) < self.num_envs:
                kept = core.seen(self.model, self.env_state, self.observation())
                others = replace(fresh, physics={}), observation, info
                fresh, observation, info = tree.map(lambda whole, part: whole.index_copy(0, index, part), kept, others)
                fresh = replace(fresh, physics=merged(self.spec, self.env_state.physics, physics, mask, self._like))
        # Gradients in positions and constants reach back to this reset only, not to the next that uses them.
        self._initial_positions = replace(drawn, positions=drawn.positions.detach().clone())
        self._physics = tree.map(lambda t: t.detach().clone(), physics)
        self._env_state, self._actuation, self._observation = fresh, self._actuation_of_others(mask), observation
        return observation.clone(), tree.map(lambda t: t.detach().clone(), info)

    def step(self, action: Tensor, *, soft: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance every simulation by one control step.

        Args:
            action: (B, 2, R, R), muscle actuation in units of the task's maximum; ``[:, 0]`` along material x. Values
                beyond [-1, 1] saturate after the interpolation.
            soft: Observation and reward are the smooth ones, for gradients; ``info["true_reward"]`` is the reward.

        Returns:
            observation (B, 3, 64, 64) uint8, floating point and differentiable with ``soft``; reward (B,); terminated
            (B,) bool; truncated (B,) bool, at the horizon; and, all with a leading B, ``info``: ``reward_terms`` by
            name, ``com``, ``split``, ``finite`` (false outside the simulation window, too), ``is_success`` where the
            task defines it, and the task's own quantities.

        Raises:
            ValueError: The action has the wrong shape or type or is not finite.
            RuntimeError: It is called under a transform of ``torch.func`` or in a backward pass.
        """
        arguments.refuse_transforms("TorchEnv.step")
        arguments.refuse_backward("TorchEnv.step")
        checks.flag("soft", soft)
        action = arguments.check_action(action, (self.num_envs, *self.action_shape), self.dtype, self.device)
        action = to_grid_indexing(action, self.action_layout)
        result = core.step(self.model, self.env_state, action, soft=soft)
        info: dict[str, Any] = {"reward_terms": dict(result.terms), **result.info}
        info |= {} if result.success is None else {"is_success": result.success}
        info |= {"true_reward": result.true_reward} if soft else {}
        self._observation = result.observation.clone()  # what is returned belongs to the caller
        self._env_state, self._actuation = result.state, result.actuation.detach()
        observation = result.observation if result.soft_observation is None else result.soft_observation
        return observation, result.reward, result.terminated, result.state.steps >= self.spec.horizon, info

    def soft_observation(self) -> Tensor:
        """The present image (B, 3, 64, 64) as a smooth function; see :func:`dittogym.core.soft_observation`."""
        return core.soft_observation(self.model, self.env_state)

    def shot(self, index: int = 0, quantities: Sequence[str] = QUANTITIES) -> Shot:
        """What pictures show of the present moment of one simulation, ``index``, with these quantities alone."""
        return take(self.model, self.env_state, index, self._actuation, quantities)

    def render(self, index: int = 0, *, muscles: bool = True, size: int = 512, zoom: float | None = None) -> np.ndarray:
        """Picture (S, S, 3) uint8 of one simulation in RGB.

        Args:
            index: Which element of the batch.
            muscles: Colour the robot by the actuation of the last step: contraction red, expansion blue.
            size: S, pixels per side.
            zoom: The picture shows 1 / zoom metres, 1 is the whole window; ``None``: 0.56 m, a little more than the
                robot observes.
        """
        return frame(describe(self.model), self.shot(index, ("muscle",)), size, zoom, muscles)

    def film(
        self, policy: Any, path: str | os.PathLike[str] | None = None, *, seed: Seed = 0, index: int = 0, **options: Any
    ) -> Recording:
        """Reset, play an episode, and record one of the simulations until its episode ends.

        Args:
            policy: A function from observations (B, 3, 64, 64) uint8, NumPy, to actions (B, 2, R, R), or an object with
                such a method ``predict``, as :func:`cfp.load` returns it.
            path: A film (``.mp4``, ``.gif``, ``.webp``), a filmstrip (``.png``) or a replay (``.html``) to write.
            seed: Seed of the reset and, if it is not ``None``, of the policy's noise.
            index: Which element of the batch.
            options: ``max_steps``, after which the recording ends, and options of the file, such as ``size``, ``speed``
                and ``zoom``, see :meth:`dittogym.render.recording.Recording.save`.

        Returns:
            The recording, from which further films can be saved. A notebook shows it.

        Raises:
            ValueError: An option is out of range, the file does not take it, or the policy has another layout.
            TypeError: The policy is neither a function nor has a method ``predict``.
        """
        return film(self, as_function(policy, self.action_layout), path, seed, index, **options)

    def _repr_png_(self) -> bytes | None:
        """What a notebook shows: the first simulation, once there is a state."""
        return None if self._env_state is None else png(self.render())
