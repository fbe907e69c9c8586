"""The losses of soft actor-critic (Haarnoja et al., 2018), with the gate penalty of the paper."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from cfp.agent.actor import Actor, NetworkInput, image_of
from cfp.agent.critics import TwinCritic


def critic_target(
    actor: Actor,
    target: TwinCritic,
    next_obs: NetworkInput,
    rewards: Tensor,
    not_done: Tensor,
    alpha: Tensor | float,
    gamma: Tensor | float,
) -> Tensor:
    """Target of the critics, ``y = r + c gamma (min Q'(s', a') - alpha log pi(a'|s'))``, (B, 1), without gradient.

    The rewards r are normalised; the continuation flag c (``not_done``) is 1 at a time limit. Over n steps, r is their
    discounted sum, and ``gamma`` its n-th power, (B, 1).
    """
    with torch.no_grad():
        sample = actor.sample_for_critic(next_obs)
        q_values = smaller_value(target, next_obs, sample.action)
        return rewards + not_done * gamma * (q_values - alpha * sample.log_prob[:, None])


def smaller_value(critic: TwinCritic, obs: NetworkInput, action: Tensor) -> Tensor:
    """The smaller one of both critics' values, (B, 1)."""
    return torch.minimum(*critic(obs, action))


def critic_loss(critic: TwinCritic, obs: NetworkInput, actions: Tensor, target_q: Tensor) -> Tensor:
    """Sum of both critics' mean squared errors for actions (B, 2, R, R) or (B, 2 R R)."""
    return torch.stack([F.mse_loss(values, target_q) for values in critic(obs, actions)]).sum()


def actor_loss(
    actor: Actor,
    critic: TwinCritic,
    obs: NetworkInput,
    alpha: Tensor,
    gate_penalty: float,
    origin: Actor | None = None,
    anchor: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean of ``alpha log pi - min Q`` plus penalties, and scalars to log (see `cfp.agent.sac.METRICS`).

    ``gate_penalty`` weighs a residual actor's gate, ``anchor`` the mean squared distance to ``origin``'s mean actions.
    """
    action, log_prob, gate, _ = actor.sample_for_critic(obs)
    q_values = smaller_value(critic, obs, action)
    loss = (alpha * log_prob[:, None] - q_values).mean()
    scalars = {"q": q_values.detach().mean(), "entropy": -log_prob.detach().mean()}
    if gate is not None:
        penalty = gate_penalty * gate.flatten(1).norm(dim=1).mean() / actor.resolution
        loss = loss + penalty
        scalars |= {"gate": gate.detach().mean(), "gate_penalty": penalty.detach()}
    if origin is not None:
        with torch.no_grad():
            reference = origin.sample_for_critic(image_of(obs), deterministic=True)
        drift = (action - reference.action).square().mean()
        loss = loss + anchor * drift
        scalars["drift"] = drift.detach()
    return loss, scalars
