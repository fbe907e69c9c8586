"""Saved moments: what goes on from one is, to the last bit, what would have gone on without."""

from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tiny import ALL, SMALL, TASKS, actions, assert_same_bits, begun, everything, make_vec, stir, tiny

from dittogym import TorchEnv, make_spec
from dittogym.snapshots import Snapshot
from torchmpm import VonMises, tree

STEPS = 3


def contents(snapshot: Snapshot) -> list[torch.Tensor]:
    """Copies of all tensors of a snapshot."""
    return [tensor.detach().clone() for tensor in (*tree.leaves(snapshot.state), snapshot.observation)]


def go_on(env: TorchEnv, drive: torch.Tensor) -> list[Any]:
    """Results of all steps, and all that moves after each."""
    return [(env.step(action), everything(env)) for action in drive]


@pytest.mark.parametrize("conditions", [None, {**vars(ALL), "latency": 2}], ids=["plain", "conditions"])
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@torch.no_grad()
def test_a_loaded_moment_goes_on_as_it_would_have(task: str, dtype: str, conditions: Any, tmp_path) -> None:
    """In the same environment, after more steps and a reset; through a file in a new one; and in one elsewhere."""
    env, new, elsewhere = (tiny(task, 2, dtype=dtype, substeps=10, conditions=conditions) for _ in range(3))
    env.reset(seed=4)
    stir(env)
    drive = actions(env, 2 + STEPS)
    for action in drive[:2]:
        seen = env.step(action)[0]
    moment = env.save()
    future = go_on(env, drive[2:])
    env.reset()
    following = dict(env.env_state.conditions)
    env.reset(seed=9)
    elsewhere.reset(seed=30)
    elsewhere.step(drive[0])
    torch.save(moment, tmp_path / "moment.pt")
    read = torch.load(tmp_path / "moment.pt", weights_only=True)
    for other, given in ((env, moment), (new, read), (elsewhere, moment)):
        assert torch.equal(other.load(given), seen)
        assert_same_bits(go_on(other, drive[2:]), future)
        other.reset()
        assert_same_bits(dict(other.env_state.conditions), following)


@pytest.mark.parametrize("mode", [None, "SameStep", "NextStep", "Disabled"])
def test_through_gymnasium(mode: str | None) -> None:
    """The future from a moment, behind all wrappers, and of a batch in each mode."""
    single = gymnasium.make("dittogym/catch-coarse-v0", **SMALL)
    env = begun(single if mode is None else make_vec("catch", autoreset_mode=mode), seed=2)
    env.action_space.seed(0)
    drive = [env.action_space.sample() for _ in range(2 + STEPS)]
    seen = [env.step(action) for action in drive[:2]][-1][0]
    moment = env.unwrapped.save()
    future = [env.step(action) for action in drive[2:]]
    env.reset(seed=8)
    loaded = env.unwrapped.load(moment)
    assert isinstance(loaded, np.ndarray) and np.array_equal(loaded, seen)
    assert_same_bits([env.step(action) for action in drive[2:]], future)


def test_an_ended_element_goes_on_from_a_loaded_moment() -> None:
    """Its reset, due in the next call, is off; the step count of the moment is back."""
    env = begun(make_vec(max_episode_steps=3))
    action = np.ones(env.action_space.shape, np.float32)
    env.step(action)
    env.step(action)
    moment = env.unwrapped.save()
    wanted = env.step(action)
    assert wanted[3].all()
    env.unwrapped.load(moment, np.array([True, False]))
    observations, rewards, _, truncated, info = env.step(action)
    assert np.array_equal(observations[0], wanted[0][0]) and rewards[0] == wanted[1][0]
    assert truncated.tolist() == [True, False] and info["_reward_terms/alive"].tolist() == [True, False]
    assert env.unwrapped.torch_env.env_state.steps.tolist() == [3, 0]


@torch.no_grad()
def test_one_moment_into_every_element() -> None:
    """Branches: what every element does is what the single simulation would have done with its actions."""
    source, single, batch = tiny("slot", 2), tiny("slot"), tiny("slot", 3)
    source.reset(seed=5)
    stir(source)
    source.step(actions(source, 1)[0])
    with pytest.raises(IndexError):
        source.save()[2]
    moment = source.save()[-1]
    batch.reset(seed=0)
    assert torch.equal(batch.load(moment), moment.observation.expand(3, -1, -1, -1))
    drive = actions(batch, STEPS, seed=1)
    future = go_on(batch, drive)
    for i in range(3):
        single.load(moment)
        for (result, numbers), action in zip(future, drive[:, i : i + 1], strict=True):
            assert torch.equal(result[0][i], single.step(action)[0][0])
            for ours, theirs in zip(numbers, everything(single), strict=True):
                assert float((ours[i] - theirs[0]).abs().max()) <= 1e-9 * max(1.0, float(theirs.abs().max()))
    assert not torch.equal(batch.state.x[0], batch.state.x[1])


