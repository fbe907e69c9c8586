"""States as pytrees: mapping, selection, and the transforms of torch.func that take them."""

from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from scenes import assert_identical, lively, robot
from torch import Tensor

from torchmpm import ParticleState, tree


class Pair(NamedTuple):
    first: Tensor
    second: Tensor | None


@tree.register
@dataclass(frozen=True)
class Nested:
    state: ParticleState
    pair: Pair
    memory: dict[str, Tensor]


def nested(seed: int = 0) -> Nested:
    state = lively(4, 3, seed=seed)
    return Nested(state, Pair(state.x.sum(1), None), {"steps": torch.full((3,), seed)})


def test_map_reaches_every_tensor_of_nested_containers() -> None:
    doubled = tree.map(lambda tensor: 2 * tensor, nested(1))
    assert isinstance(doubled, Nested) and isinstance(doubled.state, ParticleState)
    assert torch.equal(doubled.state.F, 2 * nested(1).state.F)
    assert torch.equal(doubled.pair.first, 2 * nested(1).pair.first) and doubled.pair.second is None
    assert doubled.memory["steps"].tolist() == [2, 2, 2]
    assert len(tree.leaves(doubled)) == 7


@tree.register
@dataclass(frozen=True)
class Perhaps:
    first: Tensor | None
    second: Tensor | None = None
    third: float = 1.0


def test_fields_that_are_none_are_no_leaves() -> None:
    """They stay None, vmap takes such trees, and those with other fields have another structure."""
    some = Perhaps(None, torch.ones(3), 2.0)
    doubled = tree.map(lambda tensor: 2 * tensor, some)
    assert doubled.first is None and doubled.second.tolist() == [2.0] * 3 and doubled.third == 2.0
    swap = torch.func.vmap(lambda each: Perhaps(each.second, None, each.third))
    mapped = swap(Perhaps(None, torch.ones(3), torch.ones(3)))
    assert mapped.first.tolist() == [1.0] * 3 and mapped.second is None
    with pytest.raises(ValueError):
        tree.map(torch.add, some, Perhaps(torch.ones(3), None, 2.0))


def test_where_selects_whole_batch_elements() -> None:
    mixed = tree.where(torch.tensor([True, False, True]), nested(1), nested(2))
    assert_identical(mixed.state[[0, 2]], nested(1).state[[0, 2]])
    assert_identical(mixed.state[1], nested(2).state[1])
    assert mixed.memory["steps"].tolist() == [1, 2, 1]


def loss(state: ParticleState) -> Tensor:
    final = robot(5).step(state, substeps=2)
    return (final.x.square().sum((1, 2)) + final.F.square().sum((1, 2, 3))).sum()


def test_transforms_take_states_as_arguments() -> None:
    state = lively(5, 2)
    leaf = tree.map(lambda tensor: tensor.clone().requires_grad_(), state)
    expected = torch.autograd.grad(loss(leaf), tree.leaves(leaf), allow_unused=True, materialize_grads=True)
    gradient = torch.func.grad(loss)(state)
    assert isinstance(gradient, ParticleState)
    for ours, theirs in zip(tree.leaves(gradient), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def test_vmap_maps_over_states_and_returns_them() -> None:
    states = [lively(5, 2, seed=seed) for seed in (1, 2)]
    stacked = tree.map(lambda *tensors: torch.stack(tensors), *states)
    together = torch.func.vmap(lambda state: robot(5).step(state, substeps=2))(stacked)
    for index, state in enumerate(states):
        alone = robot(5).step(state, substeps=2)
        torch.testing.assert_close(together.x[index], alone.x, rtol=1e-12, atol=1e-12)
