"""Gradients of control steps in DIG, where exact ones overflow."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dittogym import TorchEnv, core, make_spec
from dittogym.action import bicubic
from dittogym.core import EnvState
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler: thousands of substeps take too long")

STEPS = 8


def dig(exact: bool) -> TorchEnv:
    spec = make_spec("dig")
    soil = spec.objects[0]
    soil = replace(soil, material=replace(soil.material, exact_gradients=exact))
    return TorchEnv(replace(spec, objects=(soil,)), particles=(500, 850))


def returns(env: TorchEnv, state: EnvState, actions: Tensor) -> Tensor:
    """Smooth return of some control steps."""
    total = torch.zeros(())
    for action in actions:
        result = core.step(env.model, state, action, soft=True)
        state, total = result.state, total + result.reward.sum()
    return total


def starts(env: TorchEnv) -> list[tuple[EnvState, Tensor]]:
    """States along an episode of strong, slowly changing actions, and the next actions."""
    draw, found = torch.Generator().manual_seed(3), []
    env.reset(seed=0)
    noise = torch.zeros(1, 2, 4, 4)
    for _ in range(4):
        actions = []
        for _ in range(STEPS):
            noise = 0.9 * noise + math.sqrt(1 - 0.9**2) * torch.randn(noise.shape, generator=draw)
            actions.append(bicubic(noise, env.action_resolution).clamp(-1, 1))
        found.append((env.env_state, torch.stack(actions)))
        with torch.no_grad():
            for action in actions:
                env.step(action)
    return found


def test_gradients_are_bounded_and_lead_upwards() -> None:
    """Exact ones of compacted soil overflow or are huge; the limited ones raise the return of most windows."""
    env, exact = dig(False), dig(True)
    improved, huge = 0, 0
    for state, actions in starts(env):
        state.particles.Jp[:, 500:] -= 0.1
        leaf = actions.clone().requires_grad_()
        found, steep = (torch.autograd.grad(returns(each, state, leaf), leaf)[0] for each in (env, exact))
        assert found.isfinite().all()
        norms = found.flatten(1).norm(dim=1)
        huge += not steep.double().norm() < 1e3 * found.norm()
        with torch.no_grad():
            ahead = (actions + 0.2 * found / norms[:, None, None, None, None]).clamp(-1, 1)
            improved += bool(returns(env, state, ahead) > returns(env, state, actions))
    assert improved >= 3
    assert huge >= 2
