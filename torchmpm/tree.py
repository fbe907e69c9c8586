"""States as pytrees: nested containers of tensors that functions map over leaf by leaf.

Dataclasses registered here, tuples, named tuples, lists and dictionaries are all containers. The registry is the one
that ``torch.func``, ``torch.utils.checkpoint`` and ``torch.compile`` consult. It lives in ``torch.utils._pytree``: no
release of torch offers it under a public name, and a second registry would not be seen by those functions.
"""

import functools
from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual
from torch.fx.experimental.proxy_tensor import get_proxy_mode
from torch.utils import _pytree as pytree

Tree = TypeVar("Tree")
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
#: Results that a function of :func:`cached_tensors` keeps.
LARGEST_CACHE = 64


def register(cls: type[Tree]) -> type[Tree]:
    """Class decorator that registers a dataclass as a pytree whose children are its fields that are not ``None``.

    Instances rebuilt from leaves are those of :func:`unchecked`, because transforms such as ``torch.func.vmap`` put
    leaves of other shapes in their place.

    Args:
        cls: A dataclass whose fields are tensors, containers of tensors, or plain values, which are leaves.
    """
    names = [field.name for field in fields(cls)]  # type: ignore[arg-type]

    def flatten(instance: Tree) -> tuple[list[Any], tuple[str, ...]]:
        # None is no leaf, as torch.func.vmap refuses leaves that are not tensors.
        given = tuple(name for name in names if getattr(instance, name) is not None)
        return [getattr(instance, name) for name in given], given

    def unflatten(children: Iterable[Any], given: tuple[str, ...]) -> Tree:
        values = dict(zip(given, children, strict=True))
        return unchecked(cls, *[values.get(name) for name in names])

    pytree.register_pytree_node(cls, flatten, unflatten)
    return cls


def unchecked(cls: type[Tree], *values: Any) -> Tree:
    """An instance of a dataclass from the values of its fields in order, without ``__init__`` and its checks."""
    instance = object.__new__(cls)
    for name, value in zip(cls.__dataclass_fields__, values, strict=True):  # type: ignore[attr-defined]
        object.__setattr__(instance, name, value)
    return instance


def map(function: Callable[..., Any], tree: Tree, *others: Tree) -> Tree:
    """Apply a function to every tensor of a tree, with the tensors in the same place of other trees, for a new tree.

    Args:
        function: Called as ``function(tensor, *other_tensors)``.
        tree: The tree; leaves that are not tensors are kept.
        others: Trees of the same structure.

    Raises:
        ValueError: The structures differ.
    """

    def apply(leaf: Any, *other_leaves: Any) -> Any:
        return function(leaf, *other_leaves) if isinstance(leaf, Tensor) else leaf

    return pytree.tree_map(apply, tree, *others)


def leaves(tree: Any) -> list[Tensor]:
    """All tensors of a tree, of shapes () or others, in order."""
    return [leaf for leaf in pytree.tree_leaves(tree) if isinstance(leaf, Tensor)]


def is_open(tree: Any) -> bool:
    """Whether all leaves of a tree are tensors, numbers, strings or None, so that none hides tensors of its own."""
    return _closed(tree) is None


def check_open(name: str, tree: Any) -> None:
    """Raise a TypeError unless :func:`is_open`: derivatives in tensors that a leaf hides would be lost.

    Args:
        name: What the tree is, for the message.
        tree: The tree.
    """
    closed = _closed(tree)
    if closed is not None:
        raise TypeError(
            f"{name} must hold only tensors, numbers, strings and containers of them, got a {type(closed).__name__}: "
            "register a dataclass with torchmpm.tree.register, and give the tensors of other objects"
        )


def _closed(tree: Any) -> Any:
    """The first leaf that could hide tensors, or ``None``."""
    leaves = pytree.tree_leaves(tree)
    return next((leaf for leaf in leaves if not isinstance(leaf, Tensor | int | float | str | None)), None)


