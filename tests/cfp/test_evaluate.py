"""Evaluations: the same digits however episodes are spread over threads, and what may be chosen for them."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fakes import FakeEnv

import cfp
import dittogym
from cfp import messages
from cfp.errors import NonFiniteError
from cfp.evaluate import Command
from cfp.evaluation.page import headline
from cfp.evaluation.returns import Played, Result, Trial, UntrainedPolicy, evaluate, explain, make_trial
from cfp.presets import preset
from dittogym import Conditions


class LinearPolicy:
    """Actions are a linear function of the pixels, with noise; torch sums them in parts, one for each thread."""

    resolution, description = 8, {}

    def __init__(self):
        self.weights = torch.randn(3 * 64 * 64, 2 * 8 * 8, generator=torch.Generator().manual_seed(0))

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        pixels = torch.as_tensor(observation).flatten(1).float() / 255
        noise = 0.0 if deterministic else torch.randn(len(pixels), 2 * 8 * 8)
        return (pixels @ self.weights + noise).tanh().view(-1, 2, 8, 8).numpy(), state


class Counting:
    """Counts the steps in which it acts, and fails after some of them if asked to."""

    def __init__(self, fails_after=None):
        self.steps, self.fails_after = 0, fails_after

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.steps += len(observation)
        if self.steps == self.fails_after:
            raise RuntimeError("it has had enough")
        return np.zeros((len(observation), 2, 8, 8), np.float32), state


def fake_trial(policy, episodes, together=False, **options):
    def make_env(count):
        return Layouts(count, **{"horizon": 4} | options)

    return Trial("", 8, policy, make_env, episodes, deterministic=False, seed=0, together=together)


class Layouts(FakeEnv):
    """The height is a tenth of the seed."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=None if seed is None else 10 * seed, options=options)


@pytest.mark.parametrize(
    ("threads", "conditions"),
    [(2, None), (3, Conditions(shift=0.01, turn=5.0, velocity=0.05, action_noise=0.2, observation_dropout=0.2))],
)
def test_evaluation_does_not_depend_on_threads_and_on_what_else_is_evaluated(short, threads, conditions):
    config = replace(preset("shapematch"), device="cpu", particles=200, substeps=2)
    options = {"deterministic": False, "seed": 5, "conditions": conditions}
    trial = make_trial(config, "", LinearPolicy(), 4, **options)
    state = torch.get_rng_state()
    alone = evaluate([trial], 8)[0]
    torch.set_num_threads(threads)
    _, together = evaluate([make_trial(config, "", UntrainedPolicy("random", 8), 3, **options), trial], 8)
    assert torch.get_num_threads() == threads
    assert together == alone and len(set(alone.returns)) == 4
    first, third = (make_trial(config, "", LinearPolicy(), 1, **options | {"seed": seed}) for seed in (5, 7))
    assert [result.episodes[0] for result in evaluate([first, third], 8)] == [alone.episodes[0], alone.episodes[2]]
    assert torch.equal(torch.get_rng_state(), state)


def test_trials_on_a_gpu_are_played_one_at_a_time(monkeypatch):
    """Also those of one episode: an environment that records a CUDA graph bears no random numbers of another thread."""
    used = set()

    class Recorder(Counting):
        def predict(self, *arguments, **options):
            used.add(threading.get_ident())
            time.sleep(0.01)
            return super().predict(*arguments, **options)

    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    evaluate([fake_trial(Recorder(), 1, together=True) for _ in range(3)], 4)
    assert len(used) == 1
    evaluate([fake_trial(Recorder(), 1) for _ in range(3)], 4)
    assert len(used) > 2


def test_noise_differs_between_layouts_and_steps():
    drawn = []

    class Recorder(Counting):
        def predict(self, *arguments, **options):
            drawn.append(torch.randn(3))
            return super().predict(*arguments, **options)

    evaluate([fake_trial(Recorder(), 3)], 4)
    assert len(drawn) == 12 and len(torch.stack(drawn).unique(dim=0)) == 12


@pytest.mark.parametrize("together", [False, True])
def test_returns_are_in_the_order_of_layouts(together):
    # The later three are too high and end at once, which costs no steps where each has an environment of its own.
    policy = Counting()
    result = evaluate([fake_trial(policy, 6, together, end_above=0.25)], 4)[0]
    assert result.returns == pytest.approx([2.0, 2.4, 2.8, 0.8, 0.9, 1.0])
    # The highest one succeeds; like the one below it, it has been torn.
    assert result.success == pytest.approx(1 / 6) and result.success_whole == 0.0
    assert result.torn == pytest.approx(2 / 6)
    assert result.piece == pytest.approx((3 * 1.0 + 3 * 0.8) / 6)
    assert result.mean_piece == pytest.approx((3 * 0.9 + 3 * 0.8) / 6)
    if not together:
        assert policy.steps == 3 * 4 + 3


