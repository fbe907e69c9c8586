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
    """Interface of a constitutive law: any object with these four methods is a material.

    A matrix is given as its components: ``F`` is the tuple (F11, F12, F21, F22) of tensors (B, N), and a symmetric
    matrix is the tuple (xx, xy, yy), here for the N particles of a body. The backend ``"eager"`` runs any material; the
    native kernels run :class:`torchmpm.Elastic`, :class:`torchmpm.VonMises` and :class:`torchmpm.Snow` only. A material
    may also have the two methods ``resolved_stress`` and ``unresolved`` of :class:`torchmpm.Snow`, which limit its
    gradients.
    """

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Bring a trial deformation gradient back to the elastic range, by plastic flow.

        Args:
            F: Components (B, N) of ``(I + dt C) F``, the deformation gradient after an elastic substep.
            Jp: (B, N) plastic volume ratio.

        Returns:
            The components (B, N) of the new elastic deformation gradient, and the new ``Jp`` (B, N).
        """

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Return the Kirchhoff stress, the derivative of :meth:`energy` in F times the transpose of F.

        Args:
            F: Components (B, N) of the deformation gradient after :meth:`return_map`.
            Jp: (B, N) plastic volume ratio before :meth:`return_map`.

        Returns:
            Components (xx, xy, yy), (B, N) each, Pa.
        """

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Return the stored energy per unit of undeformed volume.

        Args:
            F: Components (B, N) of the elastic deformation gradient.
            Jp: (B, N) plastic volume ratio.

        Returns:
            (B, N), J/m^2 (two-dimensional).
        """

    def stiffness(self) -> Value:
        """Return the largest ratio of stress to strain (Frobenius norms) in undeformed material, for the stable ``dt``.

        Returns:
            A number or a tensor of shape (), (B,), (B, 1), (B, count) or (1, count), Pa.
        """


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
    """Return the Lame parameters of a material in plane strain.

    They are ``mu = young / (2 (1 + poisson))`` and ``lam = young poisson / ((1 + poisson) (1 - 2 poisson))``.

    Args:
        young: Young's modulus, Pa, not negative; a number or a tensor of any shape, such as (B,).
        poisson: Poisson's ratio, above -1 and below 0.5; a number, or a tensor whose shape broadcasts with ``young``.

    Returns:
        mu and lam, Pa, in this order; tensors if an argument is one.

    Raises:
        ValueError: A number, or an entry of a tensor, is out of range.
        TypeError: A tensor is not dense.

    Examples:
        >>> import torchmpm
        >>> mu, lam = torchmpm.lame(young=1000.0, poisson=0.25)
        >>> mu, lam
        (400.0, 400.0)
    """
    checks.entries("young", young, least=0.0)
    checks.entries("poisson", poisson, above=-1.0, below=0.5)
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def broadcast_plane(value: Value, like: Tensor, name: str = "value") -> Value:
    """Bring a constant of a material to a shape that broadcasts against components (B, N).

    Args:
        value: The constant, a number or a tensor, see :data:`torchmpm.materials.base.Value`.
        like: (B, N), whose shape, dtype and device the result goes with.
        name: Name of the constant in error messages.

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
    """Bring a constant to the form in which the stable ``dt`` is computed; for :meth:`torchmpm.Material.stiffness`.

    Args:
        value: The constant, a number or a tensor, see :data:`torchmpm.materials.base.Value`.

    Returns:
        The number itself; or the tensor in float64, on the CPU and without graph, with (B,) as (B, 1), so that it
        broadcasts against constants of other shapes.
    """
    if not isinstance(value, Tensor):
        return value
    value = value.detach().to("cpu", torch.float64)
    return value[:, None] if value.ndim == 1 else value


def check_not_negative(material: object, *names: str) -> None:
    """Raise a ValueError if a constant of a material is negative or not a number."""
    for name in names:
        checks.entries(name, getattr(material, name), least=0.0)
