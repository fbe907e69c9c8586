"""The interface of materials, and the shapes of their constants."""

from typing import Any, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from torchmpm import checks
from torchmpm.materials.linalg import Mat2, Sym2

#: A number, or a tensor: of shape () for one value, (B,) or (B, 1) for one per simulation, (B, count) for one per
#: particle of a body, or (1, count) for the same in all simulations.
Value: TypeAlias = float | Tensor


@runtime_checkable  # for checks of annotations, as the tests make them
class Material(Protocol):
    """Interface of a constitutive law.

    All methods take ``F``, the components (B, N) of a deformation gradient, and ``Jp``, the plastic volume ratio
    (B, N). The backend ``"eager"`` runs any material; the native kernels know those named in
    ``torchmpm/native/tables.py``. A material may limit derivatives to the motion that a substep resolves, with the
    methods ``resolved_stress`` and ``unresolved`` that :class:`torchmpm.Snow` has.
    """

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Project the trial ``F`` onto the elastic range; returns the new components (B, N) and ``Jp`` (B, N)."""

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress of the projected ``F``, components (B, N), Pa; ``Jp`` is from before the projection."""

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F`` and ``Jp``, (B, N), J/m^2 (two-dimensional)."""

    def stiffness(self) -> Value:
        """Largest ratio of stress to strain (Frobenius norms) in undeformed material, Pa."""


def try_law(material: Material, F: Mat2, Jp: Tensor) -> None:
    """Call a material once, with components (B, N), and raise a TypeError unless it returns as many of their kind.

    Of another shape they could broadcast, and of another dtype they would convert the state.
    """
    with torch.no_grad():
        a, b, c, d = (component.clone() for component in F)  # the law may change them in place
        returned: Any = material.return_map((a, b, c, d), Jp.clone())
        if _kind_of(returned) != _kind_of((F, Jp)):
            allowed = f"(F, Jp), four tensors and one, all {_kind_of(Jp)}"
            raise TypeError(f"return_map of {type(material).__name__} must return {allowed}, got {_kind_of(returned)}")
        stress = material.stress(returned[0], Jp.clone())
        if _kind_of(stress) != _kind_of((Jp,) * 3):
            allowed = f"three tensors, all {_kind_of(Jp)}"
            raise TypeError(f"stress of {type(material).__name__} must return {allowed}, got {_kind_of(stress)}")


def _kind_of(given: Any) -> str:
    """Types and shapes of tensors and tuples of them."""
    if isinstance(given, tuple):
        return f"({', '.join(map(_kind_of, given))})"
    return f"{given.dtype} of shape {tuple(given.shape)}" if isinstance(given, Tensor) else type(given).__name__


def lame(young: Value, poisson: Value) -> tuple[Value, Value]:
    """Lame parameters in plane strain.

    Args:
        young: Young's modulus, Pa; a number or a tensor of any shape, such as (B,).
        poisson: Poisson's ratio, between -1 and 0.5; likewise a number or a tensor.

    Returns:
        (mu, lam) in Pa, numbers or tensors of the arguments' shape.

    Raises:
        ValueError: A number is out of range, or one of a tensor.
    """
    checks.entries("young", young, least=0.0)
    checks.entries("poisson", poisson, above=-1.0, below=0.5)
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def broadcast_plane(value: Value, like: Tensor, name: str = "value") -> Value:
    """Bring a constant to a shape that broadcasts against components (B, N).

    Args:
        value: The constant.
        like: (B, N), gives shape, dtype and device.
        name: Its name in error messages.

    Returns:
        The number itself, or a tensor of shape (), (B, 1), (B, N) or (1, N).

    Raises:
        ValueError: A tensor has a shape other than (), (B,), (B, 1), (B, N) or (1, N).
    """
    if not isinstance(value, Tensor):
        return value
    value = value.to(like)
    batch, count = like.shape
    if value.ndim == 1 and value.shape[0] == batch:
        return value[:, None]
    if value.ndim == 0 or (value.ndim == 2 and value.shape[0] in (1, batch) and value.shape[1] in (1, count)):
        return value
    *shapes, last = dict.fromkeys(((), (batch,), (batch, 1), (batch, count), (1, count)))
    allowed = f"{', '.join(map(str, shapes))} or {last}"
    of = f"{batch} simulation{'s' * (batch > 1)} of {count} particles"
    raise ValueError(f"{name} must be a number or have shape {allowed} for {of}, got {tuple(value.shape)}")


def detached_column(value: Value) -> Value:
    """A constant in float64 on the CPU, without graph; (B,) becomes (B, 1), so that it broadcasts against others."""
    if not isinstance(value, Tensor):
        return value
    value = value.detach().to("cpu", torch.float64)
    return value[:, None] if value.ndim == 1 else value


def check_not_negative(material: object, *names: str) -> None:
    """Raise a ValueError if a constant of a material is negative or not a number."""
    for name in names:
        checks.entries(name, getattr(material, name), least=0.0)
