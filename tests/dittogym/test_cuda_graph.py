"""Steps that are recorded once and replayed, with an imitation of CUDA graphs on the CPU."""

from __future__ import annotations

import copy
import gc
import logging
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tiny import TASKS, actions, assert_same_bits, begun, everything, forget, tiny
from torch.utils._python_dispatch import _disable_current_modes

from dittogym import TorchEnv, action, core
from dittogym.cuda_graph import WARM_UP, Replayed
from torchmpm import tree


class Imitation:
    """Runs the function again for each replay, and puts the numbers where the first run left them."""

    made = 0

    def __init__(self, device: torch.device) -> None:
        type(self).made += 1
        self.busy = False

    def record(self, function: Callable[[], Any]) -> Any:
        self.function, self.outputs = function, function()
        for output in tree.leaves(self.outputs):
            output.zero_()  # holds numbers only after a replay
        return self.outputs

    def replay(self) -> None:
        assert self.busy
        with _disable_current_modes():
            for output, new in zip(tree.leaves(self.outputs), tree.leaves(self.function()), strict=True):
                output.copy_(new)

    def wait(self) -> None:
        assert not self.busy
        self.busy = True

    def free(self) -> None:
        self.busy = False


def recorded(env: TorchEnv, graph: Any = Imitation) -> TorchEnv:
    """The environment as it steps on a GPU."""
    env._replayed = Replayed(core.simulate, graph)
    return env


@pytest.mark.parametrize("conditions", [None, {"latency": 2, "action_noise": 0.1, "velocity": 0.1}])
@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_a_replay_changes_nothing(task: str, conditions: Any) -> None:
    """Over resets of some and of all, other physics, and a snapshot."""
    made = Imitation.made
    ours, theirs = (tiny(task, 3, dtype="float32", conditions=conditions) for _ in range(2))
    pair = recorded(ours), theirs
    mask = torch.tensor([False, True, True])
    saved = None

    def run(steps: int) -> None:
        for given in actions(pair[0], steps):
            ours, theirs = (env.step(given) for env in pair)
            assert_same_bits(ours, theirs)
            assert_same_bits(*map(everything, pair))

    for options in (None, {"reset_mask": mask}, {"physics": {"max_actuation": [30.0, 40.0, 50.0]}}):
        assert_same_bits(*(env.reset(seed=0, options=options) for env in pair))
        run(WARM_UP + 3)
        saved = saved or pair[0].save()
    assert Imitation.made == made + 2  # with other physics it is another recording
    pair[0].reset(seed=0, options={"physics": {}}), pair[1].reset(seed=0, options={"physics": {}})
    assert_same_bits(*(env.load(saved, mask) for env in pair))
    run(2)


@torch.no_grad()
def test_results_belong_to_the_caller() -> None:
    env = begun(recorded(tiny("kick", 2)))
    for given in actions(env, WARM_UP + 2):
        env.step(given)
    step, state = env.step(actions(env, 1)[0]), env.env_state
    before = copy.deepcopy((step, state))
    env.step(-actions(env, 1)[0])
    assert_same_bits(tree.leaves((step, state)), tree.leaves(before))
    state.particles.x.zero_(), step[0].zero_()
    env.load(env.save())
    assert env.step(actions(env, 1)[0])[4]["finite"].all()


def test_gradients_are_not_recorded() -> None:
    env = begun(recorded(tiny("run", 2)))
    given = actions(env, 1)[0].requires_grad_()
    for _ in range(WARM_UP + 2):
        reward = env.step(given)[1]
    reward.sum().backward()
    assert given.grad is not None and given.grad.abs().sum() > 0


@torch.no_grad()
def test_what_cannot_be_recorded_is_called(caplog: pytest.LogCaptureFixture) -> None:
    class Refuses(Imitation):
        def record(self, function: Callable[[], Any]) -> Any:
            raise RuntimeError("operation not permitted when stream is capturing")

    class Differs(Imitation):
        def replay(self) -> None:
            super().replay()
            self.outputs.now.com.add_(1)

    for graph, reason in ((Refuses, "not permitted"), (Differs, "other numbers")):
        caplog.clear()
        pair = recorded(tiny("run", 2), graph), tiny("run", 2)
        for env in pair:
            env.reset(seed=0)
        with caplog.at_level(logging.WARNING):
            for given in actions(pair[0], WARM_UP + 3):
                assert_same_bits(*(env.step(given) for env in pair))
        assert len(caplog.records) == 1 and reason in caplog.text


@torch.no_grad()
def test_a_recording_keeps_the_constants_that_it_reads() -> None:
    forget(action.bicubic_matrix)
    env = begun(recorded(tiny("run", 2)))
    for given in actions(env, WARM_UP + 2):
        env.step(given)
    shape = env.action_resolution, env.spec.patch
    matrix = weakref.ref(action.bicubic_matrix(*shape, False, env.dtype, env.device))
    forget(action.bicubic_matrix)
    gc.collect()
    assert matrix() is not None
    env._replayed = None
    gc.collect()
    assert matrix() is None


@torch.no_grad()
def test_a_copy_of_an_environment_records_anew() -> None:
    env = begun(recorded(tiny("run", 2)))
    for given in actions(env, WARM_UP + 2):
        env.step(given)
    twin = copy.deepcopy(env)
    for given in actions(env, WARM_UP + 2, seed=1):
        assert_same_bits(env.step(given), twin.step(given))


def test_a_pointer_is_a_use() -> None:
    """Kernels get tensors as addresses, behind torch's back."""
    table = torch.ones(3)

    def launch(x: torch.Tensor) -> torch.Tensor:
        return x + float(table.data_ptr() > 0)

    replayed = Replayed(launch, Imitation)
    for _ in range(WARM_UP + 1):
        replayed(torch.zeros(2))
    assert replayed._recording is not None and any(tensor is table for tensor in replayed._recording.constants)
