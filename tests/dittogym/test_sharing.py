"""What a user holds is his own: changing it changes neither the environment nor a saved moment."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tiny import SMALL, assert_same_bits, begun, everything, leaves, tiny

from dittogym.env import Env
from dittogym.vector import BatchEnv

MAKERS = {
    "torch": lambda: tiny("catch", 2, dtype="float32"),
    "batch": lambda: BatchEnv("catch", 2, **SMALL),
    "single": lambda: Env("catch", **SMALL),
}


def play(env: Any, writes: bool) -> list[Any]:
    """All that an environment returns; with ``writes``, it and all arguments are overwritten after each call."""
    rows, inner = [], getattr(env, "torch_env", env)

    def call(function: Callable[..., Any], *arguments: Any, **options: Any) -> None:
        found = function(*arguments, **options)
        rows.append(copy.deepcopy(found))
        for _, array in leaves((found, arguments, options)) if writes else ():
            if array.ndim and array.flags.writeable:
                array[...] = 7
        rows.append(copy.deepcopy((everything(inner), inner.observation())))

    def step() -> None:
        action = torch.full((inner.num_envs, *inner.action_shape), 0.5)
        call(env.step, action if env is inner else action.numpy()[0] if isinstance(env, Env) else action.numpy())

    def write() -> None:
        if writes:
            for tensor in everything(inner):
                tensor.add_(1)

    call(env.reset, seed=0)
    places, mu = inner.state.x[0].numpy().copy(), np.linspace(500.0, 600.0, inner.num_envs)
    call(env.reset, options={"positions": places, "physics": {"mu": mu}})
    for _ in range(2):
        write()
        call(env.reset)
        step()
    moment = env.save()
    for _ in range(2):
        write()
        call(env.load, moment)
    call(env.reset, seed=1, options={"physics": {}})
    call(env.load, moment)
    step()
    return rows


@pytest.mark.parametrize("name", MAKERS)
@torch.no_grad()
def test_what_is_given_and_returned_may_be_written_to(name: str) -> None:
    """Also the present state: neither the next reset nor a moment that was saved before is touched."""
    assert_same_bits(play(MAKERS[name](), True), play(MAKERS[name](), False))


def test_an_action_that_is_ignored_stays_as_it_was() -> None:
    env = begun(BatchEnv("run", 2, max_episode_steps=1, **SMALL))
    action = np.full(env.action_space.shape, 0.5, np.float32)
    env.step(action)
    ignored = np.full_like(action, np.nan)  # both elements begin anew
    env.step(ignored)
    assert (action == 0.5).all() and np.isnan(ignored).all()
