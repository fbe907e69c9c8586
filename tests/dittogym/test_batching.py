"""Batches: equal to single environments, repeatable, and no element harms another; for every task."""

import dataclasses
import itertools
import random
from functools import partial

import numpy as np
import pytest
import torch
from tiny import ALL, FIXED, TASKS, actions, assert_same_bits, episode, everything, leaves, set_particles, stir, tiny

import dittogym
from dittogym import TorchEnv, core
from dittogym.core import FAILURE_REWARD


def assert_element_is(batch: TorchEnv, result: tuple, i: int, single: TorchEnv, one: tuple) -> None:
    """Element i of a batch and its result of a step against a batch of one: numbers to 1e-9, observation and ends."""
    for ours, theirs in zip(everything(batch), everything(single), strict=True):
        size = max(1.0, float(theirs[0].abs().max()))
        assert float((ours[i] - theirs[0]).abs().max()) <= 1e-9 * size
    for (path, ours), (_, theirs) in zip(leaves(result), leaves(one), strict=True):
        bound = 1e-9 * max(1.0, np.abs(theirs[0]).max()) if ours.dtype == np.float64 else 0
        assert np.abs(ours[i].astype(np.float64) - theirs[0]).max() <= bound, path


#: Of each of three elements.
PHYSICS = {
    "mu": [300.0, 600.0, 900.0],
    "lam": [20.0, 50.0, 80.0],
    "yield_stress": [5.0, 50.0, 90.0],
    "max_actuation": [20.0, 0.0, 50.0],
    "gravity": [[0.0, -12.0], [3.0, -9.0], [0.0, 0.0]],
    "mass": [0.5, 1.0, 2.0],
}


@pytest.mark.parametrize(("task", "given"), [*itertools.product(TASKS, ("nothing", "conditions")), ("kick", "physics")])
@torch.no_grad()
def test_a_batch_is_its_single_environments(task: str, given: str) -> None:
    """Random actions and velocities, an element reset alone, and two reset with new seeds."""
    conditions, physics = ALL if given == "conditions" else None, PHYSICS if given == "physics" else {}
    batch, *singles = (tiny(task, n, conditions=conditions, substeps=8) for n in (3, 1, 1, 1))
    start = batch.reset(seed=7, options={"physics": physics})
    for i, env in enumerate(singles):
        own = {name: values[i] for name, values in physics.items()}
        assert_element_is(batch, start, i, env, env.reset(seed=7 + i, options={"physics": own}))
        stir(env, i)
    stir(batch)
    for t, action in enumerate(actions(batch, 6)):
        if t == 2:
            batch.reset(options={"reset_mask": [False, True, False]})
            singles[1].reset()
        if t == 4:
            batch.reset(seed=40, options={"reset_mask": [True, False, True]})
            singles[0].reset(seed=40)
            singles[2].reset(seed=42)
        result = batch.step(action)
        for i, env in enumerate(singles):
            assert_element_is(batch, result, i, env, env.step(action[i : i + 1]))
    assert batch.env_state.steps.tolist() == [2, 4, 2]


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_repeats_bit_by_bit(task: str) -> None:
    env = partial(tiny, task, 2, particles=300, substeps=10, dtype="float32")
    assert_same_bits(episode(env(), 11), episode(env(), 11))


def spoil(env: TorchEnv, how: str) -> None:
    """Make element 1 unable to go on."""
    state = env.state
    if how in ("x", "v", "C", "F", "Jp"):  # a number of a particle of the robot, or of the object where there is one
        getattr(state, how)[1, -1 if how in ("C", "F") else 7].view(-1)[0] = torch.nan
    elif how == "inf":
        state.v[1, 7] = torch.inf
    elif how == "shot":
        state.v[1] = 1e300
    else:
        robot = slice(0, env.model.num_robot_particles)
        axis, distance = {"up": (1, 1.5), "down": (1, -1.5), "left": (0, -1.5), "right": (0, 1.5)}[how]
        state.x[1, robot, axis] += distance


WAYS = [(task, how) for task in TASKS for how in ("x", "v", "C", "F", "Jp", "inf", "shot", "up", "down")]
WAYS += [(task, how) for task in FIXED for how in ("left", "right")]


