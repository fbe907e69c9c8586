"""An environment as pure functions: :func:`reset` and :func:`step`, and the pieces they are composed of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dittogym.action import patch_field, place
from dittogym.contract import Measurement, Moment, Outcome, check_memory, check_outcome, kind_of, measure
from dittogym.model import EnvState, Model
from dittogym.physics import NAMES, Physics
from dittogym.reward_ops import EXACT, SMOOTH, RewardOps, action_cost
from dittogym.window import centre_in_window, contains
from torchmpm import ParticleState, diagnostics, tree
from torchmpm.tree import cached_tensors, transforming

#: Reward of a step of an element whose state is no longer valid; its episode ends.
FAILURE_REWARD = -16.0


class StepResult(NamedTuple):
    """What a control step comes to.

    Attributes:
        state: The next state.
        observation: (B, 3, 64, 64) uint8.
        reward: (B,), the sum of the terms.
        terms: Weighted reward terms by name, (B,) each.
        terminated: (B,) bool.
        success: (B,) bool; ``None`` where the task does not define it.
        info: ``com``, ``split``, ``finite``, ``object_com`` where there is an object, and the task's own; leading B.
        true_reward: (B,) the task's reward; ``reward`` unless that is smooth.
        actuation: (B, 2, P, P) on the patch, Pa.
        soft_observation: (B, 3, 64, 64) of :func:`soft_observation`; ``None`` unless the reward is smooth.
    """

    state: EnvState
    observation: Tensor
    reward: Tensor
    terms: Mapping[str, Tensor]
    terminated: Tensor
    success: Tensor | None
    info: Mapping[str, Tensor]
    true_reward: Tensor
    actuation: Tensor
    soft_observation: Tensor | None = None


def reset(model: Model, positions: Tensor, physics: Physics | None = None) -> tuple[EnvState, Tensor]:
    """Start episodes with particles at rest.

    Args:
        model: The task.
        positions: (B, N, 2) in the world, m, robot first.
        physics: Constants that differ from the task's, as :func:`dittogym.physics.physics_values` returns them. Whether
            they are stable is not checked.

    Returns:
        State and observation (B, 3, 64, 64) uint8.

    Raises:
        ValueError: ``positions`` are of another shape or type, or ``physics`` holds an unknown name.
    """
    shape = model.solver.num_particles, 2
    if not isinstance(positions, Tensor) or positions.ndim != 3 or positions.shape[1:] != shape:
        raise ValueError(f"positions must be a tensor of shape (B, {shape[0]}, 2), got {kind_of(positions)}")
    if unknown := [name for name in physics or () if name not in NAMES]:
        raise ValueError(f"physics may hold {', '.join(NAMES)}, got {', '.join(unknown)}")
    spec, particles = model.spec, ParticleState.at_rest(positions)
    start = measure(particles, model.num_robot_particles)
    steps = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    state = EnvState(particles, spec.window.origin(start.com), start.com, start, {}, physics or {}, steps)
    observation = observe(model, state)
    moment = _moment(model, state, start, observation, EXACT)
    memory = spec.initial_memory(moment, spec)
    check_memory(spec.name, memory, spec.stale_memory, len(positions))
    # Of any kind of mapping, and a copy: it may hold what the state does.
    return replace(state, memory=tree.map(Tensor.clone, dict(memory))), observation


def step(model: Model, state: EnvState, action: Tensor, *, soft: bool = False) -> StepResult:
    """Advance by one control step.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in grid indexing, see :func:`dittogym.action.to_grid_indexing`, from -1 to 1. Elements with
            numbers that are not finite end with :data:`FAILURE_REWARD`.
        soft: Whether the reward is the smooth one, for gradients; all else is as without.

    Raises:
        ValueError: ``action`` is of another shape or type, or the task returns what it must not.
    """
    return evaluate(model, *transition(model, state, action), soft=soft)


def transition(model: Model, state: EnvState, action: Tensor) -> tuple[EnvState, Tensor]:
    """Advance the physics by one control step.

    Elements that are not finite afterwards have no gradient in what they came from, nor in the task's own constants.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in grid indexing.

    Returns:
        The next state, and the actuation on the patch (B, 2, P, P) in Pa.

    Raises:
        ValueError: ``action`` is of another shape or type.
    """
    _check_action(model.spec.patch, action, state.particles.x)
    finite: list[Tensor] = []  # where gradients may go back, known after the step

    def guard(value: Tensor) -> Tensor:
        """Stop gradients of what is not finite; NaN would spread through parameters that the batch shares."""
        if value.requires_grad:
            value = value.view_as(value)
            value.register_hook(lambda g: None if g is None else tree.where(finite[0], g, torch.zeros_like(g)))
        return value

    guarded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tree.leaves((state, action)))
    if guarded:
        state, action = tree.map(guard, tree.without_inference((state, action)))
    spec, solver = model.spec, model.solver_for(state.physics)
    actuation = patch_field(action, spec.patch, state.physics.get("max_actuation", spec.max_actuation))
    on_nodes = place(actuation, centre_in_window(spec.reach, state.centre, state.origin), solver.grid.resolution)
    advance = partial(solver.step, substeps=model.substeps, origin=state.origin, segment=model.segment)
    particles = advance(state.particles, on_nodes)
    learned = torch.is_grad_enabled() and any(value.requires_grad for value in model.solver.constants.values())
    if guarded or learned:
        finite.append(diagnostics.finite(particles))
    if learned and not transforming() and not bool(finite[0].all()):
        # All elements share the task's own constants, so no hook can tell them apart there. Step once more without
        # those that are not finite: particles with a NaN position take no part.
        nowhere = tree.map(lambda tensor: torch.full_like(tensor, math.nan), state.particles)
        again = advance(tree.where(finite[0], state.particles, nowhere), on_nodes)
        particles = tree.where(finite[0], again, particles.detach())
    com = particles.x[:, : model.num_robot_particles].mean(1)
    com = torch.where(torch.isfinite(com).all(-1, keepdim=True), com, state.centre)  # the last that was finite
    origin = spec.window.origin(com) if spec.window.moves else state.origin
    return replace(state, particles=particles, origin=origin, centre=com, steps=state.steps + 1), actuation


def _check_action(patch: int, action: Tensor, x: Tensor) -> None:
    shape = action.shape if isinstance(action, Tensor) else ()
    square = len(shape) == 4 and shape[2] == shape[3] <= patch
    if not square or shape[:2] != (len(x), 2) or action.dtype != x.dtype:
        allowed = f"{x.dtype} of shape ({len(x)}, 2, R, R) with R at most {patch}"
        raise ValueError(f"action must be {allowed}, got {kind_of(action)}")


def observe(model: Model, state: EnvState) -> Tensor:
    """The image (B, 3, 64, 64) uint8; particles that are not finite are not drawn."""
    return model.camera.observe(state.particles.x, state.particles.v, state.origin, state.centre)


def soft_observation(model: Model, state: EnvState) -> Tensor:
    """The image as a smooth function of the state, see :meth:`dittogym.observation.camera.Camera.observe_smoothly`."""
    return model.camera.observe_smoothly(state.particles.x, state.particles.v, state.origin, state.centre)


def evaluate(model: Model, state: EnvState, actuation: Tensor, *, soft: bool = False) -> StepResult:
    """Observation, reward, termination and success after a transition.

    Elements whose state is not valid, see :func:`is_valid`, end with the term ``failure`` = :data:`FAILURE_REWARD`.

    Args:
        model: The task.
        state: After the transition.
        actuation: (B, 2, P, P) on the patch, Pa.
        soft: As in :func:`step`.
    """
    spec, observation = model.spec, observe(model, state)
    now = measure(state.particles, model.num_robot_particles)
    info = measured_info(model, state, now)
    valid = info["finite"]
    moment = _moment(model, state, now, observation, EXACT)
    outcome, terms, reward = _weighted_reward(model, moment, actuation, valid)
    image, true_reward = None, reward
    if soft:
        image = soft_observation(model, state)
        _, terms, reward = _weighted_reward(model, moment._replace(observation=image, ops=SMOOTH), actuation, valid)
    terminated = ~valid if outcome.terminated is None else outcome.terminated | ~valid
    if spec.split_limit is not None:
        terminated = terminated | (now.split > spec.split_limit)
    if outcome.memory is not None:  # a copy: it may hold what info does
        state = replace(state, memory=tree.map(Tensor.clone, dict(outcome.memory)))
    success = None if outcome.success is None else outcome.success & valid
    info |= outcome.info or {}
    return StepResult(state, observation, reward, terms, terminated, success, info, true_reward, actuation, image)


def measured_info(model: Model, state: EnvState, now: Measurement) -> dict[str, Tensor]:
    """What ``info`` holds in every task, by name, of a state and its averages ``now``."""
    info = {"com": now.com, "split": now.split, "finite": is_valid(model, state), "object_com": now.object_com}
    return {name: value for name, value in info.items() if value is not None}


def seen(model: Model, state: EnvState, observation: Tensor) -> tuple[EnvState, Tensor, dict[str, Tensor]]:
    """A state without its physics, its observation, and its ``info``: what a reset replaces in some elements."""
    now = measure(state.particles, model.num_robot_particles)
    return replace(state, physics={}), observation, measured_info(model, state, now)


def is_valid(model: Model, state: EnvState) -> Tensor:
    """Which simulations can go on, (B,) bool: all numbers are finite and some of the robot is in the window."""
    robot = state.particles.x[:, : model.num_robot_particles].detach()
    return diagnostics.finite(state.particles) & contains(robot, state.origin.detach()).any(1)


def _moment(model: Model, state: EnvState, now: Measurement, observation: Tensor, ops: RewardOps) -> Moment:
    memory = dict(state.memory)  # so that a task cannot exchange the entries of the state
    return Moment(state.particles, model.num_robot_particles, now, state.start, observation, memory, ops)


def _weighted_reward(
    model: Model, moment: Moment, actuation: Tensor, valid: Tensor
) -> tuple[Outcome, dict[str, Tensor], Tensor]:
    """Outcome, weighted terms and their sum; of simulations that are not valid (B,) only ``failure`` counts."""
    spec, now = model.spec, moment.now
    outcome = spec.reward_fn(moment, spec)
    check_outcome(spec.name, outcome, moment.memory, spec.weights, len(now.split))
    terms, weights = dict(outcome.terms), spec.weights
    if spec.split_limit is not None:
        terms["split"] = moment.ops.split_penalty(now.split, spec.split_limit)
    if weights.get("action"):
        terms["action"] = -action_cost(actuation)
    terms["alive"] = torch.ones_like(now.split)
    terms["failure"] = torch.zeros_like(now.split)
    factors, failed = _columns(tuple(weights.get(name, 0.0) for name in terms), now.split.dtype, now.split.device)
    values = torch.stack(tuple(terms.values())).to(factors) * factors
    counted = torch.where(valid, values, failed)
    first, *others = counted.unbind()
    reward = sum(others, first)  # in an order that does not depend on the size of the batch, as that of Tensor.sum does
    # Seldom, so that the names are not looked for in every step. Nothing can depend on numbers under torch.func.vmap.
    if not transforming() and not math.isfinite(reward.detach().sum()):
        _check_finite(spec.name, list(terms), values, valid)
    return outcome, dict(zip(terms, counted.unbind(), strict=True)), reward


@cached_tensors
def _columns(weights: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Weights of terms, and their values in a simulation that is not valid, (K, 1) each; ``failure`` comes last."""
    rows = torch.tensor([(weight, 0.0) for weight in weights], dtype=torch.float64, device="cpu")
    rows[-1, 1] = FAILURE_REWARD
    factors, failed = rows.to(device, dtype)[..., None].unbind(1)
    return factors, failed


def _check_finite(task: str, names: list[str], values: Tensor, valid: Tensor) -> None:
    """Refuse terms (K, B) that are not finite where the simulations (B,) are valid."""
    wrong = ~torch.isfinite(values.detach()) & valid
    if bool(wrong.any()):
        term, element = wrong.nonzero()[0].tolist()
        found = f"{values[term, element].item()} for {names[term]!r} in simulation {element}"
        raise ValueError(f"reward_fn of task {task!r} must return finite terms in finite simulations, got {found}")
