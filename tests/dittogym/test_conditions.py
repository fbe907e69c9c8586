"""Conditions of episodes: what they do to actions, images, matter and starts; resets, snapshots and gradients."""

from __future__ import annotations

import json
import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from tiny import ALL, SMALL, TASKS, actions, assert_same_bits, begun, everything, make_vec, tiny

from dittogym import Conditions, TorchEnv
from dittogym import conditions as drawing
from dittogym.action import bicubic
from torchmpm import tree


def varied(task: str = "run", num_envs: int = 1, **ranges: Any) -> TorchEnv:
    return tiny(task, num_envs, conditions=ranges)


def drawn(count: int = 4000, **ranges: Any) -> dict[str, torch.Tensor]:
    """The conditions of episodes with the seeds from 0 on."""
    like = torch.empty(count, dtype=torch.float64)
    return dict(drawing.draw(Conditions(**ranges), torch.arange(count), (2, 4, 4), like))


# Random numbers.


def test_the_numbers_stay_what_they_are() -> None:
    """Those of SplitMix64 (Steele et al., 2014), begun at a hash of seed, stream and step."""
    found = drawing.uniform(torch.tensor([0, 1, 2**62 - 1]), 3, 1500, 3)
    assert (found * 2**24).long().tolist() == [
        [4567803, 6054492, 7368924],
        [10350660, 12206703, 8968461],
        [8797748, 300362, 5689928],
    ]


# What episodes draw.


def test_values_fill_their_ranges() -> None:
    ranges = {"action_noise": (0.1, 0.3), "mu": (0.5, 1.5), "gravity": (0.0, 2.0), "observation_dropout": (0.2, 0.4)}
    found = drawn(latency=(1, 3), shift=0.02, turn=30.0, velocity=0.4, yield_stress=0.7, **ranges)
    assert found["latency"].bincount(minlength=4).tolist()[0] == 0
    assert all(abs(int(count) - 4000 / 3) < 150 for count in found["latency"].bincount()[1:])
    ranges |= {"shift": (-0.02, 0.02), "velocity": (-0.4, 0.4), "turn": (-math.radians(30), math.radians(30))}
    for name, (low, high) in ranges.items():
        value, width = found[name], high - low
        assert low <= value.min() < low + 0.01 * width and high - 0.01 * width < value.max() <= high
        assert abs(value.mean() - (low + high) / 2) < 5 * width / math.sqrt(12 * value.numel())
    assert (found["yield_stress"] == 0.7).all()  # to the last bit of float64
    both = torch.corrcoef(torch.cat((found["shift"], found["velocity"]), 1).T)
    assert (both - torch.eye(4)).abs().max() < 0.08


def test_the_latest_action_is_the_latest_of_the_range() -> None:
    """The largest random number would round to the next whole number in float32."""
    like, largest = torch.empty(1), lambda seed, stream, step, count: torch.full((1, count), 1 - 2.0**-24)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "uniform", largest)
        found = drawing.draw(Conditions(latency=(1, 2)), torch.tensor([0]), (2, 4, 4), like)
    assert found["latency"].tolist() == [2]


def test_chance_applies_to_each_condition_of_an_episode() -> None:
    found = drawn(latency=2, action_noise=0.1, mu=1.2, turn=10.0, shift=0.1, chance=0.3)
    applies = torch.stack(
        (
            found["latency"] == 2,
            found["action_noise"] == 0.1,
            found["mu"] == 1.2,
            found["turn"] != 0,
            (found["shift"] != 0).all(1),
        )
    )
    assert (applies.double().mean(1) - 0.3).abs().max() < 0.04
    assert (torch.corrcoef(applies.double()) - torch.eye(5)).abs().max() < 0.08
    assert (found["latency"][~applies[0]] == 0).all() and (found["mu"][~applies[2]] == 1).all()


# What conditions do.


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_conditions_that_vary_nothing_change_no_bit(task: str) -> None:
    plain, ours = tiny(task, 2), tiny(task, 2, conditions=Conditions())
    assert_same_bits(plain.reset(seed=0), ours.reset(seed=0))
    for action in actions(plain, 3):
        assert_same_bits(plain.step(action), ours.step(action))
    assert_same_bits(tree.leaves(plain.env_state.particles), tree.leaves(ours.env_state.particles))


@pytest.mark.parametrize("late", [1, 3])
@torch.no_grad()
def test_actions_come_late(late: int) -> None:
    """After so many steps without action, the actions in their order; a reset forgets those that are pending."""
    env, plain = varied(num_envs=2, latency=late), tiny("run", 2)
    given = actions(env, 6)
    expected = torch.cat((torch.zeros_like(given[:late]), given))
    env.reset(seed=0), plain.reset(seed=0)
    for ours, theirs in zip(given, expected, strict=False):
        assert_same_bits(env.step(ours), plain.step(theirs))
    env.reset(options={"reset_mask": [True, False]}), plain.reset(options={"reset_mask": [True, False]})
    for t in range(late):
        theirs = torch.stack((torch.zeros_like(given[0, 0]), expected[6 + t, 1]))
        assert_same_bits(env.step(given[t]), plain.step(theirs))


