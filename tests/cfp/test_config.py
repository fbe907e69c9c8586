import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import dittogym
from cfp.analytic.episodes import Episodes
from cfp.config import to_json
from cfp.envs.make import make_env
from cfp.errors import ConfigError
from cfp.evaluation.returns import evaluation_seed
from cfp.experiment.checkpoint import check_same
from cfp.experiment.training import parse
from cfp.from_dict import update_from_dict
from cfp.presets import TASKS, from_json, sac_preset
from cfp.sections import EnvironmentConfig
from cfp.train import PROGRAM
from dittogym import make_spec


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ["quick", "long", "paper"])
def test_every_preset_is_valid_and_survives_json(task, name):
    config = sac_preset(task, name)
    config.check()
    assert from_json(json.loads(json.dumps(to_json(config)))) == config
    stages = range(1, len(config.resolutions) + 1)
    assert sum(config.stage_steps(stage) for stage in stages) == config.steps
    assert [config.actor_spec(stage).resolutions[-1] for stage in stages] == list(config.resolutions)


def test_a_task_of_ones_own_is_trained_on_its_own_grids(monkeypatch):
    spec = replace(make_spec("run"), name="hop", coarse=4, fine=32)
    monkeypatch.setitem(dittogym.TASKS, "hop", lambda: spec)
    config = sac_preset("hop")
    config.check()
    assert (config.task, config.resolutions) == ("hop", (4, 32))
    assert replace(config, task="run", resolutions=(4, 8)) == sac_preset("run")
    with pytest.raises(ConfigError, match="preset must be one of quick, long for hop, got 'paper'"):
        sac_preset("hop", "paper")


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
    assert set(published) == set(TASKS)
    for task, (first, second, bias, penalty, random_steps, handover, steps) in published.items():
        config = sac_preset(task, "paper")
        assert config.alpha == (first, second)
        assert (config.gate_bias, config.gate_penalty) == ((bias,), (penalty,))
        assert config.random_steps == (random_steps, 100)
        assert (config.handover, config.steps) == ((handover,), steps)
        assert config.resolutions == ((32, 64) if task == "shapematch" else (8, 16))
        assert config.network.split == (task == "dig")
        assert config.network.gate_scale == (0.25 if task == "dig" else 1.0)
        assert config.environment.num_envs == 1
        assert config.report.eval_deterministic == (task == "shapematch")
        learning = config.learning
        assert (learning.gamma, learning.tau, learning.learning_rate, learning.batch_size) == (0.99, 0.005, 3e-4, 256)
        assert (learning.buffer_size, learning.gradient_steps, learning.update_start) == (200_000, 1, 256)
        assert config.environment.variant == ("published" if task == "slot" else None)
    assert {task: TASKS[task].seed for task in TASKS if TASKS[task].seed} == {"catch": 2, "slot": 1}


def test_json_values_take_the_types_of_their_fields():
    config = update_from_dict(
        sac_preset("shapematch"), {"alpha": [1, 0], "environment": {"particles": [500, 20], "target": None}}
    )
    assert config.alpha == (1.0, 0.0)
    assert all(isinstance(value, float) for value in config.alpha)
    assert config.environment.particles == (500, 20)


def test_command_line_beats_file_beats_preset(tmp_path):
    file = tmp_path / "options.json"
    file.write_text(json.dumps({"task": "run", "learning": {"gamma": 0.5, "tau": 0.25}, "report": {"video": True}}))
    command = parse(
        PROGRAM,
        [
            "--config",
            str(file),
            "--learner",
            "sac",
            "--gamma",
            "0.75",
            "--no-video",
            "--particles",
            "300",
            "--out",
            "x",
        ],
    )
    assert command.run.task == "run"
    assert (command.run.learning.gamma, command.run.learning.tau) == (0.75, 0.25)
    assert command.run.report.video is False
    assert command.run.environment.particles == 300
    assert command.run.learning.batch_size == sac_preset("run").learning.batch_size
    assert parse(PROGRAM, ["--video"]).run.report.video is True
    assert parse(PROGRAM, ["--particles", "full"]).run.environment.particles == "full"
    assert parse(PROGRAM, ["--particles", "500", "20"]).run.environment.particles == (500, 20)


