"""Velocity rules: friction by hand, and all kinds together against a loop over nodes and rules."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import normal
from torch import Tensor

from torchmpm import Grid, VelocityRule, fixed
from torchmpm.boundary import constrain, faces
from torchmpm.grid import PAD

R = 8
GRID = Grid(R)
STICK = math.inf


def apply(rules: tuple[VelocityRule, ...], velocity: Tensor, origin: Tensor | None = None) -> Tensor:
    """Rules on the velocities of nodes that exist, (2, 1, R, R)."""
    origin = torch.zeros(1, 2, dtype=velocity.dtype) if origin is None else origin
    padded = torch.nn.functional.pad(velocity, [PAD] * 4).flatten(2)
    result = constrain(faces(rules, GRID, origin), padded).unflatten(-1, (GRID.width, GRID.width))
    inner = result[..., PAD:-PAD, PAD:-PAD]
    assert result.count_nonzero() == inner.count_nonzero(), "the padding must stay at rest"
    return inner


def everywhere(x: float, y: float) -> Tensor:
    return torch.tensor([x, y], dtype=torch.float64)[:, None, None, None].expand(2, 1, R, R)


def after(rule: VelocityRule, x: float, y: float) -> tuple[float, float]:
    """Velocity of any node under a rule that covers all of them."""
    result = apply((rule,), everywhere(x, y)).flatten(1)
    assert (result == result[:, :1]).all()
    return result[0, 0].item(), result[1, 0].item()


@pytest.mark.parametrize(
    ("velocity", "friction", "expected"),
    [
        ((3.0, -2.0), 0.5, (2.0, 0.0)),  # 3 - 0.5 * 2
        ((-3.0, -2.0), 0.5, (-2.0, 0.0)),  # against the motion, whichever way it goes
        ((3.0, -2.0), 1.5, (0.0, 0.0)),  # just enough to stop
        ((3.0, -2.0), 4.0, (0.0, 0.0)),  # never turns the motion round
        ((0.0, -2.0), 0.5, (0.0, 0.0)),
        ((3.0, 0.0), 0.5, (3.0, 0.0)),  # no pressure, no friction
    ],
)
def test_coulomb_friction(velocity: tuple[float, float], friction: float, expected: tuple[float, float]) -> None:
    assert after(VelocityRule("-y", friction=friction), *velocity) == expected
    turned = after(VelocityRule("+x", friction=friction), -velocity[1], velocity[0])
    assert turned == (expected[1], expected[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("resolution", [96, 100, 128])
def test_windows_at_whole_nodes(resolution: int, dtype: torch.dtype) -> None:
    """Although 1/96 and 1/100 are no binary numbers; between two nodes the shift is truncated."""
    grid, nodes = Grid(resolution), torch.arange(-300, 300)
    origin = (nodes.to(torch.float64) * grid.h).to(dtype)[:, None].expand(-1, 2)
    assert torch.equal(grid.node_shift(origin), nodes[:, None].expand(-1, 2))
    assert torch.equal(grid.node_shift(origin + 0.99 * grid.h)[300:], nodes[300:, None].expand(-1, 2))


def test_fixed_holds_nodes_at_rest() -> None:
    velocity = normal(2, 1, R, R, seed=1)
    result = apply(fixed((2, 3), (None, 4)), velocity)
    inside = torch.zeros(R, R, dtype=torch.bool)
    inside[2:4, :5] = True
    assert (result[:, :, inside] == 0).all()
    assert torch.equal(result[:, :, ~inside], velocity[:, :, ~inside])
    assert {rule.frame for rule in fixed(frame="window")} == {"window"}
    assert {rule.frame for rule in fixed()} == {"world"}


def sequential(rules: tuple[VelocityRule, ...], velocity: Tensor, origin: Tensor) -> Tensor:
    """mpm.md 7 literally: for every node all rules in their order, each on what the earlier ones left."""
    result = velocity.movedim(0, -1).tolist()
    shift = [math.trunc(o) for o in (origin[0] / GRID.h).tolist()]
    for i, j in itertools.product(range(R), range(R)):
        v = result[0][i][j]
        for rule in rules:
            node = (i, j) if rule.frame == "window" else (i + shift[0], j + shift[1])
            covers = [
                (low is None or low <= n) and (high is None or n <= high)
                for n, (low, high) in zip(node, (rule.i, rule.j), strict=True)
            ]
            axis, sign = "xy".index(rule.direction[1]), int(rule.direction[0] + "1")
            removed = v[axis] * sign
            if not all(covers) or removed <= 0:
                continue
            v[axis] = 0.0
            if rule.friction == STICK:
                v[1 - axis] = 0.0
            else:
                left = max(abs(v[1 - axis]) - rule.friction * removed, 0.0)
                v[1 - axis] = math.copysign(left, v[1 - axis])
    return torch.tensor(result, dtype=velocity.dtype).movedim(-1, 0)


END = st.none() | st.integers(-3, R + 2)
RANGE = st.tuples(END, END).map(lambda ends: ends if None in ends or ends[0] <= ends[1] else (ends[1], ends[0]))
DIRECTION = st.sampled_from(["+x", "-x", "+y", "-y"])
FRAME = st.sampled_from(["world", "window"])


def rules(direction: st.SearchStrategy[str], friction: list[float]) -> st.SearchStrategy:
    rule = st.builds(VelocityRule, direction, RANGE, RANGE, st.sampled_from(friction), FRAME)
    return st.lists(rule, max_size=7).map(tuple)


CELLS = st.floats(-6.0, 6.0).map(lambda cells: round(cells, 9))  # closer to a whole number they count as one
ONE_DIRECTION = DIRECTION.flatmap(lambda direction: rules(st.just(direction), [0.0, 0.3, 1.0, STICK]))


@settings(max_examples=80)
@given(rules(DIRECTION, [0.0, STICK]) | ONE_DIRECTION, st.tuples(CELLS, CELLS), st.integers(0, 99))
def test_against_rules_in_sequence(listed: tuple[VelocityRule, ...], cells: tuple[float, float], seed: int) -> None:
    """Equal only without finite friction across directions.

    Faces gather the rules of one direction, so two directions may act in another order than they were listed. Zeroing
    one component and zeroing both commute; reducing a component by what was removed from the other does not, since
    either may come first. The tasks of DittoGym have none of the latter kind.
    """
    origin = torch.tensor([cells], dtype=torch.float64) * GRID.h
    velocity = normal(2, 1, R, R, seed=seed)
    velocity[velocity.abs() < 0.2] = 0.0
    found, expected = apply(listed, velocity, origin), sequential(listed, velocity, origin)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-15)


def test_friction_has_second_derivatives_at_rest() -> None:
    velocity = everywhere(0.0, 0.0).clone().requires_grad_()
    slid = apply((VelocityRule("-y", friction=0.3),), velocity)
    (first,) = torch.autograd.grad(slid.square().sum(), velocity, create_graph=True)
    (second,) = torch.autograd.grad(first.square().sum(), velocity)
    assert second.isfinite().all()
