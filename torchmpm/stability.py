"""The largest stable substep, and the largest gravity."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchmpm import checks
from torchmpm.materials.base import Value, detached_column
from torchmpm.materials.body import Body


def stable_dt(bodies: Sequence[Body], h: float, actuation: Value = 0.0) -> float:
    """Largest duration of a substep for which small strains of undeformed material do not grow, s.

    ``h / sqrt((k + 2 |a|) V / m)``, least over all particles, with the stiffness k = 2 (mu + lam) and the actuation a.
    It holds for any arrangement of particles: the strain rate C of a particle cannot exceed what the kinetic energy of
    its nodes allows, ``h^2/4 |C|^2 <= sum w |v_i|^2``, and a particle alone reaches that.
    """
    checks.entries("actuation", actuation)
    rates, pull = [0.0], torch.as_tensor(detached_column(actuation), dtype=torch.float64, device="cpu").abs()
    for k, body in enumerate(bodies):
        own = body.material.stiffness()
        checks.value(f"stiffness() of bodies[{k}].material", own)
        try:
            stiffness = detached_column(own)
            if body.muscle:
                stiffness = stiffness + 2.0 * pull
            rate = stiffness * detached_column(body.volume) / detached_column(body.mass)
        except RuntimeError as error:
            raise ValueError(f"values of bodies[{k}] must have shapes that go together: {error}") from error
        rate = torch.as_tensor(rate, dtype=torch.float64, device="cpu")
        if not bool(((rate >= 0) & torch.isfinite(rate)).all()):
            raise ValueError(
                f"values of bodies[{k}] must be finite, its mass and volume positive and its stiffness not "
                f"negative, got stiffness x volume / mass from {rate.min().item():g} to {rate.max().item():g}"
            )
        rates.append(float(rate.max()))
    fastest = math.sqrt(max(rates))
    return h / fastest if fastest > 0 else math.inf


def check_gravity(name: str, gravity: tuple[float, float] | Tensor, h: float, dt: float) -> None:
    """Raise a ValueError if a particle at rest would cross a cell of width ``h``, m, within a substep of ``dt``, s."""
    largest = h / dt**2
    for part in (gravity,) if isinstance(gravity, Tensor) else gravity:
        checks.entries(f"{name}, with substeps of {dt} s,", part, above=-largest, below=largest)