@torch.no_grad()
def test_elements_are_late_by_steps_of_their_own() -> None:
    env = begun(varied(num_envs=8, latency=(0, 2)))
    late = env.env_state.conditions["latency"]
    assert set(late.tolist()) == {0, 1, 2}
    given = torch.arange(1.0, 6.0, dtype=torch.float64).view(5, 1, 1, 1, 1).expand(5, 8, 2, 4, 4)
    state, ranges = {"latency": late, "seed": late, "pending": torch.zeros(8, 2, 2, 4, 4).double()}, env.conditions
    assert ranges is not None
    for t, action in enumerate(given):
        acted, state = drawing.act(ranges, state, torch.full((8,), t), action)
        assert torch.equal(acted[:, 0, 0, 0], (t + 1.0 - late).clamp_min(0))


def test_missing_entries_of_actions() -> None:
    """Their share, whole cells of the policy's grid, and others in each step and element."""
    ranges = Conditions(action_dropout=0.3, grid=4)
    state = {"seed": torch.arange(50), "action_dropout": torch.full((50,), 0.3)}
    ones = torch.ones(50, 2, 8, 8)
    steps = torch.stack([drawing.act(ranges, state, torch.full((50,), t), ones)[0] for t in range(50)])
    assert set(steps.unique().tolist()) == {0.0, 1.0}
    cells = steps.unflatten(-1, (4, 2)).unflatten(-3, (4, 2))
    assert (cells == cells[..., :1, :, :1]).all()
    kept = cells[..., 0, :, 0]
    assert abs(kept.mean() - 0.7) < 5 * math.sqrt(0.21 / kept.numel())
    for axis in (0, 1):
        same = (kept.diff(dim=axis) == 0).double().mean()
        assert abs(same - (0.3**2 + 0.7**2)) < 0.01


@pytest.mark.parametrize(("share", "left"), [(0.0, 1.0), (1.0, 0.0)])
def test_no_entry_or_every_entry_is_missing(share: float, left: float) -> None:
    state = {"seed": torch.arange(3), "observation_dropout": torch.full((3,), share)}
    assert (drawing.seen(state, torch.arange(3), torch.ones(3, 3, 64, 64)) == left).all()


def test_noise_is_normal() -> None:
    """On the policy's grid, and enlarged as its actions are."""
    ranges, deviations = Conditions(action_noise=(0.0, 1.0), grid=4), torch.linspace(0.0, 1.0, 200)
    state = {"seed": torch.arange(200), "action_noise": deviations}
    noise = torch.stack(
        [drawing.act(ranges, state, torch.full((200,), t), torch.zeros(200, 2, 4, 4))[0] for t in range(50)]
    )
    assert (noise[:, 0] == 0).all()
    unit = (noise / deviations[:, None, None, None])[:, 1:].double()
    for power, moment, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
        assert abs(unit.pow(power).mean() - moment) < 5 * math.sqrt(variance / unit.numel())
    enlarged = drawing.act(ranges, state, torch.zeros(200, dtype=torch.int64), torch.zeros(200, 2, 8, 8))[0]
    assert (enlarged - bicubic(noise[0], 8)).abs().max() < 1e-6


