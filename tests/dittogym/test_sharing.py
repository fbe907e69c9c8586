"""What a user holds is his own: changing it changes neither the environment nor its next resets."""

import numpy as np
import torch
from tiny import SMALL, tiny

from dittogym.env import Env
from dittogym.vector import BatchEnv


def test_states_positions_and_constants_that_are_changed_afterwards() -> None:
    env, mu = tiny("run", 2), torch.tensor([500.0, 600.0])
    env.reset(seed=0)
    given = env.state.x[0].numpy().copy()
    env.reset(options={"positions": given, "physics": {"mu": mu}})
    first = env.state.x.clone()
    given += 0.02
    mu *= 0.5
    for _ in range(2):
        assert torch.equal(env.state.x, first) and env.env_state.physics["mu"].tolist() == [500, 600]
        env.state.x.add_(0.01)
        env.reset()


def test_images_and_infos_that_are_written_to() -> None:
    batch = BatchEnv("catch", 2, **SMALL)
    image, _ = batch.reset(seed=0)
    seen = image.copy()
    image[:] = 7
    assert np.array_equal(batch.save().observation.numpy(), seen)
    single = Env("catch", **SMALL)
    for env, shape in ((batch, (2, 2, 8, 8)), (single, (2, 8, 8))):
        env.reset(seed=0)
        info = env.step(np.zeros(shape, np.float32))[-1]
        before = env.torch_env.env_state.task_state["object_com"].clone()
        info["object_com"][:] = 9.0
        assert torch.equal(env.torch_env.env_state.task_state["object_com"], before)


def test_what_a_batch_in_torch_returns_is_written_to() -> None:
    env, other = tiny("catch", 2), tiny("catch", 2)
    drive = torch.zeros(2, *env.action_shape)
    for each in (env, other):
        each.reset(seed=0)
    image, *_, info = env.step(drive)
    seen = other.step(drive)[0]
    image.zero_()
    for value in (info["object_com"], info["com"]):
        value.add_(1.0)
    assert torch.equal(env.save().observation, seen)
    env.load(env.save()).zero_()
    env.reset()[0].zero_()
    assert torch.equal(env.save().observation, other.reset()[0])
    env.step(drive)
    other.step(drive)
    assert torch.equal(env.step(drive)[1], other.step(drive)[1])


def test_an_action_that_is_ignored_stays_as_it_was() -> None:
    env = BatchEnv("run", 2, max_episode_steps=1, **SMALL)
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.5, np.float32)
    env.step(action)
    ignored = np.full_like(action, np.nan)  # both elements begin anew
    env.step(ignored)
    assert (action == 0.5).all() and np.isnan(ignored).all()
