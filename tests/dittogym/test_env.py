"""The Gymnasium faces: registered ids, checkers, vector environments."""

import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from tiny import SMALL, make_vec

import dittogym


@pytest.mark.parametrize("task", dittogym.TASKS)
def test_checkers_have_nothing_to_say(task: str) -> None:
    name = f"dittogym/{task}-coarse-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(name, render_mode="rgb_array", **SMALL).unwrapped)
        check_env_sb3(gymnasium.make(name, **SMALL))


@pytest.mark.parametrize("resolution", ["coarse", "fine"])
@pytest.mark.parametrize("task", dittogym.TASKS)
def test_spaces_and_time_limit_of_every_id(task: str, resolution: str) -> None:
    env = gymnasium.make(f"dittogym/{task}-{resolution}-v0", **SMALL)
    spec = dittogym.make_spec(task)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (2, *[getattr(spec, resolution)] * 2), np.float32)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (3, 64, 64), np.uint8)
    assert env.spec.max_episode_steps == spec.horizon


def test_step_and_info() -> None:
    env = gymnasium.make("dittogym/run-coarse-v0", **SMALL)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert info["finite"] is True and info["com"].shape == (2,)
    _, reward, terminated, truncated, info = env.step(np.zeros((2, 8, 8), np.float32))
    assert isinstance(reward, float) and terminated is False and truncated is False
    terms = {name.removeprefix("reward_terms/"): value for name, value in info.items() if "reward_terms" in name}
    assert reward == pytest.approx(sum(terms.values()), abs=1e-5)
    assert set(terms) == {"location", "velocity", "split", "action", "alive", "failure"}
    assert info["is_success"] is False
    assert all(isinstance(value, (np.number, np.ndarray, bool)) for value in info.values())
    assert env.unwrapped.state.x.shape == (1, 120, 2)


def episode(vector: gymnasium.vector.VectorEnv, steps: int) -> list[tuple]:
    """Results of a reset and of some steps."""
    start = vector.reset(seed=0)
    action = np.zeros(vector.action_space.shape, np.float32)
    action[0] = 1.0
    return [start, *(vector.step(action) for _ in range(steps))]


def assert_reset(info: dict, start: dict) -> None:
    """The info of a step in which all elements were reset is that of the reset."""
    assert {"com", "object_com", "finite", "split"} <= set(start)
    assert all(np.array_equal(info[name], start[name]) for name in start)
    assert info["_com"].all() and info["_object_com"].all() and not info["_reward_terms/alive"].any()
    assert not info["reward_terms/alive"].any()  # as in Gymnasium's own: the terms of all steps have the reward's sum


def test_same_step_autoreset() -> None:
    rows = episode(make_vec("kick", autoreset_mode="SameStep", max_episode_steps=3), 4)
    (first, start), last = rows[0], rows[3]
    assert last[3].tolist() == [True, True] and not rows[2][3].any()
    assert np.array_equal(last[0], first)
    assert last[4]["_final_obs"].all() and not np.array_equal(last[4]["final_obs"][0], first[0])
    assert not np.array_equal(last[4]["final_info"]["com"], last[4]["com"])
    assert last[4]["final_info"]["reward_terms/alive"].tolist() == [4.0, 4.0]
    assert "final_obs" not in rows[4][4] and not rows[4][3].any()
    assert_reset(last[4], start)


def test_a_failed_element_starts_anew() -> None:
    """Final infos hold it alone: as in Gymnasium's own, a mean over the others would count them as well."""
    vector = make_vec("grow", 3, autoreset_mode="SameStep")
    vector.reset(seed=0)
    vector.unwrapped.state.v[1] = torch.nan
    still = np.zeros(vector.action_space.shape, np.float32)
    _, rewards, terminated, _, info = vector.step(still)
    assert terminated.tolist() == [False, True, False] and rewards[1] == -16.0
    final = info["final_info"]
    assert final["_reward_terms/alive"].tolist() == final["_finite"].tolist() == [False, True, False]
    assert final["reward_terms/failure"].tolist() == [0.0, -16.0, 0.0] and not final["com"][[0, 2]].any()
    assert not final["finite"].any() and info["finite"].all()
    _, _, terminated, _, info = vector.step(still)
    assert info["finite"].all() and not terminated.any()


def test_next_step_autoreset() -> None:
    vector = make_vec("kick", max_episode_steps=3)
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP  # as Gymnasium's own have it
    rows = episode(vector, 5)
    assert rows[3][3].all() and not np.array_equal(rows[3][0], rows[0][0])
    assert np.array_equal(rows[4][0], rows[0][0]) and not rows[4][1].any() and not rows[4][3].any()
    assert not np.array_equal(rows[5][0], rows[0][0]) and rows[5][1].all()
    assert_reset(rows[4][4], rows[0][1])


def test_the_step_in_which_an_element_is_reset_has_no_reward() -> None:
    def reward_fn(transition: dittogym.Transition, spec: dittogym.TaskSpec) -> dittogym.Reward:
        moved = transition.now.com[:, 1] != transition.start.com[:, 1]
        return dittogym.Reward({"risen": torch.where(moved, torch.inf, 0.0)})

    spec = replace(dittogym.make_spec("run"), reward_fn=reward_fn, weights={"risen": 1.0}, horizon=1)
    envs = dittogym.BatchEnv(spec, 2, **SMALL)
    envs.reset(seed=0)
    action = np.zeros(envs.action_space.shape, np.float32)
    assert [envs.step(action)[1].tolist() for _ in range(2)] == [[np.inf, np.inf], [0.0, 0.0]]


def test_disabled_autoreset_with_a_mask() -> None:
    vector = make_vec(autoreset_mode="Disabled", max_episode_steps=2)
    rows = episode(vector, 2)
    assert rows[2][3].all()
    seen, _ = vector.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(seen[0], rows[0][0][0]) and np.array_equal(seen[1], rows[2][0][1])


def test_a_batch_without_a_time_limit() -> None:
    rows = episode(make_vec("shapematch", max_episode_steps=-1, substeps=1), 31)
    assert not any(row[3].any() for row in rows[1:])


def test_a_window_needs_pygame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "dittogym.render.screen", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'torchmpm\[human\]'"):
        dittogym.Env("run", render_mode="human")


@pytest.mark.parametrize("resample", [False, True])
def test_next_step_autoreset_is_a_reset_of_the_single_environment(resample: bool) -> None:
    options = {"max_episode_steps": 3, "resample": resample}
    vector, single = make_vec("catch", 1, **options), gymnasium.make("dittogym/catch-coarse-v0", **SMALL, **options)
    seen, one = vector.reset(seed=np.array([3]))[0], single.reset(seed=3)[0]
    action = np.full((1, *single.action_space.shape), 0.5, np.float32)
    for t in range(7):
        assert np.array_equal(seen[0], one)
        seen = vector.step(action)[0]
        one = single.reset()[0] if t == 3 else single.step(action[0])[0]
