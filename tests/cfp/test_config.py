"""Options and presets: published values, types, shares of steps, values of stages, environments."""

from dataclasses import replace

import pytest
import torch
from policy_files import save_actor

import dittogym
from cfp.agent.actor import build_actor
from cfp.analytic.window import Episodes
from cfp.config import to_json, update_from_dict
from cfp.envs.make import make_env
from cfp.errors import ConfigError
from cfp.evaluation.returns import evaluation_seed
from cfp.presets import PAPER, analytic_preset, sac_preset
from cfp.registry import configure


def sac(**values):
    return configure({"task": "run", "algo": "cfp-sac", **values})


def test_paper_presets_hold_the_published_numbers():
    published = {  # alpha 1, alpha 2, gate bias, gate penalty, random steps, handover, steps
        "shapematch": (0.01, 0.0, -2, 0.8, 500, 142_000, 400_000),
        "run": (0.01, 0.01, -1, 0.01, 6000, 301_000, 550_000),
        "grow": (0.01, 0.01, -1, 0.01, 6000, 407_000, 600_000),
        "kick": (0.05, 0.05, -1, 0.0, 6000, 132_000, 550_000),
        "dig": (0.05, 0.05, 0, 3.0, 6000, 567_000, 780_000),
        "obstacle": (0.05, 0.05, -1, 0.04, 6000, 530_000, 700_000),
        "catch": (0.1, 0.1, -1, 0.01, 6000, 243_000, 380_000),
        "slot": (0.05, 0.05, -2, 0.1, 6000, 293_000, 600_000),
    }
    assert set(published) == set(PAPER)
    for task, (first, second, bias, penalty, random_steps, handover, steps) in published.items():
        config = sac_preset(task, "paper")
        one, two = (config.hyperparameters(stage) for stage in (1, 2))
        assert (one.alpha, two.alpha, two.gate_penalty) == (first, second, penalty)
        assert (one.random_steps, two.random_steps) == (random_steps, 100)
        assert (one.actor_start, two.actor_start) == (0, 0)
        assert config.ends() == (handover, steps)
        spec = config.actor_spec(2)
        assert sac_preset(task).actor_spec(2).fill_missing and not spec.fill_missing
        assert spec.resolutions == ((32, 64) if task == "shapematch" else (8, 16))
        assert (spec.gate_bias, spec.split, spec.encoder) == ((bias,), task == "dig", "paper")
        assert (spec.gate_scale, spec.interpolation) == (0.25 if task == "dig" else 1.0, "aligned")
        assert (config.num_envs, config.particles) == (1, "full")
        assert config.eval_deterministic == (task == "shapematch")
        assert (config.gamma, config.tau, config.learning_rate, config.batch_size) == (0.99, 0.005, 3e-4, 256)
        assert (config.buffer_size, config.gradient_steps, config.update_start) == (200_000, 1, 256)
        assert config.variant == ("published" if task == "slot" else None)
        assert config.seed == {"catch": 2, "slot": 1}.get(task, 0)


def test_a_task_of_ones_own_is_trained_on_its_own_grids(monkeypatch):
    def hop(variant: str = "soft") -> dittogym.TaskSpec:
        stiffness = {"soft": 100.0, "stiff": 200.0}
        return replace(dittogym.make_spec("run"), name="hop", coarse=4, fine=32, mu=stiffness[variant])

    monkeypatch.setitem(dittogym.TASKS, "hop", hop)
    config = sac_preset("hop")
    config.check()
    assert (config.task, config.resolutions) == ("hop", (4, 32))
    assert replace(config, task="run", resolutions=(4, 8)) == sac_preset("run")
    assert configure({"task": "hop", "variant": "stiff"}).make_spec().mu == 200.0
    with pytest.raises(ConfigError, match="preset must be one of quick, long for hop, got 'paper'"):
        sac_preset("hop", "paper")


def test_json_values_take_the_types_of_their_fields():
    config = update_from_dict(
        sac_preset("shapematch"), {"alpha": [1, 0], "particles": [500, 20], "dt": 1, "resolutions": 8}
    )
    assert (config.alpha, config.particles, config.target, config.resolutions) == ((1, 0), (500, 20), None, (8,))
    assert isinstance(config.dt, float)


