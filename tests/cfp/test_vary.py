"""Trainings whose episodes differ in their conditions, ``--vary``."""

import json
import signal
from dataclasses import replace

import pytest
import torch
from tiny_runs import ONE_STAGE, assert_same_run, resume, run
from watching import at_step, interrupt

import cfp
from cfp.analytic.window import Episodes
from cfp.config import EVALUATION_SEED
from cfp.envs.make import make_torch_env
from cfp.evaluation.returns import evaluate, make_trial
from cfp.registry import configure
from cfp.tables import read_table
from dittogym import TASKS, Conditions, TorchEnv

ONE = {"sac": ONE_STAGE, "analytic": "--resolutions 4 --handover --action-step 0.1 --eval-every 0".split()}
LEFT = ("progress.csv", "results.json", "policy.safetensors")


@pytest.mark.parametrize("learner", ["sac", "analytic"])
@pytest.mark.usefixtures("short")
def test_a_varied_training_goes_on_as_if_nothing_had_happened(learner, tmp_path):
    """With actions that are pending; and it is another training than one without."""
    options = [*ONE[learner], "--steps", "48"]
    varied = [*options, "--vary", "0.9"]
    assert run(tmp_path / "whole", *varied, learner=learner) == 0
    with at_step(24, interrupt):
        assert run(tmp_path / "stopped", *varied, learner=learner) == 128 + signal.SIGINT
    assert resume(tmp_path / "stopped") == 0
    assert_same_run(tmp_path / "stopped", tmp_path / "whole", LEFT)
    assert run(tmp_path / "other", *options, learner=learner) == 0
    policies = [(tmp_path / name / "policy.safetensors").read_bytes() for name in ("whole", "other")]
    assert policies[0] != policies[1]


def test_conditions_of_a_run():
    """Off by default; each range from its option; noise and missing entries on the grid of the stage."""
    config = cfp.preset("run", "quick", "cfp-analytic")
    assert config.vary == 0 and config.conditions(1) is None
    config = replace(config, resolutions=(4, 8), vary=0.5, vary_latency=3, vary_physics=0.1, vary_start=2.0)
    shares = dict.fromkeys(("action_noise", "action_dropout", "observation_dropout"), (0.0, 0.2))
    factors = dict.fromkeys(("mu", "yield_stress", "gravity"), (0.9, 1.1))
    start = {"shift": 0.02, "turn": 10.0, "velocity": 0.1}
    assert config.conditions(1) == Conditions(latency=(1, 3), **shares, **factors, **start, chance=0.5, grid=4)
    assert config.conditions(2) == replace(config.conditions(1), grid=8)
    assert replace(config, vary_latency=0).conditions(1).latency == (0, 0)


@pytest.mark.parametrize("learner", ["sac", "analytic"])
@pytest.mark.usefixtures("short")
def test_policies_are_chosen_under_the_conditions_of_their_training(learner, tmp_path):
    options = [*ONE[learner], "--steps", "24", "--vary", "1"]
    assert run(tmp_path, *options, "--eval-every", "24", "--eval-episodes", "2", learner=learner) == 0
    config, policy = configure(json.loads((tmp_path / "config.json").read_text())), cfp.load(tmp_path)

    def returns(seed, conditions):
        own = {"deterministic": config.eval_deterministic, "seed": seed, "conditions": conditions}
        return evaluate([make_trial(config, "", policy, 2, **own)], config.make_spec().horizon)[0]

    chosen, (seed, _) = read_table(tmp_path / "evaluations.csv"), config.evaluation(1)
    varied, plain = (returns(seed, conditions) for conditions in (config.conditions(1), None))
    assert [float(row["mean"]) for row in chosen] == pytest.approx([varied.mean], rel=1e-6) != [plain.mean]


@pytest.mark.parametrize("task", tuple(TASKS))
@pytest.mark.parametrize("algo", ["cfp-analytic", "cfp-sac"])
def test_every_task_has_room_for_the_default_ranges(task, algo):
    config = replace(cfp.preset(task, "quick", algo), vary=0.5, device="cpu")
    config = config.for_training() if algo == "cfp-analytic" else config
    env = make_torch_env(config, config.action_size(1), conditions=config.conditions(1))
    assert env.conditions == config.conditions(1)


def test_learning_by_gradients_draws_conditions_for_each_episode():
    """Although the layouts of episodes without conditions come again."""

    def seeds(conditions):
        env, found = TorchEnv("run", 2, particles=100, substeps=1, conditions=conditions), []
        reset = env.reset
        env.reset = lambda **options: found.extend(options["seed"]) or reset(**options)
        episodes = Episodes(env, 0, 1, num_layouts=1)
        for _ in range(3):
            _, reward, terminated, _, info = env.step(torch.zeros(2, 2, 8, 8))
            episodes.end_step(reward, terminated, info["finite"])
        return found

    assert set(seeds(None)) == {2}
    varied = seeds({"velocity": 0.1})
    assert len(set(varied)) == len(varied) == 8 and max(varied) < EVALUATION_SEED
