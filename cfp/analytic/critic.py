"""The privileged value function of short-horizon actor-critic (SHAC; Xu et al., ICLR 2022), and what it observes."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cfp.analytic.window import Window, discount_rate, td_lambda_targets
from cfp.config import WindowConfig
from cfp.errors import NonFiniteError
from cfp.learner import follow
from cfp.resumable import Resumable
from dittogym import TorchEnv
from dittogym.copies import constant
from dittogym.geometry import centre_in_window
from torchmpm.transfer import quadratic_weights

#: Width of the hidden layers.
WIDTH = 128
#: Of Adam.
BETAS = (0.7, 0.95)
#: Cells per axis of the rasters.
CELLS = 16
#: Periods of the clock, in control steps.
PERIODS = (8, 4, 2)
_PADDING = 2


@dataclass(frozen=True)
class StateFeatures:
    """Rasters of the patch on which the robot acts, and a clock, in one vector.

    Mass, momentum and mass-weighted ``F - I`` of the robot are spread over 16 x 16 cells by quadratic B-splines, and so
    are mass and momentum of the object where the task has one. Masses are relative to the body's own, spread evenly
    over the raster, so every particle count gives the same picture. The features are differentiable in the particles.
    """

    # Trainings have both; there are files of policies without one of them.
    deformation: bool = True  # the four channels of F - I
    clock: bool = True  # cosine and sine of the episode's step, for each of `PERIODS`
    displacement: bool = False  # of the robot since the reset, m

    def size(self, objects: int) -> int:
        """Length D of the vector in a task with 0 or 1 objects."""
        channels = (7 if self.deformation else 3) + 3 * objects
        return channels * CELLS**2 + 2 * len(PERIODS) * self.clock + 2 * self.displacement

    def __call__(self, env: TorchEnv) -> Tensor:
        """Features (B, D) of the environment's present state, with its autograd graph."""
        state, robot = env.env_state, env.model.num_robot_particles
        particles = state.particles
        mass = torch.ones_like(particles.Jp)
        channels = torch.cat((mass[:, None], particles.v.movedim(-1, 1)), 1)
        cells = self._cell_coordinates(env)
        robot_channels = channels[..., :robot]
        if self.deformation:
            strain = particles.F[:, :robot] - torch.eye(2, dtype=env.dtype, device=env.device)
            robot_channels = torch.cat((robot_channels, strain.flatten(-2).movedim(-1, 1)), 1)
        parts = [_rasterise(cells[:, :robot], robot_channels)]
        if robot < env.num_particles:
            parts.append(_rasterise(cells[:, robot:], channels[..., robot:]))
        if self.clock:
            parts.append(_clock(state.steps).to(particles.x))
        if self.displacement:
            parts.append(state.centre - state.start.com)
        return torch.cat([part.flatten(1) for part in parts], 1)

    @staticmethod
    def _cell_coordinates(env: TorchEnv) -> Tensor:
        """Positions (B, N, 2) in cells from the patch's lower left corner."""
        state, spec = env.env_state, env.spec
        width = spec.patch / env.model.solver.grid.resolution
        centre = centre_in_window(spec.patch_centre, state.centre, state.origin).detach()
        corner = state.origin.detach() + centre.clamp(0.5 * width, 1.0 - 0.5 * width) - 0.5 * width
        return (state.particles.x - corner[:, None]) * (CELLS / width)


