"""``--dry-run`` prints options; a run warns of stages that learn nothing."""

import json
from dataclasses import replace

from cfp import train
from cfp.analytic.learner import AnalyticLearner
from cfp.config import Config
from cfp.experiment.coarse_to_fine import CoarseToFine
from cfp.experiment.training import parse
from cfp.from_dict import update_from_dict
from cfp.presets import sac_preset

TINY = "--learner sac --particles 100 --substeps 1 --num-envs 2 --device cpu --steps 400 --batch-size 4".split()


def test_dry_run_prints_the_options_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "--dry-run"]) == 0
    assert not list(tmp_path.iterdir())
    config: Config = update_from_dict(sac_preset("shapematch"), json.loads(capsys.readouterr().out))
    assert (config.steps, config.handover, config.environment.particles) == (400, (300,), 100)


def test_stages_that_learn_nothing_are_named(tmp_path):
    def warnings(*options, first_stage=1):
        config = parse(train.PROGRAM, [*TINY, "--task", "run", *options]).run
        return CoarseToFine.warnings(config, tmp_path, first_stage)

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