@pytest.mark.parametrize(("task", "conditions"), [("grow", None), ("run", None), ("run", ALL)])
@torch.no_grad()
def test_only_masked_elements_are_loaded(task: str, conditions: Any) -> None:
    env, twin = (tiny(task, 3, conditions=conditions) for _ in range(2))
    drive = actions(env, 4)
    for e in (env, twin):
        e.reset(seed=1)
        stir(e)
    moment = env.save()
    for action in drive[:2]:
        env.step(action)
        twin.step(action)
    seen = env.load(moment, mask=[False, True, False])
    now, then = everything(env), contents(moment)
    assert env.env_state.steps.tolist() == [2, 0, 2]
    assert torch.equal(seen[1], moment.observation[1]) and torch.equal(seen[0], twin.save().observation[0])
    assert_same_bits([t[1] for t in now], [t[1] for t in then[:-1]])
    for action in drive[2:]:
        ours, theirs = env.step(action), twin.step(action)
        for i in (0, 2):
            assert torch.equal(ours[0][i], theirs[0][i]) and ours[1][i] == theirs[1][i]
            assert_same_bits([t[i] for t in everything(env)], [t[i] for t in everything(twin)])


@torch.no_grad()
def test_physics_travels_with_a_moment() -> None:
    """Into an environment with the task's own constants, whole or in part; the next reset knows nothing of it."""
    physics = {"mu": torch.tensor([200.0, 900.0]), "gravity": [[0.0, 5.0], [0.0, -30.0]], "mass": 2.0}
    env, plain = tiny("run", 2), tiny("run", 2)
    env.reset(seed=0, options={"physics": physics})
    moment = env.save()
    drive = actions(env, STEPS)
    future = go_on(env, drive)
    plain.reset(seed=0)
    own = go_on(plain, drive)
    assert not torch.equal(plain.state.x, env.state.x)
    plain.load(moment)
    assert_same_bits(go_on(plain, drive), future)
    plain.reset()
    assert_same_bits([plain.step(action) for action in drive], [result for result, _ in own])
    env.reset(options={"physics": {}})
    env.load(moment, mask=[False, True])
    assert env.env_state.physics["mu"].tolist() == [650.0, 900.0]
    assert env.env_state.physics["gravity"].tolist() == [[0.0, -9.0], [0.0, -30.0]]
    assert env.env_state.physics["mass"].tolist() == [1.0, 2.0]


def test_a_snapshot_fits_functions_with_the_same_arguments() -> None:
    def scaled(factor: float) -> TorchEnv:
        spec = make_spec("run")
        reward_fn = partial(
            lambda transition, spec, factor: make_spec("run").reward_fn(transition, spec), factor=factor
        )
        env = begun(tiny(replace(spec, reward_fn=reward_fn), 2))
        return env

    scaled(2.0).load(scaled(2.0).save())
    with pytest.raises(ValueError, match="the same reward_fn"):
        scaled(2.0).load(scaled(3.0).save())


@pytest.mark.parametrize("task", ["slot", "grow"])
def test_gradients_flow_through_a_saved_moment(task: str) -> None:
    """Of a reward after a detour to actions before the saved moment; not to those of the detour."""
    straight, env = tiny(task), tiny(task)
    drives = [actions(env, 3).requires_grad_() for _ in range(2)]
    straight.reset(seed=0)
    straight.step(drives[0][0])
    straight.step(drives[0][2])[1].sum().backward()
    env.reset(seed=0)
    env.step(drives[1][0])
    moment = env.save()
    env.step(drives[1][1])
    env.load(moment)
    env.step(drives[1][2])[1].sum().backward()
    ours, wanted = drives[1].grad, drives[0].grad
    assert min(wanted[0].abs().max(), wanted[2].abs().max()) > 1e-6
    assert torch.allclose(ours, wanted, rtol=1e-10, atol=1e-12) and ours[1].abs().max() == 0


@torch.no_grad()
def test_elements_that_were_only_ever_loaded_can_be_reset() -> None:
    source, batch = tiny("run"), tiny("run", 2)
    source.reset(seed=0)
    batch.load(source.save())
    batch.reset(options={"reset_mask": [True, False]})
    batch.reset()
    assert batch.state.x[1, :, 1].min() > 0.1


@torch.no_grad()
def test_a_state_that_is_assigned_brings_its_own_picture() -> None:
    env, other = tiny("run"), tiny("run")
    env.reset(seed=0)
    moved = env.step(actions(env, 1)[0])[0]
    other.env_state = env.env_state  # of an environment that was never reset
    assert torch.equal(other.save().observation, moved)


def test_learned_materials_are_no_part_of_what_a_moment_must_fit() -> None:
    """After a step of the optimiser, an environment returns to where it was before; a fixed material is compared."""
    moments = {}
    for learns in (True, False):
        for mu in (650.0, 700.0):
            matter = VonMises(torch.tensor(mu, requires_grad=learns), 50.0, 90.0)
            spec = make_spec("run")
            env = begun(tiny(replace(spec, robot=replace(spec.robot, material=matter))))
            env.step(actions(env, 1)[0])
            moments.setdefault(learns, []).append((env, env.save()))
    (_, before), (env, _) = moments[True]
    env.load(before)
    assert torch.equal(env.state.x, before.state.particles.x)
    (_, before), (env, _) = moments[False]
    with pytest.raises(ValueError, match="the same robot"):
        env.load(before)


@pytest.mark.cuda
def test_materials_on_a_device() -> None:
    spec = make_spec("run")
    matter = VonMises(torch.tensor(650.0, device="cuda"), 50.0, 90.0)
    env = begun(tiny(replace(spec, robot=replace(spec.robot, material=matter)), device="cuda"))
    env.load(env.save())


def test_representations_are_short() -> None:
    env = begun(tiny("run", 2))
    assert all(len(repr(thing)) < 200 for thing in (env.env_state, env.save(), env.spec))
