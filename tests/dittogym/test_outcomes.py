"""Rewards, ends of episodes and successes on both sides of their limits, as the pages of the tasks give them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import TASKS, begun, tiny

import dittogym
from dittogym import core
from dittogym.core import StepResult
from dittogym.observation import silhouette


def judge(
    task: str | dittogym.TaskSpec,
    *,
    robot: tuple[float, float] = (0.0, 0.0),
    cube: tuple[float, float] | None = None,
    tip: tuple[float, float] | None = None,
    speed: tuple[float, float] | None = None,
    spread: float | None = None,
    task_state: dict[str, float] | None = None,
) -> StepResult:
    """What a task makes of a state: the initial one with bodies moved.

    Args:
        task: The task.
        robot: Displacement of the robot, m; a moving window follows it.
        cube: Centre of the object, m.
        tip: Position of all particles of GROW's tip, m.
        speed: Velocity of everything, m/s.
        spread: Spread of the robot, m.
        task_state: Entries of the task's state.
    """
    env = begun(tiny(task, 1))
    state, count = env.env_state, env.model.num_robot_particles
    x, v, origin = state.particles.x.clone(), state.particles.v.clone(), state.origin.clone()
    x[:, :count] += torch.tensor(robot)
    if env.spec.window.moves:
        origin[:, 0] += robot[0]
    if spread is not None:
        centre = x[:, :count].mean(1, keepdim=True)
        x[:, :count] = centre + (x[:, :count] - centre) * spread / state.start.radius_of_gyration
    if cube is not None:
        x[:, count:] += torch.tensor(cube) - x[:, count:].mean(1)
    if tip is not None:
        x[0, state.task_state["tip"][0]] = torch.tensor(tip, dtype=x.dtype)
    if speed is not None:
        v[:] = torch.tensor(speed)
    entries = {name: torch.full_like(state.task_state[name], value) for name, value in (task_state or {}).items()}
    particles = replace(state.particles, x=x, v=v)
    state = replace(state, particles=particles, origin=origin, task_state={**state.task_state, **entries})
    field = torch.zeros(1, 2, env.spec.patch, env.spec.patch, dtype=env.dtype)
    return core.judge(env.model, core.look(env.model, state, field))


@pytest.mark.parametrize(
    ("task", "moved", "terminated", "success"),
    [
        ("run", {"robot": (1.69, 0.0)}, False, False),
        ("run", {"robot": (1.71, 0.0)}, False, True),
        ("run", {"robot": (-0.28, 0.0)}, False, False),  # it starts at 0.09 m
        ("run", {"robot": (-0.30, 0.0)}, True, False),
        ("obstacle", {"robot": (0.49, 0.0)}, False, False),
        ("obstacle", {"robot": (0.51, 0.0)}, False, True),
        ("obstacle", {"robot": (-0.27, 0.0)}, False, False),  # it starts at 0.08 m
        ("obstacle", {"robot": (-0.29, 0.0)}, True, False),
        ("kick", {"cube": (1.31, 0.185)}, False, False),  # it starts at 0.325 m
        ("kick", {"cube": (1.34, 0.185)}, False, True),
        ("kick", {"robot": (-0.28, 0.0)}, False, False),
        ("kick", {"robot": (-0.30, 0.0)}, True, False),
        ("catch", {"cube": (0.17, 0.27)}, False, True),
        ("catch", {"cube": (0.18, 0.28)}, False, False),
        ("dig", {"robot": (0.33, -0.40)}, False, True),  # from (-0.13, 0.57) to the goal
        ("dig", {"robot": (0.23, -0.40)}, False, False),
        ("grow", {"tip": (0.039, 0.5)}, True, True),
        ("grow", {"tip": (0.041, 0.5)}, False, False),
        ("grow", {"tip": (0.279, 0.5)}, False, False),
        ("grow", {"tip": (0.281, 0.5)}, True, False),
        ("slot", {"cube": (0.68, 0.23)}, True, True),
        ("slot", {"cube": (0.66, 0.23)}, True, False),
        ("slot", {"cube": (0.68, 0.25)}, False, False),
        ("slot", {"robot": (-0.12, 0.0)}, False, False),  # it starts at 0.08 m
        ("slot", {"robot": (-0.14, 0.0)}, True, False),
    ],
)
def test_ends_and_successes(task: str, moved: dict, terminated: bool, success: bool) -> None:
    result = judge(task, **moved)
    assert result.info["finite"].item()
    assert (result.terminated.item(), result.success.item()) == (terminated, success)


@pytest.mark.parametrize(("share", "success"), [(0.79, False), (0.81, True)])
def test_shape_match_succeeds_where_silhouette_and_target_overlap(share: float, success: bool) -> None:
    env = tiny("shapematch", 1)
    shape = silhouette(env.reset(seed=0)[0])[0].numpy()
    pixels = np.flatnonzero(shape)
    target = np.zeros(shape.size, bool)
    target[pixels[: round(share * len(pixels))]] = True
    spec = replace(dittogym.make_spec("shapematch"), target=target.reshape(shape.shape))
    result = judge(spec)
    assert (result.terminated.item(), result.success.item()) == (False, success)
    assert result.terms["mismatch"].item() == -(len(pixels) - target.sum()) * spec.weights["mismatch"]


@pytest.mark.parametrize("task", [task for task in TASKS if dittogym.make_spec(task).split_limit is not None])
def test_a_torn_robot_ends_the_episode(task: str) -> None:
    limit = dittogym.make_spec(task).split_limit
    whole, torn = (judge(task, spread=factor * limit) for factor in (0.99, 1.01))
    assert not whole.terminated.item() and whole.terms["split"].item() == 0.0
    assert torn.terminated.item()
    assert torn.terms["split"].item() == pytest.approx(-((20 * 1.01 * limit) ** 2))


@pytest.mark.parametrize(
    ("task", "moved", "term", "value"),
    [
        ("run", {"robot": (1.0, 0.0)}, "location", 9.0),
        ("run", {"robot": (2.0, 0.0)}, "location", 20.0),
        ("run", {"robot": (-2.0, 0.0)}, "location", -20.0),
        ("run", {"speed": (1.0, 0.0)}, "velocity", 4 * 9.0),
        ("run", {"speed": (2.0, 0.0)}, "velocity", 4 * 20.0),
        ("run", {"speed": (-2.0, 0.0)}, "velocity", 4 * -20.0),
        ("kick", {"cube": (1.325, 0.185)}, "object_location", 8.0),
        ("kick", {"cube": (3.325, 0.185)}, "object_location", 30.0),
        ("kick", {"cube": (-2.675, 0.185)}, "object_location", -20.0),
        ("kick", {"robot": (3.0, 0.0)}, "location", 30.0),
        ("kick", {"robot": (-3.0, 0.0)}, "location", -20.0),
        ("kick", {"cube": (0.29, 0.4)}, "gap", 10 * -0.2),  # the robot stands at 0.09 m
        ("kick", {"cube": (0.49, 0.4)}, "gap", 10 * -0.3),
        ("kick", {"speed": (2.0, 0.0)}, "velocity", 6 * 20.0),
        ("kick", {"speed": (-2.0, 0.0)}, "object_velocity", 6 * -20.0),
        ("dig", {"speed": (0.5, -0.5)}, "velocity", 5 * (3.5 + 3.5)),
        ("dig", {"speed": (3.0, 3.0)}, "velocity", 0.0),
        ("grow", {"tip": (0.0, 0.46)}, "distance", 40 * -0.2),
        ("grow", {"tip": (0.0, 0.47)}, "success", 200.0),
        ("grow", {"tip": (0.0, 0.459)}, "success", 0.0),
        ("catch", {"cube": (0.35, 0.35)}, "object_distance", 50 * -0.3),
        ("catch", {"cube": (0.45, 0.95)}, "object_distance", 50 * -0.5),
        ("catch", {"cube": (-0.4, 0.9)}, "hand_distance", 30 * -0.5),
        ("slot", {"task_state": {"front_distance": 9.0}}, "approach", 2 * 50.0),
        ("slot", {"task_state": {"front_distance": -9.0}}, "approach", 2 * -20.0),
        ("slot", {"cube": (0.635, 0.337)}, "object_location", 2 * 10.0),
        ("slot", {"cube": (0.68, 0.23)}, "fall", 2 * 100.0),
        ("slot", {"cube": (0.66, 0.23)}, "fall", 2 * -100.0),
        ("slot", {"cube": (0.68, 0.25)}, "fall", 0.0),
        ("slot", {"speed": (2.0, -2.0)}, "velocity", 0.0),
        ("slot", {"speed": (0.5, 0.5)}, "velocity", 6 * 12.0),
    ],
)
def test_terms_of_the_reward(task: str, moved: dict, term: str, value: float) -> None:
    assert judge(task, **moved).terms[term].item() == pytest.approx(value, rel=0.01, abs=0.01 * abs(value) + 1e-9)
