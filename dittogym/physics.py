"""Material parameters and gravity that may differ between the simulations of a batch (domain randomisation)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dittogym.copies import constant
from dittogym.spec import TaskSpec
from torchmpm import Body, Elastic, VonMises, checks, tree

#: Values by name, (B,) or (B, N) each; ``gravity`` (B, 2).
Physics: TypeAlias = Mapping[str, Tensor]

#: What can be set: Lame parameters of the robot and of objects without a material of their own, Pa; yield stress and
#: muscle limit of the robot, Pa; gravity, m/s^2; and a factor on the mass of all particles.
NAMES = ("mu", "lam", "yield_stress", "max_actuation", "gravity", "mass")
#: What values must be. Sums over particles with a factor of 1e6 on their mass, far above any use, overflow in float32.
_RANGES: dict[str, dict[str, float]] = {
    "mu": {"above": 0.0},
    "yield_stress": {"least": 0.0},
    "max_actuation": {"least": 0.0},
    "mass": {"above": 0.0, "below": 1e6},
}
#: Those that may differ between the particles of a body.
PER_PARTICLE = ("mu", "lam", "yield_stress", "mass")


def value_of(name: str, physics: Physics, spec: TaskSpec, like: Tensor) -> Tensor:
    """One of :data:`NAMES` for B simulations, B the length of ``like``: the task's own value unless physics hold it."""
    if name in physics:
        return physics[name]
    own = getattr(spec, name, 1.0)  # a factor of 1 on the mass
    return _expanded(constant(own, like), name, len(like))


def physics_values(given: Any, particles: int, like: Tensor) -> dict[str, Tensor]:
    """Check constants of the matter and bring them to one value per simulation or particle.

    Gradients flow from the result to the given values.

    Args:
        given: A mapping with any of ``"mu"`` and ``"lam"``, the Lame parameters of the robot and of an object without a
            material of its own, Pa; ``"yield_stress"`` and ``"max_actuation"`` of the robot, Pa; ``"mass"``, a factor
            on the masses of all particles; and ``"gravity"``, (x, y) in m/s^2. Values are numbers, arrays or tensors of
            shape () or (B,), for gravity (2,) or (B, 2). ``mu``, ``lam``, ``yield_stress`` and ``mass`` may also be
            (B, N), one value for each particle, robot first. Of particles whose body has a material of its own, such as
            the soil of DIG, only the mass has an effect; the yield stress of an object has none.
        particles: N, the number of particles.
        like: (B,), whose dtype and device the result has.

    Returns:
        Tensors by name, (B,) or (B, N) each; gravity (B, 2).

    Raises:
        ValueError: ``given`` is not a mapping, a name is unknown, or a value has the wrong shape, is not finite or is
            out of range: ``mu`` and ``mass`` must be positive, ``yield_stress`` and ``max_actuation`` not negative.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"physics must be a mapping from {', '.join(NAMES)} to values, got {type(given).__name__}")
    values, batch = {}, len(like)
    for name, value in given.items():
        if name not in NAMES:
            raise ValueError(f"physics may hold {', '.join(NAMES)}, got {name!r}")
        tensor = real_tensor(f"physics[{name!r}]", value).to(like, copy=True)
        own = (2,) if name == "gravity" else ()
        allowed_shapes = [own, (batch, *own), *([(batch, particles)] if name in PER_PARTICLE else [])]
        if tuple(tensor.shape) not in allowed_shapes:
            shapes = " or ".join(map(str, allowed_shapes))
            raise ValueError(f"physics[{name!r}] must have shape {shapes}, got {tuple(tensor.shape)}")
        checks.entries(f"physics[{name!r}]", tensor, **_RANGES.get(name, {}))
        values[name] = _expanded(tensor, name, batch)
    return values


def check_effect(spec: TaskSpec, physics: Physics) -> None:
    """Refuse constants that no body takes, as all have materials of their own, and warn of those that no robot takes.

    Raises:
        ValueError: There is such a constant, or ``lam`` is below ``-mu``.
    """
    for name in physics:
        if not has_effect(spec, name):
            raise ValueError(f"physics may not hold {name!r} in {spec.name}, whose bodies have their own materials")
        if name in ("mu", "lam") and spec.robot.material is not None:
            alone = f"physics[{name!r}] changes the object of {spec.name} alone, not the robot with its own material"
            warnings.warn(alone, stacklevel=3)  # where TorchEnv.reset is called
    if physics.keys() & {"mu", "lam"}:
        like = next(iter(physics.values()))
        mu, lam = _broadcast_pair(*(value_of(name, physics, spec, like).detach() for name in ("mu", "lam")))
        if bool((low := lam < -mu).any()):
            least = f"-mu, {-mu[low][0].item():g}"
            raise ValueError(f"physics['lam'] must be at least {least}, got {lam[low][0].item():g}")


def has_effect(spec: TaskSpec, name: str) -> bool:
    """Whether a body takes the constant ``name``; one with a material of its own takes no others."""
    takers = {"mu": spec.bodies, "lam": spec.bodies, "yield_stress": (spec.robot,)}.get(name)
    return takers is None or any(body.material is None for body in takers)


def real_tensor(name: str, given: Any) -> Tensor:
    """A tensor as it is; numbers, lists and arrays in float64, whatever torch's default is."""
    if isinstance(given, Tensor):
        if given.is_complex() or given.dtype == torch.bool:
            raise ValueError(f"{name} must be real numbers, got {given.dtype}")
        return given
    try:
        array = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:  # rows of different lengths, tensors that have a gradient
        raise ValueError(f"{name} must be numbers, got {given!r}") from error
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} must be real numbers, got {given!r}")
    # A copy: torch takes neither negative strides nor foreign byte orders.
    return torch.from_numpy(np.array(array, np.float64, order="C"))