@pytest.mark.parametrize("seconds", [0.0, 100.0])
def test_progress_of_a_long_evaluation_is_shown_where_there_is_no_terminal(seconds, monkeypatch, capsys):
    monkeypatch.setattr(messages, "SELDOM", seconds)
    evaluate([fake_trial(Counting(), 2)], 4)
    shown = capsys.readouterr().err
    assert "evaluation: 100%" in shown and "8/8" in shown if not seconds else shown == ""


def test_an_episode_that_fails_ends_the_others():
    before, policies = threading.active_count(), (Counting(), Counting(fails_after=3))
    torch.set_num_threads(2)
    trials = [fake_trial(policy, 1, horizon=10**6 if k == 0 else 10) for k, policy in enumerate(policies)]
    with pytest.raises(RuntimeError, match="had enough"):
        evaluate(trials, 10**6)
    assert torch.get_num_threads() == 2
    assert threading.active_count() == before and policies[0].steps < 10**6


def test_a_reward_that_is_not_finite_ends_an_evaluation():
    with pytest.raises(NonFiniteError, match="the reward function of the task returned NaN"):
        evaluate([fake_trial(Counting(), 2, faults={3: "reward"})], 4)


def test_the_seed_chooses_the_episodes():
    assert [Command(policy="run", seed=seed).open()[0].seed for seed in (7, None)] == [7, 0]


def test_the_table_claims_other_starts_only_where_starts_differ():
    claims = {task: "from starts" in explain(preset(task), [], True) for task in ("run", "grow", "obstacle")}
    assert claims == {"run": True, "grow": False, "obstacle": False}


def test_the_headline_of_a_task_with_small_returns_tells_them_apart():
    results = [
        Result(name, 8, (Played(total, None, False, 1.0, 1.0),))
        for name, total in (("zero action", -0.04), ("stage 1", 2.87))
    ]
    assert headline(preset("run"), results).endswith("return 2.9 (zero action 0.0)")


def test_any_policy_is_evaluated_as_those_of_the_package():
    class Waves:
        """Has memory, and noise from torch's generator."""

        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            count = 0 if state is None else state
            noise = 0 if deterministic else torch.rand(len(observation), 2, 4, 4).numpy()
            return np.full((len(observation), 2, 4, 4), np.sin(count), np.float32) + 0.1 * noise, count + 1

    options = {"particles": 100, "substeps": 1, "resolution": 4}
    result = cfp.evaluate_policy(Waves(), "shapematch", 3, seed=5, **options)
    assert len(result.returns) == 3 and result.success == 0 and result.interval > 0
    assert (
        cfp.evaluate_policy(Waves(), dittogym.make_spec("shapematch"), 1, seed=7, **options).mean == result.returns[2]
    )
    deterministic = cfp.evaluate_policy(Waves(), "shapematch", 3, seed=5, deterministic=True, **options)
    late = cfp.evaluate_policy(Waves(), "shapematch", 3, seed=5, conditions=Conditions(latency=2), **options)
    assert len({result.returns, deterministic.returns, late.returns}) == 3
    column = np.zeros((1, 2, 4, 4))
    column[..., 3] = 1
    acting = {"predict": lambda *_, **__: (column, None)}
    image, grid, trained = (
        cfp.evaluate_policy(SimpleNamespace(**acting, **about), "shapematch", 1, **options, **layout).mean
        for about, layout in (
            ({}, {}),
            ({}, {"action_layout": "grid"}),
            ({"description": {"environment": {"action_layout": "grid"}}}, {}),
        )
    )
    assert image != grid == trained
    function = cfp.evaluate_policy(lambda images: torch.from_numpy(column), "shapematch", 1, **options)
    assert function.mean == image
    with pytest.raises(TypeError, match="policy must be a function or have a method predict, got int"):
        cfp.evaluate_policy(3, "shapematch", 1, **options)
    policy = cfp.load("shapematch")
    assert cfp.evaluate_policy(policy, "shapematch", 1, particles=100, substeps=1).resolution == policy.resolution
