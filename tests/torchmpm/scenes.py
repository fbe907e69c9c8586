"""Small scenes that several test files simulate."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Solver, VelocityRule, VonMises

#: Tensors by name, in which a loss may be differentiated.
Leaves = dict[str, Tensor]
GRID = Grid(16)
#: Of the solvers made here, unless a test says otherwise; some files run their tests once with each.
BACKEND = "eager"
FLOOR = VelocityRule("-y", j=(None, 4))


def generator(seed: int) -> torch.Generator:
    """A generator of its own for each test."""
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Normally distributed numbers."""
    return torch.randn(shape, generator=generator(seed), dtype=dtype)


def planes(F: Tensor) -> tuple[Tensor, ...]:
    """The entries of matrices (..., 2, 2), row by row."""
    return tuple(F.flatten(-2).unbind(-1))


def matrix(planes: tuple[Tensor, ...]) -> Tensor:
    """Inverse of `planes`."""
    return torch.stack(planes, -1).unflatten(-1, (2, 2))


def turn(angle: Tensor | float) -> Tensor:
    """Rotations (..., 2, 2)."""
    angle = torch.as_tensor(angle, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    return matrix((c, -s, s, c))


def positions(count: int, batch: int = 1, corner: tuple[float, float] = (0.35, 0.35), seed: int = 0) -> Tensor:
    """(B, N, 2) random positions in a box of 0.3 m, far from the ends of the window."""
    return torch.tensor(corner) + 0.3 * torch.rand(batch, count, 2, generator=generator(seed), dtype=torch.float64)


def lively(
    count: int, batch: int = 1, *, corner: tuple[float, float] = (0.35, 0.35), strain: float = 0.05, seed: int = 0
) -> ParticleState:
    """Particles in a box with random velocities, affine matrices and deformations (det F > 0)."""
    draw = generator(seed)

    def noise(*trailing: int) -> Tensor:
        return torch.randn(batch, count, *trailing, generator=draw, dtype=torch.float64)

    drift = torch.tensor([0.5, -0.8], dtype=torch.float64)
    return ParticleState(
        x=positions(count, batch, corner, seed),
        v=drift + 0.3 * noise(2),
        C=2.0 * noise(2, 2),
        F=torch.eye(2, dtype=torch.float64) + strain * noise(2, 2),
        Jp=torch.ones(batch, count, dtype=torch.float64),
    )


def robot(count: int, **changes: object) -> Solver:
    """One yielding body with muscles under gravity, with a sticky floor that cuts through its lower part."""
    body = Body(count, VonMises(500.0, 50.0, 60.0), mass=2.0, muscle=True)
    options: dict[str, object] = {
        "grid": GRID,
        "bodies": (body,),
        "gravity": (0.5, -9.8),
        "rules": (VelocityRule("-y", j=(None, 6), friction=float("inf")),),
        "backend": BACKEND,
    }
    return Solver(**(options | changes))


def robot_and_ball(robot_count: int, ball_count: int, **changes: object) -> Solver:
    """A robot and an elastic body of another mass, volume and stiffness."""
    ball = Body(ball_count, Elastic(300.0, 80.0), mass=5.0, volume=1.5)
    return robot(robot_count, bodies=(*robot(robot_count).bodies, ball), **changes)


def combination(state: ParticleState, seed: int, **sizes: float) -> Tensor:
    """A random combination of fields, each times a factor that brings them to one size, so that none drowns others."""
    fields = enumerate((getattr(state, name), size) for name, size in sizes.items())
    return sum(size * (normal(*t.shape, seed=seed + k).to(t) * t).sum() for k, (t, size) in fields)


def assert_slope(
    loss: Callable[[Leaves], Tensor], given: Leaves, name: str, gradient: Tensor, step: float, rounding: float = 0.0
) -> None:
    """Compare a gradient with a central difference in a random direction, to 1e-5 and the rounding of the loss."""
    direction = normal(*given[name].shape, seed=20)
    ahead, behind = (loss(given | {name: given[name] + side * step * direction}).item() for side in (1, -1))
    slope, difference = (gradient * direction).sum().item(), (ahead - behind) / (2 * step)
    assert abs(slope - difference) <= 1e-5 * abs(difference) + rounding * max(abs(ahead), 1.0) / step, name


def assert_close(first: ParticleState, second: ParticleState, tolerance: float) -> None:
    """Compare all fields, relative to the largest number of each field."""
    for name in ("x", "v", "C", "F", "Jp"):
        one, other = getattr(first, name), getattr(second, name)
        error = (one - other).abs().max().item() / max(other.abs().max().item(), 1.0)
        assert error <= tolerance, f"{name} differs by {error:.2e} of its largest number"


def assert_as_precise(native: ParticleState, eager: ParticleState, exact: ParticleState) -> None:
    """As near to double precision as the plain substep is in single precision, give or take a factor of three."""
    for name in ("x", "v", "C", "F", "Jp"):
        true = getattr(exact, name)
        mine, plain = ((getattr(state, name).double() - true).norm() for state in (native, eager))
        assert mine <= 3.0 * plain + 1e-6 * true.norm(), name


def assert_identical(first: ParticleState, second: ParticleState) -> None:
    """Compare all fields bit by bit."""
    for name in ("x", "v", "C", "F", "Jp"):
        assert torch.equal(getattr(first, name), getattr(second, name)), f"{name} differs"
