"""``--dry-run`` prints options; a run warns of stages that learn nothing."""

import json
from dataclasses import replace

import pytest

from baselines import train as modular
from cfp import train
from cfp.analytic.learner import AnalyticLearner
from cfp.config import SACConfig
from cfp.evaluation.page import command_words
from cfp.experiment.sac_learner import SACLearner
from cfp.experiment.training import parse
from cfp.from_dict import update_from_dict
from cfp.presets import like_start, sac_preset

TINY = "--learner sac --particles 100 --substeps 1 --num-envs 2 --device cpu --steps 400 --batch-size 4".split()


def test_dry_run_prints_the_options_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "--dry-run"]) == 0
    assert not list(tmp_path.iterdir())
    config: SACConfig = update_from_dict(sac_preset("shapematch"), json.loads(capsys.readouterr().out))
    assert (config.steps, config.handover, config.environment.particles) == (400, (300,), 100)
    assert train.main([*TINY, "--task", "run", "--resume", "--dry-run"]) == 0
    assert json.loads(capsys.readouterr().out)["task"] == "run"


@pytest.mark.parametrize(
    ("program", "options"),
    [
        (train.PROGRAM, "--task run --steps 16000 --handover 9600"),
        (train.PROGRAM, "--task kick --learner sac --steps 19200 --actor-start 2250 --no-video"),
        (train.PROGRAM, "--task run --learner sac --start-from run --batch-size 128"),
        (train.PROGRAM, "--task run --start-from run --refine --action-step 0.05 --resolutions 8 --seed 3"),
        (modular.PROGRAM, "--algo gnn-16 --task run --steps 19200 --actor-start 800"),
    ],
)
def test_the_command_that_repeats_a_run(program, options):
    """Some options follow from others; they are named where they do not."""
    config = parse(program, options.split()).run
    preset = program.find(config).preset(config.task, config.preset)
    if getattr(config, "start_from", None):
        preset = like_start(preset, {"start_from": config.start_from, "refine": config.refine})
    words = command_words(config, preset)
    assert parse(program, words[3:]).run == config


def test_stages_that_learn_nothing_are_named(tmp_path):
    def warnings(*options, first_stage=1):
        config = parse(train.PROGRAM, [*TINY, "--task", "run", *options]).run
        return SACLearner.warnings(config, tmp_path, first_stage)

    assert warnings("--handover", "200") == [
        "stage 1: all its 200 steps are random (--random-steps 480)",
        "stage 2: no update in its 200 steps (--update-start 256)",
    ]
    assert warnings("--handover", "200", first_stage=2) == warnings("--handover", "200")[1:]
    learns = "--random-steps 9 0 --update-start 50 --actor-start 0".split()
    assert warnings(*learns) == []
    late = "stage 2: no actor update in its 180 steps (--actor-start 200)"
    assert warnings(*learns, "--handover", "220", "--actor-start", "200") == [late]


def test_stages_in_which_only_the_critic_learns_are_named(tmp_path):
    config = parse(train.PROGRAM, "--task run --steps 6000".split()).run
    line = "stage 2: only the critic learns in its 1,500 steps (--warmup 15)"
    assert AnalyticLearner.warnings(config, tmp_path, 1) == [line]
    assert AnalyticLearner.warnings(replace(config, steps=7000), tmp_path, 1) == []
