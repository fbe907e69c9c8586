"""The moving part of a simulation: one batch of particles."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from multiprocessing.reduction import ForkingPickler
from numbers import Integral
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmpm import checks, tree
from torchmpm.native.library import leave_parent_threads

#: Trailing shape of every field after the leading (B, N).
_TRAILING = {"x": (2,), "v": (2,), "C": (2, 2), "F": (2, 2), "Jp": ()}


@tree.register
@dataclass(frozen=True, eq=False)
class ParticleState:
    """Positions, velocities and deformation of B independent simulations with N particles each.

    Particles lie in the order of the solver's bodies. ``state[index]`` selects simulations of the batch.

    The solver stores each component of a vector or matrix contiguously behind these shapes (strides, not copies),
    because its arithmetic runs over whole components. A field of a result is therefore a view that keeps the memory of
    all fields alive: to store only the positions of many states, store ``state.x.clone()``.

    Attributes:
        x: (B, N, 2) positions (x, y) in the world, m.
        v: (B, N, 2) velocities, m/s.
        C: (B, N, 2, 2) affine velocity matrix of APIC (Jiang et al., 2015), 1/s; ``C[..., i, j]`` approximates the
            derivative of velocity component i along axis j.
        F: (B, N, 2, 2) elastic part of the deformation gradient, dimensionless.
        Jp: (B, N) plastic volume ratio, dimensionless, 1 at rest; only :class:`torchmpm.Snow` changes it.

    Raises:
        ValueError: A field has the wrong shape, is neither float32 nor float64, or dtype or device differ between
            fields.
        TypeError: A field is not a dense tensor.

    Examples:
        >>> import torch, torchmpm
        >>> state = torchmpm.ParticleState.at_rest(torch.rand(8, 1000, 2))  # eight simulations
        >>> state.F.shape, bool(state.v.any())
        (torch.Size([8, 1000, 2, 2]), False)
    """

    x: Float[Tensor, "B N 2"]
    v: Float[Tensor, "B N 2"]
    C: Float[Tensor, "B N 2 2"]
    F: Float[Tensor, "B N 2 2"]
    Jp: Float[Tensor, "B N"]

    def __post_init__(self) -> None:
        checks.tensor("x", self.x)
        if self.x.ndim != 3 or self.x.shape[-1] != 2:
            raise ValueError(f"x must have shape (B, N, 2), got {tuple(self.x.shape)}")
        if self.x.dtype not in (torch.float32, torch.float64):  # half precision would lose what a substep adds
            raise ValueError(f"x must be float32 or float64, got {self.x.dtype}")
        for name, trailing in _TRAILING.items():
            field = getattr(self, name)
            checks.tensor(name, field)
            if field.shape != (*self.x.shape[:2], *trailing):
                raise ValueError(
                    f"{name} must have shape {(*self.x.shape[:2], *trailing)} to go with x of shape "
                    f"{tuple(self.x.shape)}, got {tuple(field.shape)}"
                )
            if field.dtype != self.x.dtype or field.device != self.x.device:
                raise ValueError(
                    f"{name} is {field.dtype} on {field.device}, but x is {self.x.dtype} on {self.x.device}"
                )

    def __repr__(self) -> str:
        """Sizes, type and device; the numbers would fill pages."""
        sizes = f"batch_size={self.batch_size}, num_particles={self.num_particles}"
        return f"{type(self).__name__}({sizes}, dtype={self.dtype}, device={str(self.device)!r})"

    @classmethod
    def at_rest(cls, x: Float[Tensor, "*B N 2"]) -> ParticleState:
        """Return undeformed particles without velocity: v = C = 0, F = I and Jp = 1.

        Args:
            x: (B, N, 2) or (N, 2) positions in the world, m; (N, 2) becomes a batch of one.

        Returns:
            A state whose fields have the dtype and device of ``x``.

        Raises:
            ValueError: ``x`` has another shape, or is neither float32 nor float64.
            TypeError: ``x`` is not a dense tensor.
        """
        leave_parent_threads()
        checks.tensor("x", x)
        if x.ndim not in (2, 3) or x.shape[-1] != 2:
            raise ValueError(f"x must have shape (B, N, 2) or (N, 2), got {tuple(x.shape)}")
        x = x[None] if x.ndim == 2 else x
        batch, count = x.shape[:2]
        C, F = x.new_zeros(batch, count, 2, 2), torch.eye(2, dtype=x.dtype, device=x.device).repeat(batch, count, 1, 1)
        return cls(x=x, v=torch.zeros_like(x), C=C, F=F, Jp=x.new_ones(batch, count))

    @property
    def batch_size(self) -> int:
        """B, the number of independent simulations."""
        return self.x.shape[0]

    @property
    def num_particles(self) -> int:
        """N, the number of particles of each simulation."""
        return self.x.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Floating point type shared by all fields."""
        return self.x.dtype

    @property
    def device(self) -> torch.device:
        """Device shared by all fields."""
        return self.x.device

    def to(self, *args: Any, **kwargs: Any) -> ParticleState:
        """Convert all fields to another dtype or device, as :meth:`torch.Tensor.to` does.

        Args:
            args: Positional arguments of :meth:`torch.Tensor.to`, such as a dtype or a device.
            kwargs: Keyword arguments of :meth:`torch.Tensor.to`.

        Returns:
            A new state, whose fields are the same tensors where nothing had to be converted.

        Raises:
            ValueError: The dtype is neither float32 nor float64.
        """
        moved: ParticleState = tree.map(lambda t: t.to(*args, **kwargs), self)
        return replace(moved)

    def detach(self) -> ParticleState:
        """Return a state with the same numbers that is detached from the autograd graph."""
        return tree.detach(self)

    def clone(self) -> ParticleState:
        """Return a copy with memory of its own; gradients flow through it, as through :meth:`torch.Tensor.clone`."""
        return tree.map(Tensor.clone, self)

    def __reduce__(self) -> tuple[type[ParticleState], tuple[Tensor, ...]]:
        """Pickle the fields, unless they are part of an autograd graph."""
        tree.refuse_graph("a ParticleState", self)
        # Copies, as views would bring along all that they are views of; leaves, as the fields are.
        own = [getattr(self, f.name) for f in fields(self)]
        return ParticleState, tuple(t.detach().clone().requires_grad_(t.requires_grad) for t in own)

    def __getitem__(self, index: Any) -> ParticleState:
        """Select simulations of the batch.

        Args:
            index: A number, which keeps a batch of one, or a slice, a list or a tensor of numbers or bools.

        Returns:
            A state of the selected simulations, indexed as torch indexes the first dimension of each field.

        Raises:
            IndexError: There is no such batch element, or the index has several dimensions or is a tuple, string or
                bool.
        """
        if isinstance(index, tuple | bool | str):  # a tuple would select particles, a bool count as 0 or 1
            raise IndexError(f"index must be a number, slice, list or tensor, got {index!r}")
        if isinstance(index, Tensor | np.ndarray) and index.ndim == 0 and index.dtype not in (bool, torch.bool):
            index = index.item()
        if isinstance(index, Integral):
            index = int(index)
            if not -self.batch_size <= index < self.batch_size:
                raise IndexError(f"index {index} is out of range for a batch of {self.batch_size}")
            index = slice(index, index + 1 or None)
        if self.x[index].ndim != self.x.ndim:
            raise IndexError(f"index must select batch elements, by one dimension, got {index!r}")
        return tree.map(lambda t: t[index], self)

    def where(self, mask: Bool[Tensor, " B"], other: ParticleState) -> ParticleState:
        """Choose for each simulation between this state and another one.

        Args:
            mask: (B,) bool, true for the simulations that are taken from this state.
            other: The state of the others, with the same B, N and dtype.

        Returns:
            A new state; gradients flow into the chosen simulations of both.

        Raises:
            ValueError: ``mask`` is not bool of shape (B,), or ``other`` has another B, N or dtype.
            TypeError: ``mask`` is not a tensor.
        """
        return tree.where(mask, self, other)

    def is_finite(self) -> Bool[Tensor, " B"]:
        """Return which simulations hold finite numbers only, (B,) bool."""
        # Zero times a finite number is zero and zero times anything else is NaN, which the sum keeps.
        return (self.stack().detach() * 0.0).sum((0, 2)) == 0.0

    def components(self) -> tuple[Tensor, ...]:
        """The 13 components, each (B, N): x, v, C and F row by row, Jp."""
        fields = (self.x, self.v, self.C.flatten(-2), self.F.flatten(-2))
        return (*(component for field in fields for component in field.unbind(-1)), self.Jp)

    @classmethod
    def from_stack(cls, stacked: Tensor) -> ParticleState:
        """Inverse of :meth:`stack`; the fields are views of the tensor (13, B, N), whose components stay contiguous."""
        vector, matrix = (lambda p: p.movedim(0, -1)), (lambda p: p.movedim(0, -1).unflatten(-1, (2, 2)))
        x, v, C, F = vector(stacked[0:2]), vector(stacked[2:4]), matrix(stacked[4:8]), matrix(stacked[8:12])
        return tree.unchecked(cls, x, v, C, F, stacked[12])

    def stack(self) -> Tensor:
        """The :meth:`components` as one tensor (13, B, N)."""
        return torch.stack(self.components())


torch.serialization.add_safe_globals([ParticleState])  # its tensors are all that a file holds of it


def _shared(state: ParticleState) -> tuple[type[ParticleState], tuple[Tensor, ...]]:
    """As :meth:`ParticleState.__reduce__`, for a process that is to share the memory of the fields.

    That of copies would be freed before the process has opened it.
    """
    tree.refuse_graph("a ParticleState", state)
    return ParticleState, tuple(getattr(state, field.name) for field in fields(state))


ForkingPickler.register(ParticleState, _shared)
