"""The observation drawn by the C++ function equals the one that torch draws."""

import math
from dataclasses import replace

import pytest
import torch
from tiny import TASKS, actions, begun, on_edge, set_particles, tiny

import dittogym
from dittogym import core
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")


def both(env: dittogym.TorchEnv) -> tuple[torch.Tensor, torch.Tensor]:
    """The present observation, natively and in torch."""
    assert env.model.camera.native
    plain = replace(env.model, camera=replace(env.model.camera, native=False))
    return core.observe(env.model, env.env_state), core.observe(plain, env.env_state)


def scene(task: str, pixels: bool, num_envs: int = 2, **options: object) -> dittogym.TorchEnv:
    """Robots in motion, and particles anywhere, which set pixels, as with full counts, or are splats."""
    env = tiny(task, num_envs, **options)
    env.model = replace(env.model, camera=replace(env.model.camera, pixels=pixels))
    env.reset(seed=2)
    with torch.no_grad():
        for action in actions(env, 2):
            env.step(action)
    generator = torch.Generator().manual_seed(0)
    x = env.state.x + 0.1 * torch.rand(env.state.x.shape, generator=generator, dtype=env.dtype)
    set_particles(env, x=x, v=4.0 * torch.randn(x.shape, generator=generator, dtype=env.dtype))
    return env


def lost(env: dittogym.TorchEnv) -> dittogym.TorchEnv:
    """The scene with particles of the first two simulations that are not finite, or anywhere else in the world."""
    x, v = env.state.x.clone(), env.state.v.clone()
    x[0, 0, 0], x[0, 1, 1], v[0, 2, 0], v[0, 3, 1] = math.nan, math.inf, -math.inf, math.nan
    x[1, :5] = torch.tensor([[9.0, 0.3], [-9.0, 0.3], [0.0, 1e30], [0.0, -0.5], [1e-9, 1.0]], dtype=env.dtype)
    x[1, 5:10, 1] += 0.9
    set_particles(env, x=x, v=v)
    return env


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("pixels", [False, True])
@pytest.mark.parametrize("task", TASKS)
def test_same_bytes(task: str, pixels: bool, dtype: str) -> None:
    """Splats are added in another order, so that a sum on the edge of two bytes may be either. Pixels may not."""
    env = scene(task, pixels, 3, particles=600, dtype=dtype)
    ours, plain = both(env)
    assert len(ours.unique()) > 20
    differs = (ours.int() - plain.int()).abs()
    assert differs.max() <= (not pixels)
    assert not (differs.bool() & ~on_edge(env)).any()


@pytest.mark.parametrize("pixels", [False, True])
def test_what_is_not_drawn(pixels: bool) -> None:
    env = tiny("kick", 2)
    env.model = replace(env.model, camera=replace(env.model.camera, pixels=pixels))
    env.reset(seed=0)
    assert torch.equal(*both(lost(env)))


def test_centre_that_is_not_a_number() -> None:
    """Then the robot itself is nowhere; its neighbours in the batch are drawn as ever."""
    env = tiny("run", 2)
    before = env.reset(seed=0)[0]
    state = env.env_state
    env.env_state = replace(state, centre=torch.tensor([[math.nan, math.nan], state.centre[1].tolist()]).to(env.dtype))
    assert torch.equal(both(env)[0][1], before[1])


def test_threads_share_a_batch() -> None:
    env = begun(tiny("catch", 5))
    images = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        images.append(core.observe(env.model, env.env_state))
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])


def test_eager_physics_draws_in_torch() -> None:
    assert not tiny("run", backend="eager").model.camera.native
