"""The tasks: velocity rules against the published tables, what the robot sees of the world, terms and endings."""

import math

import pytest
import torch

import dittogym
from dittogym import observation as obs
from torchmpm import Grid
from torchmpm.boundary import constrain, faces
from torchmpm.grid import PAD

INF = math.inf
FLOOR, LOW, HIGH = ("stick", -INF, INF, -INF, 19), ("+y", -INF, INF, 119, INF), ("+y", -INF, INF, 126, INF)
#: Rules (kind, first i, last i, first j, last j) in world node indices, in the reference's order.
TABLES = {
    "shapematch": [FLOOR, LOW],
    "run": [("+x", 32, 34, 61, INF), ("-x", 46, 47, 61, INF), FLOOR, LOW, ("+y", 33, 46, 59, 60)],
    "grow": [
        ("+x", 32, 34, -INF, 39),
        ("-x", -34, -32, -INF, 39),
        FLOOR,
        HIGH,
        ("+x", 15, 16, 38, 41),
        ("-x", 30, 31, 38, 41),
        ("-y", 15, 32, 41, 41),
        ("+y", 15, 32, 38, 38),
        ("+x", -30, -29, 54, 57),
        ("-x", 1, 2, 54, 57),
        ("-y", -30, 2, 56, 57),
        ("+y", -30, 2, 54, 54),
    ],
    "kick": [FLOOR, HIGH],
    "dig": [("+x", 32, 34, -INF, INF), ("-x", -34, -32, -INF, INF), ("-y", -INF, INF, -INF, 19), HIGH],
    "obstacle": [
        rule
        for k in range(6)
        for rule in (
            ("+x", 30 + 3 * k, 32 + 3 * k, -INF, 26 - k),
            ("-x", 31 + 3 * k, 33 + 3 * k, -INF, 26 - k),
            ("-y", 30 + 3 * k, 33 + 3 * k, -INF, 26 - k),
        )
    ]
    + [FLOOR, LOW],
    "catch": [
        ("+x", 32, 34, -INF, 79),
        ("-x", -34, -32, -INF, 79),
        ("+x", 1, 2, 37, 45),
        ("+x", 26, 27, 27, 37),
        ("+x", 16, 17, 20, 27),
        ("stick", 2, 31, 45, 45),
        ("-y", 17, 25, 27, 27),
        ("+y", 2, 25, 37, 37),
        ("-x", -12, -11, 37, 45),
        ("-x", -17, -16, 27, 37),
        ("-x", -27, -26, 20, 27),
        ("stick", -31, -12, 45, 45),
        ("+y", -15, -12, 37, 37),
        ("+y", -25, -17, 27, 27),
        FLOOR,
        HIGH,
    ],
    "slot": [
        ("+x", 32, 34, 36, INF),
        ("-x", 44, 45, 36, INF),
        ("+x", 45, 46, 40, 40),
        ("-x", 69, 70, 40, 40),
        ("+x", 81, 82, -INF, 39),
        ("-x", 84, 85, -INF, 39),
        FLOOR,
        ("stick", 45, 70, 40, 40),
        ("stick", 82, 85, 40, 40),
        LOW,
        ("+y", 32, 45, 35, 36),
        ("+y", 45, 70, 40, 40),
        ("frame", -INF, INF, -INF, INF),
    ],
}