def _rasterise(position: Tensor, values: Tensor) -> Tensor:
    """Spread values (B, C, N) at positions (B, N, 2), in cells, over a raster (B, C, 16, 16), x first."""
    batch, channels, count = values.shape
    side = CELLS + 2 * _PADDING
    middle = 0.5 * CELLS
    inside = ((position.detach() - middle).abs() < middle + 1.0).all(-1)
    offset = torch.where(inside[..., None], position, middle) - 0.5
    base = torch.floor(offset.detach() - 0.5)
    wx, wy = (quadratic_weights((offset - base)[..., axis]) for axis in (0, 1))
    weight = (wx[:, :, None] * wy[:, None]).flatten(1, 2) * inside[:, None]
    first = ((base[..., 0] + _PADDING) * side + base[..., 1] + _PADDING).to(torch.int64)
    neighbour = torch.arange(3, device=position.device)
    index = (first[:, None] + (neighbour[:, None] * side + neighbour).view(9, 1)).flatten(1)
    source = (weight[:, None] * values[:, :, None]).flatten(2)
    sums = values.new_zeros(batch, channels, side**2).scatter_add(2, index[:, None].expand(-1, channels, -1), source)
    raster = sums.view(batch, channels, side, side)[..., _PADDING:-_PADDING, _PADDING:-_PADDING]
    return raster * (CELLS**2 / count)


def _clock(steps: Tensor) -> Tensor:
    """Cosine and sine (B, 6) of steps (B,) for every period."""
    angle = steps[:, None] * (2.0 * math.pi / constant(PERIODS, steps))
    return torch.cat((angle.cos(), angle.sin()), 1)


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 128 units with layer normalisation and ELU; the last layer starts with small weights."""
    layers: list[nn.Module] = []
    for size in (inputs, WIDTH):
        layers += [nn.Linear(size, WIDTH), nn.LayerNorm(WIDTH), nn.ELU()]
    last = nn.Linear(WIDTH, outputs)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers, last).float()  # whatever torch's default is


def make_adam(parameters: Iterable[nn.Parameter], learning_rate: float, betas: tuple[float, float]) -> torch.optim.Adam:
    """Adam; on a GPU the fused one, which launches a kernel or two."""
    parameters = list(parameters)
    return torch.optim.Adam(parameters, learning_rate, betas, fused=parameters[0].is_cuda or None)


def descend(adam: torch.optim.Adam, max_norm: float) -> Tensor:
    """Take a step along the gradient, clipped to a norm; returns the norm that it had, for `check_norms`."""
    norm = nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], max_norm)
    adam.step()
    return norm


def check_norms(norms: Sequence[Tensor], name: str) -> None:
    """Raise a `NonFiniteError` if one of the norms of the gradients of ``name`` is not finite."""
    if norms and not bool(torch.stack(list(norms)).isfinite().all()):
        raise NonFiniteError(f"the gradient of the {name} is not finite")


class Critic(Resumable):
    """A value network, its slowly following target, and their training on TD(lambda) targets.

    Args:
        network: Maps observations (B, ...) to (B, 1).
        options: Of the run.
    """

    parts = ("network", "target", "adam")

    def __init__(self, network: nn.Module, options: WindowConfig) -> None:
        self.network, self.options = network, options
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.adam = make_adam(network.parameters(), options.learning_rate, BETAS)

    def __call__(self, observations: Tensor) -> Tensor:
        """Values (B,) of the target network."""
        return self._value(self.target, observations)

    def _value(self, network: nn.Module, observations: Tensor) -> Tensor:
        # what the network learns is of the size of a reward
        value: Tensor = network(observations)[..., 0] / discount_rate(self.options.gamma)
        return value

    def update(self, window: Window, learning_rate: float) -> float:
        """Learn the values of a window's states; returns the last mean squared error."""
        self.adam.param_groups[0]["lr"] = learning_rate
        targets = td_lambda_targets(window, self.options.gamma, self.options.td_lambda).flatten()
        observations, loss, norms = window.observations.flatten(0, 1), torch.zeros(()), []
        for _ in range(self.options.critic_updates):
            self.adam.zero_grad()
            loss = (self._value(self.network, observations) - targets).square().mean()
            loss.backward()
            norms.append(descend(self.adam, self.options.max_grad_norm))
        check_norms(norms, "critic")
        follow(self.target, self.network, 1 - self.options.tau)
        return float(loss.detach())
