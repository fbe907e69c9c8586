"""Pytrees: nested containers of tensors that functions map over leaf by leaf.

Tuples, named tuples, lists, dictionaries and the dataclasses that :func:`register` adds are containers; everything else
is a leaf. States, such as :class:`torchmpm.ParticleState`, are pytrees. The registry is the one that ``torch.func``,
``torch.utils.checkpoint`` and ``torch.compile`` use (``torch.utils._pytree``, as no release of torch offers it under a
public name).
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
    """Register a dataclass as a pytree whose children are its fields that are not ``None``; a class decorator.

    Instances are rebuilt from their leaves without ``__init__`` and ``__post_init__``, because transforms such as
    ``torch.func.vmap`` put leaves of other shapes in their place.

    Args:
        cls: A dataclass whose fields are tensors, containers of tensors, or plain values, which are leaves.

    Returns:
        The class itself.

    Raises:
        TypeError: ``cls`` is not a dataclass.
        ValueError: ``cls`` is registered already.

    Examples:
        >>> import torch, torchmpm
        >>> from dataclasses import dataclass
        >>> @torchmpm.tree.register
        ... @dataclass(frozen=True, eq=False)
        ... class Pair:
        ...     first: torch.Tensor
        ...     second: torch.Tensor
        >>> torchmpm.tree.map(lambda t: 2 * t, Pair(torch.tensor(1), torch.tensor(2)))
        Pair(first=tensor(2), second=tensor(4))
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
    """Apply a function to every tensor of a tree.

    Args:
        function: Called as ``function(tensor, *other_tensors)``, with the tensors in the same place of ``others``.
        tree: The tree.
        others: Trees of the same structure.

    Returns:
        A tree of the same structure with the results; leaves that are not tensors are those of ``tree``.

    Raises:
        ValueError: The structures differ.
    """

    def apply(leaf: Any, *other_leaves: Any) -> Any:
        return function(leaf, *other_leaves) if isinstance(leaf, Tensor) else leaf

    return pytree.tree_map(apply, tree, *others)


def leaves(tree: Any) -> list[Tensor]:
    """Return the tensors of a tree, of any shapes, in the order of the fields and items of its containers.

    Args:
        tree: The tree; leaves that are not tensors are left out.
    """
    return [leaf for leaf in pytree.tree_leaves(tree) if isinstance(leaf, Tensor)]


def opaque_leaf(tree: Any) -> Any:
    """The first leaf of a tree that is no tensor, number, string or None, and so could hide tensors; else ``None``."""
    leaves = pytree.tree_leaves(tree)
    return next((leaf for leaf in leaves if not isinstance(leaf, Tensor | int | float | str | None)), None)


def flatten(tree: Tree) -> tuple[list[Tensor], Callable[[Iterable[Tensor]], Tree]]:
    """Take a tree apart into its tensors and a function that puts a tree of the same structure together.

    Args:
        tree: The tree.

    Returns:
        The tensors, of any shapes, in the order of :func:`leaves`; and a function from as many other tensors to a tree,
        in which leaves that are not tensors are those of ``tree``.
    """
    entries, structure = pytree.tree_flatten(tree)
    tensors = [entry for entry in entries if isinstance(entry, Tensor)]
    others = [None if isinstance(entry, Tensor) else (entry,) for entry in entries]  # does not keep the tensors alive

    def rebuild(replacements: Iterable[Tensor]) -> Tree:
        new = iter(replacements)
        made: Tree = pytree.tree_unflatten([next(new) if other is None else other[0] for other in others], structure)
        return made

    return tensors, rebuild


def detach(tree: Tree) -> Tree:
    """Return the same ``tree`` with every tensor detached from the autograd graph."""
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
    """Choose for each element of a batch between two trees.

    Args:
        mask: (B,) bool, true for the elements that are taken from ``tree``.
        tree: A tensor (B, ...) or a tree of them.
        other: A tree of the same structure, shapes and dtypes, from which the other elements are taken.

    Returns:
        A tree of the same structure; leaves that are not tensors are those of ``tree``.

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
    """Return whether a transform of ``torch.func`` or a trace of ``make_fx`` is active."""
    # torch.func has no public query for this. torch.compile cannot compile that of make_fx.
    traced = not torch.compiler.is_compiling() and get_proxy_mode() is not None
    return bool(torch._C._are_functorch_transforms_active()) or traced


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