def apply_table(task: str, velocity: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """One rule after the other on the present velocity (2, B, 128, 128), as the reference does."""
    window_i, j = torch.meshgrid(torch.arange(128), torch.arange(128), indexing="ij")
    i = window_i + shift[:, None, None]
    v = velocity.clone()
    for kind, i0, i1, j0, j1 in TABLES[task]:
        here = (i >= i0) & (i <= i1) & (j >= j0) & (j <= j1)
        if kind == "frame":
            v[..., (window_i % 127 == 0) | (j % 127 == 0)] = 0.0
        elif kind == "stick":
            v[:, here & (v[1] < 0)] = 0.0
        else:
            axis, sign = "xy".index(kind[1]), 1 if kind[0] == "+" else -1
            v[axis, here & (sign * v[axis] > 0)] = 0.0
    return v


@pytest.mark.parametrize("task", TABLES)
def test_velocity_rules_are_the_published_ones(task: str) -> None:
    """All nodes, random velocities, and random places of the window where it moves."""
    spec = dittogym.make_spec(task)
    generator = torch.Generator().manual_seed(0)
    com = torch.cat((torch.tensor([0.09]), torch.empty(39).uniform_(-1.5, 3.0, generator=generator)))
    origin = spec.window.origin(torch.stack((com, com), 1))
    rules = tuple(rule for obstacle in spec.obstacles for rule in obstacle.velocity_rules)
    velocity = torch.randn(2, 40, 128, 128, generator=generator)
    padded = torch.nn.functional.pad(velocity, [PAD] * 4).flatten(2)
    ours = constrain(faces(rules, Grid(), origin), padded)
    ours = ours.view(2, 40, 128 + 2 * PAD, -1)[..., PAD:-PAD, PAD:-PAD]
    assert torch.equal(ours, apply_table(task, velocity, torch.trunc(128 * origin[:, 0]).long()))


def drawn_pixels(task: str, origin_x: float) -> torch.Tensor:
    """Fine pixels of the whole window that obstacles and goal set, (1024, 1024)."""
    origin = torch.tensor([[origin_x, 0.0]], dtype=torch.float64)

    def quarter(row: int, column: int) -> torch.Tensor:
        corner = torch.tensor([[row]]), torch.tensor([[column]])
        drawn = obs.draw_boxes(dittogym.make_spec(task).observed_boxes, origin, *corner)
        return torch.zeros(512, 512, dtype=torch.bool) if drawn is None else drawn.mask[0]

    return torch.cat([torch.cat([quarter(row, column) for column in (0, 512)], 1) for row in (0, 512)], 0)


def published_pixels(task: str, origin_x: float) -> torch.Tensor:
    """The conditions of the reference, pixel by pixel."""
    row, column = torch.meshgrid(torch.arange(1024.0).double(), torch.arange(1024.0).double(), indexing="ij")
    q, y, X = 1024 - row, (1024 - row) / 1024, column / 1024 + origin_x
    empty = torch.zeros_like(row, dtype=torch.bool)

    def block(y0: float, y1: float, x0: float, x1: float) -> torch.Tensor:
        return (y0 / 128 < y) & (y < y1 / 128) & (x0 / 128 < X) & (x1 / 128 > X)

    def pixels(r0: int, r1: int, c0: int, c1: int) -> torch.Tensor:
        return (r0 <= row) & (row <= r1) & (c0 <= column) & (column <= c1)

    if task == "grow":
        return pixels(503, 521, 503, 521) | block(38, 41, 15, 31) | block(54, 57, -30, 2)
    if task == "dig":
        return pixels(840, 859, 707, 726)
    if task == "catch":
        right = block(37, 45, 1, 32) | block(27, 37, 26, 32) | block(20, 27, 16, 32)
        left = block(37, 45, -32, -11) | block(27, 37, -32, -16) | block(20, 27, -32, -26)
        return pixels(759, 777, 656, 675) | right | left
    if task == "obstacle":
        for k in range(6):
            empty |= (q <= 8 * (26 - k)) & ((30 + 3 * k) / 128 <= X) & ((33 + 3 * k) / 128 >= X)
        return empty
    if task == "slot":
        post = (y <= 40 / 128) & (81 / 128 <= X) & (85 / 128 >= X)
        shelf = (38 / 128 <= y) & (y <= 40 / 128) & (45 / 128 < X) & (70 / 128 > X)
        return block(36, INF, 32, 45) | post | shelf
    return empty


@pytest.mark.parametrize("task", TABLES)
@pytest.mark.parametrize("com", [0.09, 0.7131])
def test_the_robot_sees_the_published_pixels(task: str, com: float) -> None:
    origin = float(dittogym.make_spec(task).window.origin(torch.tensor([[com, 0.2]], dtype=torch.float64))[0, 0])
    assert torch.equal(drawn_pixels(task, origin), published_pixels(task, origin))


@pytest.mark.parametrize("task", dittogym.TASKS)
def test_starts_are_alike_where_the_task_says_so(task):
    env = dittogym.TorchEnv(task, 2, particles=100, substeps=1)
    env.reset(seed=[0, 1])
    alike = torch.equal(*env.state.x)
    assert env.spec.starts_alike == alike == (task in ("grow", "obstacle"))