def merged(spec: TaskSpec, old: Physics, new: Physics, mask: Tensor, like: Tensor) -> dict[str, Tensor]:
    """``new`` where ``mask`` (B,) holds, ``old`` elsewhere; the task's own value where one of them has none."""
    names = [name for name in NAMES if name in old or name in new]
    pairs = {name: _broadcast_pair(*(value_of(name, each, spec, like) for each in (new, old))) for name in names}
    return {name: tree.where(mask, *pair) for name, pair in pairs.items()}


def bodies_of(spec: TaskSpec, counts: tuple[int, ...], physics: Physics) -> tuple[Body, ...]:
    """Robot and objects as the solver has them, with ``physics`` in place of the task's own constants.

    The full-size particles that a particle of each body stands for are a factor on its mass and volume, so that density
    and stiffness mean the same for every particle count.
    """
    values = {name: getattr(spec, name) for name in ("mu", "lam", "yield_stress")} | {"mass": 1.0} | dict(physics)
    # Those of a reset were checked there; to check them in every step would wait for a GPU.
    make: Callable[..., Any] = tree.unchecked if physics else lambda kind, *values: kind(*values)
    bodies: list[Body] = []
    for body, count in zip(spec.bodies, counts, strict=True):
        weight = body.count / count
        first, robot = sum(earlier.count for earlier in bodies), not bodies
        own = {name: _part_of(value, slice(first, first + count)) for name, value in values.items()}
        kind, constants = (VonMises, ("mu", "lam", "yield_stress")) if robot else (Elastic, ("mu", "lam"))
        default = make(kind, *(own[name] for name in constants))
        material = default if body.material is None else body.material
        bodies.append(make(Body, count, material, weight * body.mass * own["mass"], weight, robot))
    return tuple(bodies)


def _part_of(value: float | Tensor, particles: slice) -> float | Tensor:
    """The part of a value that belongs to some of the particles."""
    return value[:, particles] if isinstance(value, Tensor) and value.ndim == 2 else value


def _broadcast_pair(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Values of one shape: where one has a value per particle, both have."""
    if one.ndim == other.ndim:
        return one, other
    return (one[:, None].expand_as(other), other) if one.ndim == 1 else (one, other[:, None].expand_as(one))


def _expanded(value: Tensor, name: str, batch: int) -> Tensor:
    if value.ndim == 2:
        return value
    return value.expand(batch, 2) if name == "gravity" else value.expand(batch)
