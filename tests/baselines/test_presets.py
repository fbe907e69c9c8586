"""The presets of every algorithm."""

import json

import pytest

import cfp
from baselines.registry import ALGORITHMS, configure, find
from cfp.config import to_json


@pytest.mark.parametrize("task", cfp.presets.TASKS)
@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_presets_are_valid_survive_json_and_are_evaluated_alike(task, preset):
    deterministic = cfp.preset(task, preset).report.eval_deterministic
    for name in ALGORITHMS:
        algorithm = find(name)
        config = algorithm.preset(task, preset)
        config.check()
        assert configure(json.loads(json.dumps(to_json(config)))) == config, name
        if algorithm.sees in ("image", "state"):  # the others have no noise
            assert config.report.eval_deterministic == deterministic, name