@torch.no_grad()
def test_missing_entries_of_images() -> None:
    """The image without some entries, the same when it is looked at again, in the smooth image too."""
    env, plain = varied("kick", 2, observation_dropout=0.4), tiny("kick", 2)
    images = [env.reset(seed=0)[0]]
    whole = [plain.reset(seed=0)[0]]
    for action in actions(env, 3):
        images.append(env.step(action)[0])
        whole.append(plain.step(action)[0])
    assert torch.equal(env.observation(), images[-1])
    shares = []
    for image, other in zip(images, whole, strict=True):
        assert ((image == other) | (image == 0)).all()
        shares += [(image == 0)[i][other[i] > 0].double().mean() for i in range(2)]
    assert all(0.3 < share < 0.5 for share in shares)
    env.env_state = env.env_state
    assert torch.equal(env.observation(), images[-1])
    image, smooth = env.observation(), env.soft_observation()
    assert (smooth[image == 0] == 0).double().mean() > 0.9
    missing = (smooth == 0) & (plain.soft_observation() != 0)
    assert missing.any() and (image[missing] == 0).all()
    assert torch.equal(env.step(torch.zeros(2, 2, 8, 8), soft=True)[0], env.soft_observation())


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_factors_multiply_the_constants_of_the_matter(task: str) -> None:
    """As the option of a reset sets them, on top of those that it sets, and of those elements alone that are reset."""
    ranges = {"mu": (0.8, 1.2), "yield_stress": 0.5, "gravity": (0.9, 1.1)}
    env, plain = varied(task, 2, **ranges), tiny(task, 2)
    assert env.conditions is not None
    names = env.conditions.changes(env.spec)
    assert ("gravity" in names) == (task != "shapematch") and "mu" in names

    def expected(given: dict[str, Any]) -> dict[str, torch.Tensor]:
        state = env.env_state
        own = {name: torch.tensor(getattr(env.spec, name)).double() for name in names} | given
        factors = {name: state.conditions[name] for name in names}
        return {name: own[name] * (factors[name][:, None] if name == "gravity" else factors[name]) for name in names}

    env.reset(seed=0)
    plain.reset(seed=0, options={"physics": expected({})})
    assert_same_bits(everything(plain), everything(env)[: len(everything(plain))])  # conditions come last
    for action in actions(env, 2):
        assert_same_bits(env.step(action), plain.step(action))
    before = dict(env.env_state.physics)
    env.reset(options={"reset_mask": [False, True], "physics": {"yield_stress": 40.0, "max_actuation": 20.0}})
    after = env.env_state.physics
    assert all(after[name][0].equal(before[name][0]) for name in names)
    assert after["yield_stress"].tolist()[1] == 20.0 and after["max_actuation"].tolist()[1] == 20.0
    env.reset()  # the factor does not pile up
    assert env.env_state.physics["yield_stress"].tolist()[1] == 20.0


@pytest.mark.parametrize("task", TASKS)
@torch.no_grad()
def test_starts_are_moved_rigidly(task: str) -> None:
    env, plain = begun(varied(task, 6, shift=0.01, turn=5.0, velocity=0.3)), begun(tiny(task, 6))
    robot, found = env.model.num_robot_particles, env.env_state.conditions
    moved, start = env.state.x[:, :robot], plain.state.x[:, :robot]
    offset, place = (x - x.mean(1, keepdim=True) for x in (moved, start))
    cos, sin = found["turn"].cos(), found["turn"].sin()
    turned = torch.stack((torch.stack((cos, -sin), 1), torch.stack((sin, cos), 1)), 1)
    assert (offset - torch.einsum("bij,bnj->bni", turned, place)).abs().max() < 1e-12
    shift = moved.mean(1) - start.mean(1)
    assert (shift[:, 0] - found["shift"][:, 0]).abs().max() < 1e-12
    assert (shift[:, 1] >= found["shift"][:, 1] - 1e-12).all()
    lowest = moved[..., 1].amin(1) - start[..., 1].amin(1)
    lifted = (shift[:, 1] - found["shift"][:, 1]) > 1e-12
    assert (lowest > -1e-12).all() and (lowest[lifted].abs() < 1e-12).all() and lifted.any()
    assert torch.equal(env.state.x[:, robot:], plain.state.x[:, robot:])
    assert (env.state.v[:, :robot] == found["velocity"][:, None]).all() and (env.state.v[:, robot:] == 0).all()
    assert (env.env_state.start.com - moved.mean(1)).abs().max() < 1e-12  # what rewards measure from


@torch.no_grad()
def test_starts_that_are_not_moved_keep_every_bit() -> None:
    env, plain = begun(varied(num_envs=16, shift=0.01, turn=5.0, velocity=0.3, chance=0.3)), begun(tiny("run", 16))
    found = env.env_state.conditions
    rests = (found["shift"] == 0).all(1) & (found["turn"] == 0)
    assert rests.any() and torch.equal((env.state.x == plain.state.x).all(2).all(1), rests)


# Resets, states and snapshots.


def conditions_of(env: TorchEnv) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in env.env_state.conditions.items()}


@torch.no_grad()
def test_resets_draw_anew_or_repeat() -> None:
    env = tiny("kick", 3, conditions=ALL)
    first = env.reset(seed=3)[0]
    history = [conditions_of(env)]
    for _ in range(3):
        env.reset()
        history.append(conditions_of(env))
    seeds = torch.cat([each["seed"] for each in history])
    assert len(seeds.unique()) == 12 and (seeds >= 0).all()
    env.reset(seed=[None, 4, None], options={"reset_mask": [True, True, False]})
    mixed = conditions_of(env)
    assert mixed["seed"][1] == history[0]["seed"][1] and mixed["mu"][1] == history[0]["mu"][1]
    assert mixed["seed"][0] not in seeds and mixed["seed"][2] == history[-1]["seed"][2]
    assert torch.equal(env.reset(seed=3)[0], first)
    assert_same_bits(conditions_of(env), history[0])
    env.reset()
    assert_same_bits(conditions_of(env), history[1])  # what follows is repeated too


