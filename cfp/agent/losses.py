"""The losses of the soft actor-critic, in the precision and the mode of execution that a run asks for."""

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


def choose_precision(wanted: Precision, device: torch.device) -> str:
    """Resolve ``"auto"``: bfloat16 on a CPU with instructions for it, float32 everywhere else.

    Raises:
        ValueError: No such precision.
    """
    if wanted == "auto":
        return "bfloat16" if device.type == "cpu" and _multiplies_bfloat16() else "float32"
    if wanted not in ("float32", "bfloat16"):
        raise ValueError(f"precision: got {wanted!r}, allowed auto, float32, bfloat16")
    return wanted


def _multiplies_bfloat16() -> bool:
    """Whether this CPU multiplies bfloat16 itself; torch emulates it elsewhere, slower than float32."""
    asked = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")  # torch has no public name for them
    return any(getattr(torch.cpu, name, lambda: False)() for name in asked)


def critic_target(
    actor: Actor,
    target: TwinCritic,
    later: Tensor,
    rewards: Tensor,
    goes_on: Tensor,
    alpha: Tensor,
    gamma: float,
) -> Tensor:
    """Regression target ``y = r + c gamma (min Q'(s', a') - alpha log pi(a'|s'))``, (B, 1), without gradient.

    Args:
        actor: Draws a'.
        target: The target critics Q'.
        later: Next observations s', (B, 3, 64, 64).
        rewards: Normalised rewards r, (B, 1).
        goes_on: Continuation flag c, (B, 1); a time limit does not end the task.
        alpha: Temperature.
        gamma: Discount factor.
    """
    with torch.no_grad():
        drawn = actor.sample(later)
        value = torch.minimum(*target(later, drawn.action))
        return rewards + goes_on * gamma * (value - alpha * drawn.log_prob[:, None])


def critic_loss(critic: TwinCritic, now: Tensor, actions: Tensor, wanted: Tensor) -> Tensor:
    """Sum of both critics' mean squared errors on observations (B, 3, 64, 64) and actions (B, 2, R, R)."""
    return torch.stack([F.mse_loss(value, wanted) for value in critic(now, actions)]).sum()


def actor_loss(
    actor: Actor,
    critic: TwinCritic,
    now: Tensor,
    alpha: Tensor,
    gate_penalty: float,
    origin: Actor | None = None,
    anchor: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Mean of ``alpha log pi - min Q`` plus penalties, and scalars to log (see `cfp.agent.sac.METRICS`).

    Args:
        actor: Is improved.
        critic: Judges its actions.
        now: Observations (B, 3, 64, 64).
        alpha: Temperature.
        gate_penalty: Weight of the gate.
        origin: Actor to stay close to, with the same action grid.
        anchor: Weight of the mean square by which actions differ from its mean ones.
    """
    action, log_prob, gate, _ = actor.sample(now)
    value = torch.minimum(*critic(now, action))
    loss = (alpha * log_prob[:, None] - value).mean()
    scalars = {"q": value.detach().mean(), "entropy": -log_prob.detach().mean()}
    if gate is not None:
        penalty = gate_penalty * gate.flatten(1).norm(dim=1).mean() / actor.resolution
        loss = loss + penalty
        scalars |= {"gate": gate.detach().mean(), "gate_penalty": penalty.detach()}
    if origin is not None:
        with torch.no_grad():
            before = origin(now, deterministic=True)
        drift = (action - before).square().mean()
        loss = loss + anchor * drift
        scalars["drift"] = drift.detach()
    return loss, scalars


class Losses:
    """`critic_target`, `critic_loss` and `actor_loss` as a run evaluates them.

    In bfloat16 only convolutions and matrix products are: weights and their gradients, optimisers, densities, rewards
    and the losses themselves stay in float32.

    Args:
        device: Where the networks are.
        precision: See `choose_precision`.
        compile: Run them through ``torch.compile``. Where that is not possible a warning is logged and they run
            operator by operator.

    Raises:
        ValueError: No such precision.
    """

    def __init__(self, device: torch.device, precision: Precision = "float32", compile: bool = False) -> None:
        self.device = device
        self.bfloat16 = choose_precision(precision, device) == "bfloat16"
        if compile and device.type == "cpu" and not compiler_found():
            _logger.warning("the update is not compiled, only slower: no C++ compiler (g++, clang++ or $CXX) was found")
            compile = False
        prepare = _compiled if compile else _unchanged
        self.critic_target = prepare(self._in_precision(critic_target))
        self.critic_loss = prepare(self._in_precision(critic_loss))
        self.actor_loss = prepare(self._in_precision(actor_loss))

    def prepare(self, observation: Tensor) -> Tensor:
        """Normalise uint8 observations (B, 3, 64, 64) once for all networks of an update, in their precision.

        Numbers of other kinds keep theirs: some are codes, in which every bit counts.
        """
        image = normalise_image(observation)
        return image.bfloat16() if self.bfloat16 and observation.dtype == torch.uint8 else image

    def _in_precision(self, function: Function) -> Function:
        @functools.wraps(function)
        def run(*arguments: Any) -> Any:
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
                return function(*arguments)

        return run  # type: ignore[return-value]


def _unchanged(function: Function) -> Function:
    return function


def _compiled(function: Function) -> Function:
    """``function`` compiled at its first call for each shape; if that fails, itself from then on."""
    # Noise comes from torch's own generator, as without compilation, so that a resumed run draws the same.
    fast = torch.compile(function, dynamic=False, options={"fallback_random": True})
    failed = False

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        nonlocal failed
        if not failed:
            try:
                return fast(*arguments)
            except torch._dynamo.exc.TorchDynamoException as error:
                failed = True
                reason = str(error).strip().splitlines()[0]
                _logger.warning("the update is not compiled, only slower: torch.compile failed (%s)", reason)
        return function(*arguments)

    return run  # type: ignore[return-value]