def test_fewer_steps_shorten_every_stage(tmp_path):
    config = sac_preset("run")
    half = parse(PROGRAM, ["--learner", "sac", "--task", "run", "--steps", str(config.steps // 2)]).run
    assert half.handover == (config.handover[0] // 2,)
    assert half.learning.actor_start == config.learning.actor_start // 2
    explicit = parse(PROGRAM, ["--learner", "sac", "--task", "run", "--steps", "1000", "--handover", "900"]).run
    assert explicit.handover == (900,)
    explicit = parse(PROGRAM, "--learner sac --task run --steps 1000 --actor-start 4000".split()).run
    assert explicit.learning.actor_start == 4000
    options = {"learner": "sac", "task": "run", "steps": 1000, "learning": {"actor_start": 4000}}
    (tmp_path / "options.json").write_text(json.dumps(options))
    assert parse(PROGRAM, ["--config", str(tmp_path / "options.json")]).run == explicit
    longer = parse(PROGRAM, "--learner sac --task run --steps 100000".split()).run
    assert longer.learning == config.learning


def test_critics_of_later_stages_learn_first():
    config = replace(sac_preset("run"), critics_first=0.25)
    starts = [config.hyperparameters(stage).actor_start for stage in (1, 2)]
    assert starts == [config.learning.actor_start, max(config.learning.actor_start, config.stage_steps(2) // 4)]
    assert sac_preset("run", "paper").hyperparameters(2).actor_start == 0
    with pytest.raises(ConfigError, match="critics_first must be at least 0 and less than 1, got 1"):
        replace(config, critics_first=1.0).check()


def test_another_number_of_stages_stretches_what_each_has_one_of():
    five = parse(PROGRAM, "--learner sac --resolutions 4 8 16 32 64 --steps 5000".split()).run
    assert five.handover == (1000, 2000, 3000, 4000)
    assert five.alpha == (0.005,) * 5
    assert five.gate_bias == (-3.0,) * 4 and five.gate_penalty == (0.8,) * 4
    assert five.random_steps == (480, 100, 100, 100, 100)
    three = parse(PROGRAM, "--learner sac --resolutions 4 8 16 --alpha 1 2 3 --handover 100 200".split()).run
    assert (three.alpha, three.handover) == ((1.0, 2.0, 3.0), (100, 200))
    one = parse(PROGRAM, "--learner sac --resolutions 16".split()).run
    assert (one.handover, one.gate_bias, one.alpha) == ((), (), (0.005,))
    with pytest.raises(ConfigError, match="alpha must have 3 values"):
        parse(PROGRAM, "--learner sac --resolutions 4 8 16 --alpha 1 2 3 4".split())


def test_matter_of_the_published_run_of_slot_can_be_chosen():
    def matter(*arguments):
        config = parse(PROGRAM, ["--particles", "100", *arguments]).run
        spec = make_env(config, 8, 1).venv.torch_env.spec
        return spec.mu, spec.yield_stress, spec.max_actuation

    assert matter("--task", "slot") == (500.0, 85.0, 40.0)
    assert matter("--task", "slot", "--variant", "published") == (650.0, 90.0, 45.0)
    assert matter("--task", "slot", "--preset", "paper") == (650.0, 90.0, 45.0)
    with pytest.raises(ConfigError, match="unexpected keyword argument 'variant'"):
        matter("--task", "run", "--variant", "published")


def test_runs_of_both_learners_have_folders_of_their_own():
    assert parse(PROGRAM, ["--task", "run"]).out == Path("runs/analytic-run-quick-0")
    assert parse(PROGRAM, ["--task", "run", "--learner", "sac"]).out == Path("runs/cfp-run-quick-0")


def test_layouts_of_training_evaluations_and_the_final_table_are_disjoint():
    trained = []

    class Recording(dittogym.TorchEnv):
        def reset(self, *, seed=None, options=None):
            trained.extend(seed if isinstance(seed, list) else [])
            return super().reset(seed=seed, options=options)

    env = Recording("run", 3, particles=20, substeps=1)
    done = torch.ones(3, dtype=torch.bool)
    episodes = Episodes(env, 5, max_episode_steps=2, num_layouts=4)
    for _ in range(3):
        episodes.restart(done, done, done)
    assert len(set(trained)) == 4 and min(trained) >= 5 and max(trained) < 5 + 8

    config = parse(PROGRAM, "--task run --seed 5 --eval-episodes 7".split()).run
    assert config.evaluation(1) == config.evaluation(2) == (10_005, 7)
    assert evaluation_seed(config) == 20_005


def test_variants_of_custom_tasks_have_their_own_names(monkeypatch):
    def wide(variant: str = "soft") -> dittogym.TaskSpec:
        stiffness = {"soft": 100.0, "stiff": 200.0}
        return replace(dittogym.make_spec("run"), name="wide", mu=stiffness[variant])

    monkeypatch.setattr("dittogym.tasks.TASKS", {**dittogym.TASKS, "wide": wide})
    run = parse(PROGRAM, ["--task", "wide", "--variant", "stiff"]).run
    assert run.make_spec().mu == 200.0


def test_a_step_keeps_its_duration_with_other_substeps():
    def substeps(*arguments):
        config = parse(PROGRAM, ["--task", "run", "--particles", "100", *arguments]).run
        model = make_env(config, 8, 1).venv.torch_env.model
        return model.solver.dt, model.substeps

    assert substeps() == (1e-4, 100)
    assert substeps("--dt", "2e-4") == (2e-4, 50)
    assert substeps("--dt", "2e-4", "--substeps", "10") == (2e-4, 10)
    for wrong, message in (
        ("3e-4", "dt must divide"),
        ("1e-320", "dt must divide"),
        ("0", "dt must be positive"),
        ("5e-4", "dt must be at most"),
    ):
        with pytest.raises(ConfigError, match=message):
            substeps("--dt", wrong)


def test_gradient_methods_simulate_with_longer_substeps_where_that_was_measured():
    own = EnvironmentConfig()
    assert own.for_optimisation("run", 500) == replace(own.with_particles(500), dt=2e-4, substeps=50)
    for task in ("shapematch", "dig", "custom:task"):
        assert own.for_optimisation(task) == own
    for given in (replace(own, substeps=100), replace(own, dt=5e-5)):
        assert given.for_optimisation("run") == given
    assert own.for_optimisation("dig", dt=1.25e-4) == replace(own, dt=1.25e-4, substeps=80)
    assert replace(own, substeps=20).for_optimisation("run", dt=2e-4) == replace(own, dt=2e-4, substeps=10)
    with pytest.raises(ConfigError, match=r"train_dt must divide an environment step of 0\.01 s, got 0\.0003"):
        own.for_optimisation("run", dt=3e-4)


def test_layout_of_actions_can_be_chosen():
    def field(*arguments):
        config = parse(PROGRAM, ["--task", "run", "--particles", "100", "--substeps", "1", *arguments]).run
        env = make_env(config, 2, 1)
        env.reset()
        env.step(np.array([[[[0.0, 1.0], [0.0, 0.0]]] * 2], np.float32))  # row 0, column 1
        pull = env.venv.torch_env._actuation[0, 0]
        return (pull > 0.9 * pull.max()).nonzero().float().mean(0).tolist()  # to the right, upwards

    image, grid, reference = field(), field("--action-layout", "grid"), field("--parity", "reference")
    assert image[0] > grid[0] and image[1] == grid[1]  # both above the middle, one right of it and one left
    assert grid == reference
    assert image == field("--parity", "reference", "--action-layout", "image")


def test_resumed_run_may_change_only_what_does_not_alter_it():
    config = sac_preset("run")
    stored = json.loads(json.dumps(to_json(config)))
    check_same(stored, replace(config, steps=99_000, device="cpu", report=replace(config.report, eval_every=7)))
    check_same(stored, replace(config, environment=replace(config.environment, backend="eager")))
    with pytest.raises(ConfigError, match=r"gamma: the run was started with 0\.9.*, got 0\.5"):
        check_same(stored, replace(config, learning=replace(config.learning, gamma=0.5)))
    with pytest.raises(ConfigError, match="eval_episodes: the run was started with 5, got 9"):
        check_same(stored, replace(config, report=replace(config.report, eval_episodes=9)))
    with pytest.raises(ConfigError, match="task: the run was started with 'run', got 'shapematch'"):
        check_same(stored, replace(config, task="shapematch"))
