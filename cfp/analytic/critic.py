"""The value function of short-horizon actor-critic (SHAC; Xu et al., ICLR 2022)."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from cfp.analytic.config import WindowConfig
from cfp.analytic.reward import discount_rate
from cfp.analytic.stateful import Stateful
from cfp.analytic.window import Window, td_lambda_targets
from cfp.errors import NonFiniteError

#: Width of the hidden layers.
WIDTH = 128
#: Of Adam.
BETAS = (0.7, 0.95)


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 128 units with layer normalisation and ELU; the last layer starts with small weights."""
    layers: list[nn.Module] = []
    for size in (inputs, WIDTH):
        layers += [nn.Linear(size, WIDTH), nn.LayerNorm(WIDTH), nn.ELU()]
    last = nn.Linear(WIDTH, outputs)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers, last)


def descend(adam: torch.optim.Adam, max_norm: float, name: str) -> None:
    """Take a step along the gradient of ``name``, clipped to a norm; a `NonFiniteError` if it is not finite."""
    norm = nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], max_norm)
    if not torch.isfinite(norm):
        raise NonFiniteError(f"the gradient of the {name} is not finite")
    adam.step()


class Critic(Stateful):
    """A value network, its slowly following target, and their training on TD(lambda) targets.

    Args:
        network: Maps observations (B, ...) to (B, 1).
        options: Of the run.
    """

    parts = ("network", "target", "adam")

    def __init__(self, network: nn.Module, options: WindowConfig) -> None:
        self.network, self.options = network, options
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.adam = torch.optim.Adam(network.parameters(), options.learning_rate, BETAS)

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
        observations, loss = window.observations.flatten(0, 1), torch.zeros(())
        for _ in range(self.options.critic_updates):
            self.adam.zero_grad()
            loss = (self._value(self.network, observations) - targets).square().mean()
            loss.backward()
            descend(self.adam, self.options.max_grad_norm, "critic")
        get_ema_multi_avg_fn(1 - self.options.tau)(list(self.target.parameters()), list(self.network.parameters()), 1)
        return float(loss.detach())
