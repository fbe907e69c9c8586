"""The batched environment: resets, batches, gradients, bad input."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import ALL, actions, assert_same_bits, begun, everything, forget, tiny
from torch.utils.checkpoint import checkpoint

import dittogym
from dittogym import TASKS, TorchEnv
from dittogym.core import FAILURE_REWARD
from dittogym.observation import per_particle
from torchmpm import tree


def small(task: str = "run", num_envs: int = 1, **options) -> TorchEnv:
    options = {"particles": 300, "substeps": 10, "dtype": "float64", **options}
    return TorchEnv(task, num_envs, **options)


def test_layouts_follow_seeds() -> None:
    env = begun(small(num_envs=2), seed=1)
    first = env.state.x
    env.reset()
    assert torch.equal(env.state.x, first)
    env.reset(seed=2)
    assert torch.equal(env.state.x[0], first[1])
    assert not torch.equal(env.state.x[1], first[1])
    other = begun(small(num_envs=2, resample=True), seed=1)
    assert torch.equal(other.state.x, first)
    other.reset()
    assert not torch.equal(other.state.x, first)
    assert not torch.equal(small(num_envs=2).reset()[0], small(num_envs=2).reset()[0])  # entropy of the system


def test_a_seed_for_each_element() -> None:
    env, counted = small(num_envs=3), small(num_envs=3)
    counted.reset(seed=5)
    env.reset(seed=[7, 5, 6])
    assert torch.equal(env.state.x, counted.state.x[[2, 0, 1]])
    before = env.state.x
    env.reset(seed=[None, 7, None])
    assert torch.equal(env.state.x, torch.stack([before[0], before[0], before[2]]))
    env.reset(seed=[7, 5, 6])
    env.reset(seed=(0, 0, 7), options={"reset_mask": torch.tensor([False, False, True])})
    assert torch.equal(env.state.x, counted.state.x[[2, 0, 2]])


def test_a_reset_shows_the_new_episode() -> None:
    env = small()
    first, _ = env.reset(seed=0)
    for action in actions(env, 4):
        last = env.step(action)[0]
    again, _ = env.reset()
    assert torch.equal(again, first) and not torch.equal(again, last)
    assert torch.equal(env.env_state.centre, env.env_state.start.com)


def test_positions_option() -> None:
    env = small(num_envs=2)
    mine = np.stack((np.linspace(0.4, 0.6, 300), np.full(300, 0.3)), axis=1)
    observation, info = env.reset(seed=3, options={"positions": mine})
    assert env.state.x[1].numpy() == pytest.approx(mine)
    assert info["com"][0].tolist() == pytest.approx([0.5, 0.3])
    env.step(torch.zeros(2, *env.action_shape))
    assert torch.equal(env.reset()[0], observation)


def test_layouts_of_arrays_do_not_matter() -> None:
    """Mirrored, of the other byte order, or read-only."""
    env = dittogym.Env("run", particles=60, substeps=1, dtype="float64")
    masses = np.linspace(1.0, 2.0, 60)[None]
    drawn = begun(small(particles=60))
    positions = drawn.state.x[0].numpy()
    action = np.random.default_rng(0).uniform(-1, 1, env.action_space.shape)
    results = []
    for form in (
        lambda a: a,
        lambda a: a[..., ::-1].copy()[..., ::-1],
        lambda a: a.astype(a.dtype.newbyteorder()),
        lambda a: np.broadcast_to(a, a.shape),
    ):
        env.reset(options={"positions": form(positions), "physics": {"mass": form(masses)}})
        results.append(env.step(form(action))[1])
    assert results == results[:1] * 4


@pytest.mark.parametrize("backend", ["auto", "eager"])
@pytest.mark.parametrize("task", TASKS)
def test_defaults_of_torch_change_nothing(task: str, backend: str) -> None:
    """Of dtype, device and autocast: neither the first particle, nor a pixel, nor the type of an entry of ``info``."""
    results = []
    for context in (nullcontext(), float64(), torch.device("meta"), torch.autocast("cpu", torch.bfloat16)):
        forget(per_particle)
        with context:
            env = TorchEnv(task, particles="lite", substeps=2, backend=backend)
            env.reset(seed=0, options={"physics": {"mu": 650.1, "max_actuation": [30.0]}})
            action = torch.full((1, *env.action_shape), 0.3, dtype=torch.float32, device="cpu")
            results.append((env.step(action, soft=True), env.env_state, env.observation()))
    expected, *others = map(tree.leaves, results)
    for found in others:
        for one, other in zip(found, expected, strict=True):
            assert one.dtype == other.dtype and torch.equal(one, other)


@pytest.mark.parametrize("task", TASKS)
def test_numbers_have_the_precision_of_the_environment(task: str) -> None:
    env = small(task, particles=60, substeps=1)
    _, info = env.reset(seed=0)
    _, reward, *_, later = env.step(torch.zeros(1, *env.action_shape))
    numbers = [value for value in tree.leaves((info, reward, later)) if value.is_floating_point()]
    assert {value.dtype for value in numbers} == {torch.float64}


@contextmanager
def float64() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("conditions", [None, {**vars(ALL), "mu": 4.0}])
def test_bad_input_changes_nothing(conditions: dict | None) -> None:
    """Neither of this episode nor of the next."""
    env, twin = (small(num_envs=2, conditions=conditions) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0, options={"physics": {"mu": 300.0}})
    before = env.state
    for options in ({"positions": np.zeros((299, 2))}, {"physics": {"mu": -1.0}}, {"physics": {"mu": 9e9}}):
        with pytest.raises(ValueError, match="must"):
            env.reset(seed=5, options=options)
    with pytest.raises(ValueError, match="action must"):
        env.step(torch.full((2, 2, 8, 8), torch.nan))
    other = begun(small("grow", 2))
    with pytest.raises(ValueError, match="snapshot must"):
        env.load(other.save(), [True, False])
    assert env.state is before
    env.reset(), twin.reset()
    assert_same_bits(everything(env), everything(twin))


@pytest.mark.parametrize("backend", ["auto", "eager"])
@pytest.mark.parametrize("task", ["run", "slot"])
@pytest.mark.parametrize(("count", "speed"), [(None, torch.nan), (1, torch.nan), (1, 1e200)])
def test_a_failed_element_leaves_shared_gradients_alone(
    task: str, backend: str, count: int | None, speed: float
) -> None:
    """In one action for all and one constant for all: the same as of the intact element by itself.

    One particle that is fast draws the centre, and with it a window that moves, away from all others.
    """
    found = []
    for batch in (1, 2):
        env = small(task, batch, particles=60, substeps=4, backend=backend)
        shared = actions(env, 1)[0, :1].requires_grad_()
        mu = torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
        env.reset(seed=0, options={"physics": {"mu": mu}})
        action = shared.expand(batch, -1, -1, -1)
        env.step(action)
        v = env.state.v.clone()
        v[1:, :count] = speed
        env.env_state = replace(env.env_state, particles=replace(env.state, v=v))
        rewards = [env.step(action, soft=soft)[1] for soft in (True, False)]
        assert torch.equal(rewards[0][1:], torch.full((batch - 1,), FAILURE_REWARD, dtype=torch.float64))
        found.append(torch.autograd.grad(sum(rewards).sum(), (shared, mu)))
    for alone, beside in zip(*found, strict=True):
        torch.testing.assert_close(beside, alone, rtol=1e-12, atol=1e-15)
        assert alone.abs().max() > 0


@pytest.mark.parametrize("use_reentrant", [True, False])
def test_a_step_is_not_repeated_by_a_checkpoint(use_reentrant: bool) -> None:
    """It would begin in the state after the step, and the gradients would be wrong."""
    env = begun(small())
    action = torch.zeros(1, 2, 8, 8, dtype=torch.float64, requires_grad=True)
    reward = checkpoint(lambda action: env.step(action)[1], action, use_reentrant=use_reentrant)
    with pytest.raises(RuntimeError, match=r"TorchEnv\.step must not be called in a backward pass"):
        reward.sum().backward()


def test_pictures_of_the_other_simulations_keep_their_muscles() -> None:
    env = begun(small(num_envs=2))
    start = env.save()
    env.step(torch.full((2, 2, 8, 8), 0.5, dtype=torch.float64))
    moving, mask = env.render(1), torch.tensor([True, False])
    env.reset(options={"reset_mask": mask})
    assert np.array_equal(env.render(1), moving)
    env.load(start, mask)
    assert np.array_equal(env.render(1), moving)


def test_the_centre_of_a_broken_simulation_is_the_last_that_was_finite() -> None:
    env = begun(small("slot", num_envs=2))
    state, centre = env.env_state, env.env_state.centre
    v = torch.where(torch.tensor([True, False])[:, None, None], torch.nan, state.particles.v)
    env.env_state = replace(state, particles=replace(state.particles, v=v))
    with torch.no_grad():
        *_, info = env.step(torch.zeros(2, 2, 8, 8, dtype=torch.float64))
    assert info["finite"].tolist() == [False, True]
    assert torch.equal(env.env_state.centre[0], centre[0]) and env.env_state.origin.isfinite().all()
    assert env.soft_observation().isfinite().all()
    for spoilt in (torch.nan, 1e30):
        env.env_state = replace(env.env_state, particles=replace(state.particles, x=state.particles.x * spoilt))
        assert env.render(0).shape == (512, 512, 3)


def test_image_layout_acts_where_it_looks() -> None:
    """A contraction in the upper left pixels moves only matter in the upper left."""
    moved = {}
    for name in ("image", "grid"):
        env = begun(small("shapematch", particles=4000, resolution=8, action_layout=name))
        start = env.state.x.clone()
        action = torch.zeros(1, 2, 8, 8, dtype=env.dtype)
        action[..., :4, :4] = 1.0  # rows from the top and columns, or x and y
        env.step(action)
        weight = (env.state.x - start).square().sum(-1)[0]
        moved[name] = (weight[:, None] * (start[0] - env.env_state.start.com[0])).sum(0) / weight.sum()
    assert moved["image"][0] < -0.01 and moved["image"][1] > 0.01
    assert moved["grid"][0] < -0.01 and moved["grid"][1] < -0.01


def test_random_generators_can_be_put_back() -> None:
    env = begun(tiny("run", 2, resample=True))
    before = env.generators
    env.reset()
    places = env.state.x
    env.generators = before
    env.reset()
    assert torch.equal(env.state.x, places)


@torch.no_grad()
def test_run_displacement_is_the_same_at_every_tier() -> None:
    """A gentle drive over ten steps: centre of mass and reward of the lite tier against full size."""
    results = {}
    for particles in ("full", "lite"):
        env = begun(TorchEnv("run", 1, particles=particles))
        y, x = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
        for t in range(10):
            wave = torch.sin(0.3 * t + 0.7 * x + 1.1 * y)
            reward, *_, info = env.step(torch.stack((wave, -wave))[None])[1:]
        results[particles] = info["com"][0], float(reward), float(info["split"])
    assert (results["full"][0] - results["lite"][0]).abs().max() < 1e-3
    assert results["full"][1] == pytest.approx(results["lite"][1], abs=0.15)
    assert results["full"][2] == pytest.approx(results["lite"][2], abs=1e-3)
