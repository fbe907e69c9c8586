"""Which simulations can go on."""

import math

import pytest
import torch
from tiny import set_particles, tiny

from dittogym import core

FIELDS = {"x": (0, 1), "v": (0, 0), "C": (1, 0), "F": (0, 1), "Jp": ()}


def found(env) -> list[bool]:
    valid = core.is_valid(env.model, env.env_state)
    assert valid.dtype == torch.bool
    return valid.tolist()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_one_number_of_one_particle(field: str, value: float) -> None:
    """Of the robot or of the object, in any component."""
    env = tiny("kick", 3, dtype="float32")
    env.reset(seed=0)
    assert found(env) == [True] * 3
    for particle in (0, -1):
        numbers, before = getattr(env.state, field).clone(), env.env_state
        numbers[1, particle][FIELDS[field][: numbers.ndim - 2]] = value
        set_particles(env, **{field: numbers})
        assert found(env) == [True, False, True]
        env.env_state = before


@pytest.mark.parametrize(
    ("shift", "valid"), [((0.0, 0.0), True), ((3.0, 0.0), False), ((0.0, -3.0), False), ((0.0, 3.0), False)]
)
def test_some_of_the_robot_must_be_in_the_window(shift: tuple[float, float], valid: bool) -> None:
    """One particle is enough; the object does not count."""
    env = tiny("kick", 2)
    env.reset(seed=0)
    x, robot = env.state.x.clone(), env.model.num_robot_particles
    x[1, :robot] += torch.tensor(shift)
    set_particles(env, x=x)
    assert found(env) == [True, valid]
    x[1, robot - 1] = env.state.x[0, 0]
    set_particles(env, x=x)
    assert found(env) == [True, True]
