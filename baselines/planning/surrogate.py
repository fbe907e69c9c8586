"""A cheaper model to plan in: the state of one simulation copied into another with fewer particles or substeps."""

from dataclasses import replace

import torch
from torch import Tensor

from cfp.errors import ConfigError
from dittogym import TorchEnv
from dittogym.core import EnvState
from dittogym.physics import PER_PARTICLE
from torchmpm import tree

#: Nearest particles among which each particle looks for one that is not taken yet.
NEIGHBOURS = 16


class Surrogate:
    """Copies the states of one environment into another of the same task, with as many particles or fewer.

    Each particle of the small environment stands for the nearest of the large in the initial positions of both, and
    takes over its position, velocity and deformation; masses and volumes are the small environment's own.
    """

    def __init__(self, large: TorchEnv, small: TorchEnv) -> None:
        self.env = small
        self.indices = _nearest_particles(large, small)  # (B, n) of the large environment's particles
        same = large.model.camera.counts == small.model.camera.counts
        task_state = {} if same else small.env_state.task_state
        # Numbers of particles, such as those of the tip in GROW, see `dittogym.rewards.Reward`.
        self._particle_indices = {
            name: value for name, value in task_state.items() if value.dtype == torch.int64 and value.ndim == 2
        }

    def sync(self, state: EnvState) -> None:
        """Bring the small environment to a state of the large one."""

        def select(value: Tensor) -> Tensor:
            return value[torch.arange(len(value), device=value.device)[:, None], self.indices]

        physics = {
            name: select(value) if name in PER_PARTICLE and value.ndim == 2 else value
            for name, value in state.physics.items()
        }
        task_state = {**state.task_state, **self._particle_indices}
        particles = tree.map(select, state.particles)
        self.env.env_state = replace(state, particles=particles, physics=physics, task_state=task_state)


def _nearest_particles(large: TorchEnv, small: TorchEnv) -> Tensor:
    """Indices (B, n) of the large environment's nearest particles, body by body, each at most once."""
    if torch.equal(large.state.x, small.state.x):
        return torch.arange(large.num_particles, device=large.device).expand(large.num_envs, -1)
    indices, start, small_start = [], 0, 0
    for many, few in zip(large.model.solver.bodies, small.model.solver.bodies, strict=True):
        if few.count > many.count:
            raise ConfigError(f"train_particles of a body must be at most {many.count}, got {few.count}")
        x = large.state.x[:, start : start + many.count].detach()
        small_x = small.state.x[:, small_start : small_start + few.count].detach()
        nearest = torch.cdist(small_x, x).topk(min(NEIGHBOURS, many.count), largest=False).indices
        indices.append(torch.stack([_assign(rows, many.count) for rows in nearest.cpu()]) + start)
        start, small_start = start + many.count, small_start + few.count
    return torch.cat(indices, 1).to(large.device)


def _assign(nearest: Tensor, count: int) -> Tensor:
    """The first index of each row (n, k) that no earlier row has, or any free one where all are taken."""
    free, assigned = set(range(count)), []
    for row in nearest.tolist():
        index = next((index for index in row if index in free), None)
        assigned.append(min(free) if index is None else index)
        free.remove(assigned[-1])
    return torch.tensor(assigned)
