"""A simulation with fewer particles that starts from where another has got to: a cheap model to plan in."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dittogym import TorchEnv
from dittogym.model import EnvState
from dittogym.physics import PER_PARTICLE
from torchmpm import tree

CANDIDATES = 16
"""Nearest particles among which each looks for one that no other has taken."""


class Reduced:
    """Copies the state of one environment into another of the same task with fewer particles.

    Each particle of the small environment stands for one of the large: the nearest in the layouts that both were reset
    to, so that an evenly spread layout stays one. It takes over position, velocity and deformation; the mass and volume
    that go with its share of the body are the small environment's own.

    Args:
        large: The environment that is followed, after a reset.
        small: Takes over its states, after a reset; as many simulations, same type and device.

    Raises:
        ValueError: A body of the small environment has more particles than the same of the large.
    """

    def __init__(self, large: TorchEnv, small: TorchEnv) -> None:
        self.small = small
        self._own = {name: value for name, value in small.env_state.memory.items() if not value.is_floating_point()}
        self.chosen = _nearest(large, small)

    def follow(self, state: EnvState) -> None:
        """Bring the small environment to where the large one is.

        Args:
            state: Of the large environment. Whole numbers in a task's memory name particles (the tip in GROW); of those
                the small environment keeps its own.
        """

        def pick(value: Tensor) -> Tensor:
            return value[torch.arange(len(value), device=value.device)[:, None], self.chosen]

        physics = {
            name: pick(value) if name in PER_PARTICLE and value.ndim == 2 else value
            for name, value in state.physics.items()
        }
        memory = {**state.memory, **self._own}
        self.small.env_state = replace(state, particles=tree.map(pick, state.particles), physics=physics, memory=memory)


def _nearest(large: TorchEnv, small: TorchEnv) -> Tensor:
    """Indices (B, n) of the large environment's particles, by body, each at most once."""
    chosen, theirs, ours = [], 0, 0
    for many, few in zip(large.model.solver.bodies, small.model.solver.bodies, strict=True):
        if few.count > many.count:
            raise ValueError(f"a reduced model must have at most {many.count} particles of a body, got {few.count}")
        x = large.state.x[:, theirs : theirs + many.count].detach()
        own = small.state.x[:, ours : ours + few.count].detach()
        order = torch.cdist(own, x).topk(min(CANDIDATES, many.count), largest=False).indices
        chosen.append(torch.stack([_distinct(ranked, many.count) for ranked in order.cpu()]) + theirs)
        theirs, ours = theirs + many.count, ours + few.count
    return torch.cat(chosen, 1).to(large.device)


def _distinct(ranked: Tensor, count: int) -> Tensor:
    """The best of each row of candidates that no earlier row has; any that is left where all are taken."""
    free, picks = set(range(count)), []
    for row in ranked.tolist():
        pick = next((index for index in row if index in free), None)
        picks.append(min(free) if pick is None else pick)
        free.remove(picks[-1])
    return torch.tensor(picks)
