"""The Gymnasium faces: registered ids, checkers, vector environments."""

import sys
import warnings
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from tiny import SMALL, begun, make_vec

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


def assert_same_info(ours: dict[str, Any], own: dict[str, Any]) -> None:
    """What no element has at all is left out by Gymnasium; here all of it is marked as missing."""
    assert own.keys() <= ours.keys()
    for name, value in ours.items():
        if name not in own:
            assert not value.any()
        elif name == "final_info":
            assert_same_info(value, own[name])
        elif name == "final_obs":
            assert all(map(np.array_equal, value, own[name]))
        else:
            assert value.dtype == own[name].dtype
            np.testing.assert_allclose(value, own[name], atol=1e-5, err_msg=name)


@pytest.mark.parametrize("resample", [False, True])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_batch_does_what_gymnasiums_own_vector_environment_does(mode: str, resample: bool) -> None:
    """Over limits of episodes, a failure of one element, and the resets after them, of some and of all."""
    options = {"max_episode_steps": 3, "resample": resample}
    singles = [lambda: gymnasium.make("dittogym/catch-coarse-v0", **SMALL, **options)] * 2
    own = gymnasium.vector.SyncVectorEnv(singles, autoreset_mode=mode)
    ours = make_vec("catch", **options, **({} if mode == "NextStep" else {"autoreset_mode": mode}))
    assert ours.metadata["autoreset_mode"] == own.metadata["autoreset_mode"]
    (seen, info), (theirs, others) = (env.reset(seed=3) for env in (ours, own))
    assert np.array_equal(seen, theirs)
    assert_same_info(info, others)
    action, ends = np.full(own.action_space.shape, 0.5, np.float32), []
    for t in range(9):
        if t == 4:
            ours.unwrapped.state.v[1] = own.envs[1].unwrapped.state.v[0] = torch.nan
        result, expected = ours.step(action), own.step(action)
        for one, other in zip(result[:4], expected[:4], strict=True):
            assert one.dtype == other.dtype and one == pytest.approx(other, abs=1e-5)
        assert_same_info(result[4], expected[4])
        ends.append((result[2] | result[3]).tolist())
        if t == 2 or (mode == "Disabled" and any(ends[-1])):
            mask = ends[-1] if mode == "Disabled" else [True, False]
            resets = [env.reset(options={"reset_mask": np.array(mask)})[0] for env in (ours, own)]
            assert np.array_equal(*resets)
    assert {(True, True), (False, True), (True, False)} <= set(map(tuple, ends))


def test_a_batch_without_a_time_limit() -> None:
    vector = begun(make_vec("shapematch", max_episode_steps=-1, substeps=1))
    assert not any(vector.step(vector.action_space.sample())[3].any() for _ in range(31))


def test_the_step_in_which_an_element_is_reset_has_no_reward() -> None:
    def reward_fn(transition: dittogym.Transition, spec: dittogym.TaskSpec) -> dittogym.Reward:
        moved = transition.now.com[:, 1] != transition.start.com[:, 1]
        return dittogym.Reward({"risen": torch.where(moved, torch.inf, 0.0)})

    spec = replace(dittogym.make_spec("run"), reward_fn=reward_fn, weights={"risen": 1.0}, horizon=1)
    envs = begun(dittogym.BatchEnv(spec, 2, **SMALL))
    action = np.zeros(envs.action_space.shape, np.float32)
    assert [envs.step(action)[1].tolist() for _ in range(2)] == [[np.inf, np.inf], [0.0, 0.0]]


def test_a_window_needs_pygame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "dittogym.render.screen", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'torchmpm\[human\]'"):
        dittogym.Env("run", render_mode="human")
