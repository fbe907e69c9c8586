"""The losses of soft actor-critic, in the precision and execution mode that a run asks for."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn import functional as F

from cfp.agent.actor import Actor
from cfp.agent.hyperparameters import Precision
from cfp.agent.networks import TwinCritic, normalise_image
from torchmpm.backends import compiler_found

Function = TypeVar("Function", bound=Callable[..., Any])

_logger = logging.getLogger(__name__)


def critic_target(
    actor: Actor,
    target: TwinCritic,
    next_obs: Tensor,
    rewards: Tensor,
    not_done: Tensor,
    alpha: Tensor,
    gamma: float,
) -> Tensor:
    """Regression target ``y = r + c gamma (min Q'(s', a') - alpha log pi(a'|s'))``, (B, 1), without gradient.

    Args:
        actor: Samples a'.
        target: Target critics Q'.
        next_obs: Next observations s', (B, 3, 64, 64).
        rewards: Normalised rewards r, (B, 1).
        not_done: Continuation flag c, (B, 1); 1 at a time limit.
        alpha: Temperature.
        gamma: Discount factor.
    """
    with torch.no_grad():
        sample = actor.sample(next_obs)
        q_values = torch.minimum(*target(next_obs, sample.action))
        return rewards + not_done * gamma * (q_values - alpha * sample.log_prob[:, None])


def critic_loss(critic: TwinCritic, obs: Tensor, actions: Tensor, target_q: Tensor) -> Tensor:
    """Sum of the mean squared errors of both critics for observations (B, 3, 64, 64) and actions (B, 2, R, R)."""
    return torch.stack([F.mse_loss(q_values, target_q) for q_values in critic(obs, actions)]).sum()


def actor_loss(
    actor: Actor,
    critic: TwinCritic,
    obs: Tensor,
    alpha: Tensor,
    gate_penalty: float,
    origin: Actor | None = None,
    anchor: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean of ``alpha log pi - min Q`` plus penalties.

    Args:
        actor: Actor to improve.
        critic: Critics of its actions.
        obs: Observations (B, 3, 64, 64).
        alpha: Temperature.
        gate_penalty: Weight of the gate penalty.
        origin: Actor to stay close to, with the same action grid.
        anchor: Weight of the mean squared difference between the actions and the mean actions of ``origin``.

    Returns:
        The loss, and scalars to log (see `cfp.agent.sac.METRICS`).
    """
    action, log_prob, gate, _ = actor.sample(obs)
    q_values = torch.minimum(*critic(obs, action))
    loss = (alpha * log_prob[:, None] - q_values).mean()
    scalars = {"q": q_values.detach().mean(), "entropy": -log_prob.detach().mean()}
    if gate is not None:
        penalty = gate_penalty * gate.flatten(1).norm(dim=1).mean() / actor.resolution
        loss = loss + penalty
        scalars |= {"gate": gate.detach().mean(), "gate_penalty": penalty.detach()}
    if origin is not None:
        with torch.no_grad():
            reference = origin(obs, deterministic=True)
        drift = (action - reference).square().mean()
        loss = loss + anchor * drift
        scalars["drift"] = drift.detach()
    return loss, scalars


class Losses:
    """`critic_target`, `critic_loss` and `actor_loss` in a given precision, compiled if asked for.

    In bfloat16 only convolutions and matrix products are computed: weights and their gradients, optimisers, densities,
    rewards and the losses themselves stay in float32.

    Args:
        device: Device of the networks.
        precision: See `choose_precision`.
        compile: Run the losses through ``torch.compile``. Where that is impossible a warning is logged and they run
            eagerly.

    Raises:
        ValueError: There is no such precision.
    """

    def __init__(self, device: torch.device, precision: Precision = "float32", compile: bool = False) -> None:
        self.device = device
        self.bfloat16 = choose_precision(precision, device) == "bfloat16"
        if compile and device.type == "cpu" and not compiler_found():
            _logger.warning("updates are not compiled, only slower: no C++ compiler (g++, clang++ or $CXX) was found")
            compile = False
        self.critic_target = self._prepare(critic_target, compile)
        self.critic_loss = self._prepare(critic_loss, compile)
        self.actor_loss = self._prepare(actor_loss, compile)

    def prepare(self, observation: Tensor) -> Tensor:
        """Normalise uint8 observations (B, 3, 64, 64) once for all networks of an update, in their precision.

        Observations of other types are returned as they are: some contain codes, of which every bit counts.
        """
        image = normalise_image(observation)
        return image.bfloat16() if self.bfloat16 and observation.dtype == torch.uint8 else image

    def _prepare(self, function: Function, compile: bool) -> Function:
        @functools.wraps(function)
        def run(*arguments: Any) -> Any:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                return function(*arguments)

        return _compiled(run) if compile else run  # type: ignore[return-value]


def choose_precision(precision: Precision, device: torch.device) -> str:
    """Resolve ``"auto"``: bfloat16 on a CPU with instructions for it, float32 everywhere else.

    Raises:
        ValueError: There is no such precision.
    """
    if precision == "auto":
        return "bfloat16" if device.type == "cpu" and _multiplies_bfloat16() else "float32"
    if precision not in ("float32", "bfloat16"):
        raise ValueError(f"precision must be 'auto', 'float32' or 'bfloat16', got {precision!r}")
    return precision


def _multiplies_bfloat16() -> bool:
    """Whether this CPU has bfloat16 instructions; torch emulates them elsewhere, slower than float32.

    Versions of torch without ``torch.cpu.get_capabilities`` do not tell; they count as no.
    """
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16"))


def _compiled(function: Function) -> Function:
    """``function``, compiled at its first call for each shape; itself from the first failure on."""
    # Noise comes from torch's own generator, as without compilation, so that a resumed run samples the same.
    fast = torch.compile(function, dynamic=False, options={"fallback_random": True})
    failed = False

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        nonlocal failed
        if not failed:
            try:
                return fast(*arguments)
            except RuntimeError as error:  # the base class of all of torch.compile's errors
                failed = True
                reason = str(error).strip().splitlines()[0]
                _logger.warning("updates are not compiled, only slower: torch.compile failed (%s)", reason)
        return function(*arguments)

    return run  # type: ignore[return-value]