def test_environments_that_are_never_seeded_differ() -> None:
    first, second = (tiny("run", 2, conditions=ALL) for _ in range(2))
    first.reset(), second.reset()
    seeds = torch.cat((first.env_state.conditions["seed"], second.env_state.conditions["seed"]))
    assert len(seeds.unique()) == 4


@torch.no_grad()
def test_states_of_environments_with_and_without_conditions() -> None:
    """Without, conditions are left behind; with, they are needed, and must be of the same kind."""
    ours, plain = begun(tiny("run", 2, conditions=ALL)), begun(tiny("run", 2))
    moment, bare = ours.save(), plain.save()
    plain.env_state = ours.env_state
    assert plain.env_state.conditions == {} and torch.equal(plain.state.x, ours.state.x)
    plain.load(moment, [True, False])
    plain.load(moment)
    assert_same_bits(dict(plain.env_state.physics), dict(ours.env_state.physics))
    with pytest.raises(ValueError, match="env_state must be of an environment with such conditions"):
        ours.env_state = plain.env_state
    for mask in (None, [True, False]):
        with pytest.raises(ValueError, match="snapshot must be of an environment with such conditions"):
            ours.load(bare, mask)
    finer = begun(tiny("run", 2, resolution=16, conditions=ALL))
    with pytest.raises(ValueError, match="with such conditions and actions"):
        finer.load(moment)


# Gradients.


def returns(env: TorchEnv, drive: torch.Tensor, soft: bool) -> torch.Tensor:
    """Sum of the rewards of an episode that begins with seed 2."""
    env.reset(seed=2)
    return sum((env.step(action, soft=soft)[1] for action in drive), drive.new_zeros(env.num_envs)).sum()


@pytest.mark.parametrize("task", ["run", "shapematch"])
def test_gradients_pass_through_disturbed_actions(task: str) -> None:
    """Late, with noise, and some missing: against differences; none for what is missing or comes too late."""
    conditions = Conditions(latency=1, action_noise=0.1, action_dropout=0.4, velocity=0.3, turn=4.0)
    env = tiny(task, 2, conditions=conditions, resolution=4)
    drive = (0.3 * actions(env, 3)).requires_grad_()
    returns(env, drive, True).backward()
    gradient = drive.grad
    assert gradient is not None and (gradient[-1] == 0).all()
    missing = (gradient[:-1] == 0).double().mean()
    assert 0.2 < missing < 0.6
    direction, size = actions(env, 3, seed=1), 1e-5
    with torch.no_grad():
        ends = [returns(env, drive + sign * size * direction, True) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * size)
    assert abs((gradient * direction).sum() - expected) < 1e-5 * abs(expected)


def test_gradients_of_positions_and_constants_pass_through_a_reset() -> None:
    env = begun(tiny("run", 2, conditions={"turn": 5.0, "mu": (0.8, 1.2), "shift": 0.01}))
    x, mu = env.state.x.clone().requires_grad_(), torch.tensor([300.0, 500.0], dtype=torch.float64, requires_grad=True)
    env.reset(seed=0, options={"positions": x, "physics": {"mu": mu}})
    env.step(actions(env, 1)[0])
    (env.state.x.square().sum() + env.env_state.physics["mu"].sum()).backward()
    assert x.grad is not None and mu.grad is not None
    assert (x.grad != 0).any() and (mu.grad - env.env_state.conditions["mu"]).abs().max() < 1.0


def test_detached_states_hold_no_graph() -> None:
    env = begun(varied(num_envs=2, latency=2))
    env.step(actions(env, 1)[0].requires_grad_(), soft=True)
    assert env.env_state.conditions["pending"].requires_grad
    env.detach()
    assert not any(leaf.requires_grad for leaf in everything(env))


# Behind Gymnasium.


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_through_gymnasium() -> None:
    """Its checks, both environments, and the option from JSON, whether an object or a mapping was given."""
    name = "dittogym/shapematch-coarse-v0"
    ranges = {"latency": (0, 2), "mu": (0.8, 1.2), "observation_dropout": 0.2, "velocity": np.float64(0.1)}
    made = [gymnasium.make(name, conditions=given, **SMALL) for given in (Conditions(**ranges), ranges)]
    for env in made:
        check_env(env.unwrapped, skip_render_check=True)
        again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
        assert again.unwrapped.torch_env.conditions == Conditions(**ranges)
        json.dumps(env.spec.kwargs)
    vector = make_vec("shapematch", conditions=ranges)
    images = vector.reset(seed=7)[0]
    for i in range(2):
        assert np.array_equal(made[0].reset(seed=7 + i)[0], images[i])