@pytest.mark.parametrize(("task", "how"), WAYS)
@torch.no_grad()
def test_an_element_fails_alone(task: str, how: str) -> None:
    """It ends, and its neighbours do as in a batch where nothing happened, also after it was reset."""
    env, twin = tiny(task, 3, substeps=2), tiny(task, 3, substeps=2)
    drive = actions(env, 4)
    for e in (env, twin):
        e.reset(seed=0)
        stir(e)
        e.step(drive[0])
    spoil(env, how)
    for t in range(1, 4):
        if t == 3:
            env.reset(options={"reset_mask": [False, True, False]})
        ours, theirs = env.step(drive[t]), twin.step(drive[t])
        for i in (0, 2):
            assert_same_bits([a[i] for _, a in leaves(ours)], [b[i] for _, b in leaves(theirs)])
            assert_same_bits([a[i] for a in everything(env)], [b[i] for b in everything(twin)])
        _, reward, terminated, _, info = ours
        if t < 3:
            assert info["finite"].tolist() == [True, False, True]
            assert bool(terminated[1]) and float(reward[1]) == FAILURE_REWARD
            terms = {name: float(term[1]) for name, term in info["reward_terms"].items()}
            assert terms.pop("failure") == FAILURE_REWARD and not any(terms.values())
            assert "is_success" not in info or not info["is_success"][1]
    assert info["finite"].all() and float(info["reward_terms"]["failure"][1]) == 0.0


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_global_generators_are_left_alone(task: str) -> None:
    """By construction, resets with and without a seed, steps, pictures, saved moments and robots of one's own."""

    def states() -> tuple:
        kind, keys, *rest = np.random.get_state()
        return random.getstate(), kind, keys.tolist(), rest, torch.get_rng_state().tolist()

    before = states()
    triangle = np.array([(0, 0), (2, 0), (1, 3)])
    for options in ({"particles": "lite", "substeps": 1}, {"body": triangle}, {"resample": True}):
        env = tiny(task, 2, **options)
        env.reset(seed=0)
        moment = env.save()
        env.step(actions(env, 1)[0])
        env.reset()
        env.load(moment)
        env.render(muscles=True, size=64)
    tiny(task).reset()  # entropy of the system
    assert states() == before


@pytest.mark.parametrize("task", ["kick", "grow", "catch"])
@torch.no_grad()
def test_rewards_of_a_batch_are_those_of_its_single_environments_to_the_last_bit(task: str) -> None:
    """The order in which the terms are added does not depend on the size of the batch."""
    batch, singles = tiny(task, 4, dtype="float32"), [tiny(task, dtype="float32") for _ in range(4)]
    batch.reset(seed=7)
    for i, env in enumerate(singles):
        env.reset(seed=7 + i)
    for action in actions(batch, 12):
        together = batch.step(action)[1]
        assert together.tolist() == [env.step(action[i : i + 1])[1].item() for i, env in enumerate(singles)]


@pytest.mark.parametrize("backend", ["auto", "eager"])
def test_a_reset_of_no_element_changes_nothing(backend: str) -> None:
    env = tiny("catch", 2, backend=backend)
    before, _ = env.reset(seed=0)
    seen, _ = env.reset(options={"reset_mask": [False, False]})
    assert torch.equal(seen, before)


def test_a_simulation_that_blows_up_ends() -> None:
    env = tiny(dataclasses.replace(dittogym.make_spec("run"), max_actuation=1e3), 2, particles=300, substeps=100)
    env.reset(seed=0)
    action = torch.zeros(2, *env.action_shape)
    action[1] = 2.0 * torch.rand(env.action_shape, generator=torch.Generator().manual_seed(0)) - 1.0
    _, reward, terminated, _, info = env.step(action)
    assert info["finite"].tolist() == [True, False] and terminated.tolist() == [False, True]
    assert reward[0] > 0 and reward[1] == core.FAILURE_REWARD and env.state.is_finite().all()


@pytest.mark.parametrize("shift", [(3.0, 0.0), (0.0, -3.0), (0.0, 3.0)])
def test_one_particle_of_the_robot_in_the_window_is_enough(shift: tuple[float, float]) -> None:
    """The object does not count."""
    env = tiny("kick", 2)
    env.reset(seed=0)
    x, robot = env.state.x.clone(), env.model.num_robot_particles
    x[1, :robot] += torch.tensor(shift)
    for valid in (False, True):
        set_particles(env, x=x)
        assert core.is_valid(env.model, env.env_state).tolist() == [True, valid]
        x[1, robot - 1] = env.state.x[0, 0]
