import numpy as np
import pytest
import torch
from fakes import FakeEnv

from cfp.envs.vec_env import TorchVecEnv


def actions(env, value=0.0):
    return np.full((env.num_envs, 2, 8, 8), value, np.float32)


def test_last_observation_of_an_episode_is_kept_and_the_next_one_returned():
    env = TorchVecEnv(FakeEnv(num_envs=2, horizon=3))
    first = env.reset()
    for _ in range(2):
        before, _, done, infos = env.step(actions(env, 1.0))
        assert not done.any()
        assert "terminal_observation" not in infos[0]
    after, _, done, infos = env.step(actions(env, 1.0))
    assert done.all()
    np.testing.assert_array_equal(after, first)
    for index, info in enumerate(infos):
        assert info["terminal_observation"][1].max() == 3  # the step counter in the picture
        assert info["terminal_observation"][0, 0, 0] == round(30 + 10 * index + 50)
        assert info["TimeLimit.truncated"]
    assert before[0, 1].max() == 2  # earlier observations are copies, whatever the environment does with its buffer


def test_first_episodes_are_truncated_at_different_ages_and_a_state_continues_them():
    def lengths(env, steps):
        ended = [[] for _ in range(env.num_envs)]
        for step in range(steps):
            _, _, done, infos = env.step(actions(env))
            for i in np.flatnonzero(done):
                ended[i].append(step)
                assert infos[i]["TimeLimit.truncated"]
        return ended

    env = TorchVecEnv(FakeEnv(num_envs=2, horizon=50), max_episode_steps=6, stagger=True)
    env.reset()
    assert lengths(env, 20) == [[2, 8, 14], [5, 11, 17]]
    env.reset()
    lengths(env, 4)
    other = TorchVecEnv(FakeEnv(num_envs=2, horizon=50), max_episode_steps=6, stagger=True)
    other.reset()
    other.load_state_dict(env.state_dict())
    assert lengths(other, 10) == lengths(env, 10) == [[4], [1, 7]]
    plain = TorchVecEnv(FakeEnv(num_envs=2, horizon=50), max_episode_steps=6)
    plain.reset()
    assert lengths(plain, 20) == [[5, 11, 17]] * 2
    with pytest.raises(ValueError, match="state must hold tensors of shapes"):
        TorchVecEnv(FakeEnv(num_envs=3), max_episode_steps=6).load_state_dict(env.state_dict())


def test_episodes_are_never_longer_than_the_horizon():
    env = TorchVecEnv(FakeEnv(num_envs=2, horizon=6), max_episode_steps=10)
    env.reset()
    ends = [step for step in range(13) if env.step(actions(env))[2].all()]
    assert ends == [5, 11]


def test_only_the_element_that_ended_is_reset():
    env = TorchVecEnv(FakeEnv(num_envs=2, horizon=50, end_above=0.15))
    env.reset()
    observation, _, done, infos = env.step(actions(env, 1.0))
    assert done.tolist() == [False, True]  # heights 0.1 and 0.2
    assert observation[:, 1, 0, 0].tolist() == [1, 0]
    assert infos[1]["terminal_observation"][1, 0, 0] == 1
    assert infos[1]["TimeLimit.truncated"] is False
    assert "TimeLimit.truncated" not in infos[0]


def test_time_limit_counts_as_truncation_even_if_the_element_terminates():
    env = TorchVecEnv(FakeEnv(num_envs=1, horizon=1, end_above=-1.0))
    env.reset()
    _, _, done, infos = env.step(actions(env))
    assert done[0]
    assert infos[0]["TimeLimit.truncated"] is True


def test_element_whose_state_is_not_finite_ends_without_bootstrap():
    env = TorchVecEnv(FakeEnv(num_envs=2, horizon=9, faults={2: "state"}))
    env.reset()
    env.step(actions(env))
    observation, _, done, infos = env.step(actions(env))
    assert done.tolist() == [True, False]
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[0]["finite"] is False
    assert observation[:, 1, 0, 0].tolist() == [0, 2]


def test_info_holds_named_numbers_for_each_element():
    env = TorchVecEnv(FakeEnv(num_envs=2))
    env.reset()
    _, reward, _, infos = env.step(actions(env, 1.0))
    for index, info in enumerate(infos):
        assert info["reward_terms/near"] + info["reward_terms/alive"] == pytest.approx(reward[index])
        assert isinstance(info["is_success"], bool)
        assert info["finite"] is True


def test_seed_is_used_at_the_next_reset_and_its_layout_kept():
    env = TorchVecEnv(FakeEnv(num_envs=2))
    env.seed(7)
    first = env.reset()
    assert first[:, 0, 0, 0].tolist() == [57, 67]
    np.testing.assert_array_equal(env.reset(), first)


def test_options_are_used_at_the_next_reset_only():
    env = TorchVecEnv(FakeEnv(num_envs=2))
    env.reset()
    env.step(actions(env))
    mask = torch.tensor([True, False])
    env.set_options({"reset_mask": mask})
    assert env.reset()[:, 1, 0, 0].tolist() == [0, 1]
    assert env.reset()[:, 1, 0, 0].tolist() == [0, 0]


@pytest.mark.parametrize("others", [[{}], [{"physics": {"mu": np.full(3, 2.0)}}], []])
def test_options_that_differ_are_refused(others):
    env = TorchVecEnv(FakeEnv(num_envs=2))
    env.set_options([{"physics": {"mu": np.full(3, 1.0)}}, *others])
    with pytest.raises(ValueError, match="options must be one dictionary for all 2 elements"):
        env.reset()


@pytest.mark.parametrize("steps", [-1, 0])  # -1 is no limit in Gymnasium
def test_a_limit_of_no_steps_is_refused(steps):
    with pytest.raises(ValueError, match=f"max_episode_steps must be at least 1, got {steps}"):
        TorchVecEnv(FakeEnv(num_envs=2), max_episode_steps=steps)


def test_elements_share_attributes_and_pictures_come_one_by_one():
    env = TorchVecEnv(FakeEnv(num_envs=2))
    assert env.get_attr("push") == [0.1, 0.1]
    assert env.get_attr("push", 1) == [0.1]
    env.set_attr("push", 7)
    assert env.get_attr("push") == [7, 7]
    env.set_attr("render_mode", None)
    assert env.get_attr("render_mode") == [None, None]
    assert env.env_method("render", 1)[0].max() == 1
    with pytest.raises(ValueError, match="indices"):
        env.set_attr("push", 7, indices=[0])
    assert [int(image.max()) for image in env.get_images()] == [0, 1]
    assert env.env_is_wrapped(object) == [False, False]


def test_actions_reach_the_environment_unclipped():
    fake = FakeEnv(num_envs=1)
    env = TorchVecEnv(fake)
    env.reset()
    env.step(actions(env, 1.25))
    assert torch.equal(fake.actions[-1], torch.full((1, 2, 8, 8), 1.25))