def flatten(tree: Tree) -> tuple[list[Tensor], Callable[[Iterable[Tensor]], Tree]]:
    """All tensors of a tree, of shapes () or others, in order, and a function that makes it from as many others."""
    entries, structure = pytree.tree_flatten(tree)
    tensors = [entry for entry in entries if isinstance(entry, Tensor)]
    others = [None if isinstance(entry, Tensor) else (entry,) for entry in entries]  # does not keep the tensors alive

    def rebuild(replacements: Iterable[Tensor]) -> Tree:
        new = iter(replacements)
        made: Tree = pytree.tree_unflatten([next(new) if other is None else other[0] for other in others], structure)
        return made

    return tensors, rebuild


def detach(tree: Tree) -> Tree:
    """The same tree with every tensor detached from the autograd graph."""
    return map(Tensor.detach, tree)


def refuse_graph(name: str, tree: Any) -> None:
    """Refuse to pickle or deeply copy a tree whose tensors belong to an autograd graph.

    Args:
        name: What the tree is, for the message.
        tree: The tree.

    Raises:
        RuntimeError: A tensor has a graph.
    """
    if any(leaf.grad_fn is not None for leaf in leaves(tree)):
        raise RuntimeError(f"{name} cannot be pickled or copied with its autograd graph: call its detach() first")


def without_inference(tree: Tree) -> Tree:
    """The same tree with copies of the tensors that were made in inference mode, which autograd could not save."""
    return map(lambda t: t.clone() if t.is_inference() else t, tree)


def where(mask: Tensor, tree: Tree, other: Tree) -> Tree:
    """Select whole batch elements: those of ``tree`` where the mask holds, those of ``other`` elsewhere.

    Args:
        mask: (B,) bool.
        tree: A tensor (B, ...) or a tree of them.
        other: A tree of the same structure, shapes and dtypes.

    Raises:
        ValueError: ``mask`` is not bool of shape (B,), or the trees differ in structure, shapes or dtypes.
        TypeError: ``mask`` is not a tensor.
    """
    if not isinstance(mask, Tensor):
        raise TypeError(f"mask must be a Tensor, got {type(mask).__name__}")

    def select(chosen: Tensor, otherwise: Tensor) -> Tensor:
        if mask.dtype != torch.bool or mask.shape != chosen.shape[:1]:
            expected = f"bool of shape {tuple(chosen.shape[:1])}"
            raise ValueError(f"mask must be {expected}, got {mask.dtype} of shape {tuple(mask.shape)}")
        if otherwise.shape != chosen.shape or otherwise.dtype != chosen.dtype:
            allowed, found = (f"{each.dtype} of shape {tuple(each.shape)}" for each in (chosen, otherwise))
            raise ValueError(f"other must have the same shapes and dtypes, got {found} in place of {allowed}")
        return torch.where(mask.view(-1, *[1] * (chosen.ndim - 1)), chosen, otherwise)

    return map(select, tree, other)


def has_tangents(tensors: Iterable[Tensor | None]) -> bool:
    """Whether one of the ``tensors`` carries a tangent of ``torch.autograd.forward_ad``."""
    return not transforming() and any(t is not None and unpack_dual(t).tangent is not None for t in tensors)


def transforming() -> bool:
    """Whether a transform of ``torch.func`` or a trace of ``make_fx`` is active."""
    # torch.func has no public query for this.
    return bool(torch._C._are_functorch_transforms_active()) or get_proxy_mode() is not None


def cached_tensors(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Keep the tensors that a function of hashable arguments returns, for as long as they serve all later calls.

    Those made in inference mode could not serve gradients; those made under a transform of ``torch.func`` end with it,
    and so do those of a trace, such as that of ``torch.export``, whose tensors hold no numbers.
    """
    kept: dict[Any, Result] = {}

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if transforming() or torch.compiler.is_compiling():
            return function(*args, **kwargs)
        key = args, tuple(kwargs.items())
        result = kept.get(key)
        if result is None:
            with torch.inference_mode(False):
                result = function(*args, **kwargs)
            if all(type(tensor) is Tensor for tensor in leaves(result)):
                if len(kept) >= LARGEST_CACHE:
                    kept.clear()
                kept[key] = result
        return result

    return call