def test_shares_follow_the_steps_and_the_last_value_holds_for_all_further_stages():
    half = sac(steps=sac_preset("run").steps // 2)
    assert half.ends() == tuple(end // 2 for end in sac_preset("run").ends())
    assert half.hyperparameters(1).actor_start == sac_preset("run").hyperparameters(1).actor_start // 2
    critics = sac(critics_first=[0.25], steps=8_000)
    assert [critics.hyperparameters(stage).actor_start for stage in (1, 2)] == [1_500, 500]
    grids = [4, 8, 16]
    three = sac(resolutions=grids, handover=[0.25, 0.5], steps=4_000, alpha=[0.1, 0.2], gate_penalty=[1.0, 2.0])
    three.check()
    assert three.ends() == (1_000, 2_000, 4_000)
    assert [three.hyperparameters(stage).alpha for stage in (1, 2, 3)] == [0.1, 0.2, 0.2]
    assert [three.hyperparameters(stage).gate_penalty for stage in (1, 2, 3)] == [0.0, 1.0, 2.0]
    assert three.actor_spec(3).gate_bias == (-3.0, -3.0)
    one = sac(resolutions=[8])
    one.check()
    assert one.ends() == (one.steps,) and one.actor_spec(1).gate_bias == ()


def test_matter_of_the_published_run_of_slot_can_be_chosen():
    def matter(**values):
        spec = make_env(configure({"task": "slot", "particles": 100, **values}), 8, 1).venv.torch_env.spec
        return spec.mu, spec.yield_stress, spec.max_actuation

    assert matter() == (500.0, 85.0, 40.0)
    assert matter(variant="published") == matter(preset="paper") == (650.0, 90.0, 45.0)
    with pytest.raises(ConfigError, match="variant"):
        matter(task="run", variant="published")


def test_evaluations_and_the_final_table_have_layouts_of_their_own():
    config = sac(seed=5, eval_episodes=7)
    assert config.evaluation(1) == config.evaluation(2) == (10_005, 7)
    assert evaluation_seed(config) == 20_005


def test_returns_in_double_precision_are_restored_to_the_last_bit():
    def begin():
        env = dittogym.TorchEnv("run", 2, particles=20, substeps=1, dtype="float64")
        return Episodes(env, 0, max_episode_steps=9, num_layouts=2)

    episodes, restored = begin(), begin()
    never = torch.zeros(2, dtype=torch.bool)
    episodes.end_step(torch.tensor([0.1, 0.2], dtype=torch.float64), never, ~never)
    restored.load_state_dict(episodes.state_dict())
    assert restored.returns.tolist() == [0.1, 0.2]


def test_a_step_keeps_its_duration_with_other_substeps():
    def substeps(**values):
        model = make_env(sac(particles=100, **values), 8, 1).venv.torch_env.model
        return model.solver.dt, model.substeps

    assert substeps() == (1e-4, 100)
    assert substeps(dt=2e-4) == (2e-4, 50)
    assert substeps(dt=2e-4, substeps=10) == (2e-4, 10)
    for wrong in (3e-4, 1e-320, 0.0, 5e-4):
        with pytest.raises(ConfigError, match="dt must"):
            substeps(dt=wrong)
    config = configure({"task": "run", "train_particles": 500, "train_dt": 2e-4})
    trained = config.for_training().environment
    assert trained == replace(config.environment, particles=500, dt=2e-4, substeps=50)


def test_a_policy_with_the_papers_networks_goes_on_with_smaller_batches_and_without_noise_of_cells():
    quick, started = sac_preset("run"), sac(start_from="run")
    assert (quick.encoder, started.encoder) == ("small", "paper")
    assert (quick.resolutions, started.resolutions) == ((4, 8), (8, 16))
    changed = {"encoder": "paper", "resolutions": (8, 16), "gradient_steps": 4, "batch_size": 64, "noise_cells": 0}
    changed |= {"max_episode_steps": None, "n_steps": 1, "weight_average": 0.0, "start_from": "run"}
    changed |= {"buffer_size": quick.buffer_size // 2}
    assert started == replace(quick, **changed)
    asked = sac(start_from="run", noise_cells=2, gradient_steps=8)
    assert asked == replace(started, noise_cells=2, gradient_steps=8)
    complete = to_json(started) | {"start_from": "moved-away"}  # as a run's config.json holds it
    assert configure(complete) == replace(started, start_from="moved-away")
    assert sac(preset="paper", start_from="run") == replace(sac_preset("run", "paper"), start_from="run")


def test_a_policy_of_two_stages_is_refined_by_the_other_learner_with_its_own_gate(tmp_path):
    config = analytic_preset("run")
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(2)), config, 2, 0)
    assert sac(start_from=str(tmp_path), refine=True).actor_spec(2) == config.actor_spec(2)
