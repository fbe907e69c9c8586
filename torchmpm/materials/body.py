"""Bodies: runs of consecutive particles of one material."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchmpm import checks, tree
from torchmpm.materials.base import Material, Value, broadcast_plane

#: Methods of a :class:`torchmpm.Material`.
METHODS = ("return_map", "stress", "energy", "stiffness")


@tree.register
@dataclass(frozen=True, eq=False)
class Body:
    """Consecutive particles of one material.

    Attributes:
        count: Number of particles.
        material: Constitutive law: :class:`torchmpm.Elastic`, :class:`torchmpm.VonMises`, :class:`torchmpm.Snow`, or
            another :class:`torchmpm.Material`.
        mass: Mass of a particle, kg; a number or a tensor of shape (), (B,), (B, 1), (B, count) or (1, count). With
            less than about 1e-5 kg particles lose momentum, as 1e-10 kg are added to the mass of each node: a disc of
            radius 0.03 m with ten in a cell loses 2 % in 10,000 substeps at 1e-5 kg, 18 % at 1e-6 kg.
        volume: Undeformed volume of a particle, m^2 (two-dimensional); a number or a tensor of those shapes.
        muscle: Whether the actuation of :meth:`torchmpm.Solver.step` acts on the particles.

    Raises:
        ValueError: ``count`` is below 1, ``mass`` or ``volume`` is not positive, or ``muscle`` is not True or False.
        TypeError: ``material`` is not a :class:`torchmpm.Material`, or a tensor is not dense.

    Examples:
        A disc of 1,000 particles with the density of water, 1,000 kg/m^2:

        >>> import math, torchmpm
        >>> volume = math.pi * 0.05**2 / 1000
        >>> body = torchmpm.Body(1000, torchmpm.Elastic(mu=2e4, lam=2e4), mass=1000 * volume, volume=volume)
    """

    count: int
    material: Material
    mass: Value = 1.0
    volume: Value = 1.0
    muscle: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "count", checks.whole("count", self.count, 1))
        if isinstance(self.material, type):
            raise TypeError(f"material must be a Material, got the class {self.material.__name__}")
        if lacking := [name for name in METHODS if not callable(getattr(self.material, name, None))]:
            found = f"{self.material!r:.60}, which has no method {', '.join(lacking)}"
            raise TypeError(f"material must be a Material, got {found}")
        for name in ("mass", "volume"):
            checks.entries(name, getattr(self, name), above=0.0)
        checks.flag("muscle", self.muscle)

    def constants(self) -> dict[str, Value]:
        """Constants of the body and its material by name, such as ``material.mu``; numbers, (), (B,) or (B, count)."""
        own = {name: getattr(self, name) for name in ("mass", "volume")}
        return own | dict(_constants("material", self.material))


def _constants(name: str, holder: Any) -> Iterator[tuple[str, Value]]:
    """Numbers and tensors of a material, and of the modules and dataclasses that it holds."""
    if isinstance(holder, nn.Module):
        for part, module in holder.named_modules(prefix=name):
            tensors = (*module.named_parameters(part, recurse=False), *module.named_buffers(part, recurse=False))
            yield from (*tensors, *((f"{part}.{key}", v) for key, v in vars(module).items() if isinstance(v, Tensor)))
        return
    names = [each.name for each in fields(holder)] if is_dataclass(holder) else getattr(holder, "__dict__", {})
    for key in names:
        value = getattr(holder, key)
        if isinstance(value, nn.Module) or (is_dataclass(value) and not isinstance(value, type)):
            yield from _constants(f"{name}.{key}", value)
        else:
            yield f"{name}.{key}", value


def slices(bodies: Sequence[Body]) -> Iterator[tuple[Body, slice]]:
    """The bodies with their ranges of particles."""
    start = 0
    for body in bodies:
        yield body, slice(start, start + body.count)
        start += body.count


def per_particle(bodies: Sequence[Body], name: str, like: Tensor) -> Tensor:
    """The constant ``name`` of the bodies over all particles, (1, N) or (B, N); ``like`` is (B, N)."""
    like = like.detach()
    columns = []
    for body, part in slices(bodies):
        value = broadcast_plane(getattr(body, name), like[:, part], name)
        columns.append(value * torch.ones_like(like[:1, part]))
    batch = max(len(column) for column in columns)
    return torch.cat([column.expand(batch, -1) for column in columns], dim=1)
