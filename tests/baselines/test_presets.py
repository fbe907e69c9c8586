"""The presets of every algorithm."""

import json
from dataclasses import replace

import pytest

from baselines.registry import ALGORITHMS, algorithm_of, configure, find
from cfp.config import to_json
from cfp.errors import ConfigError
from cfp.presets import TASKS, preset, sac_preset


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("preset", ["quick", "long", "paper"])
def test_presets_are_valid_survive_json_and_agree_with_that_of_cfp(task, preset):
    own = sac_preset(task, preset)
    for name in ALGORITHMS:
        algorithm = find(name)
        if preset not in algorithm.presets:
            with pytest.raises(ConfigError, match=f"preset must be .* for {name}, got '{preset}'"):
                configure({"algo": name, "task": task, "preset": preset})
            continue
        config = configure({"algo": name, "task": task, "preset": preset})
        config.check()
        assert configure(json.loads(json.dumps(to_json(config)))) == config, name
        if algorithm.sees in ("image", "state"):  # the others have no noise
            assert config.report.eval_deterministic == own.report.eval_deterministic, name
        if hasattr(config, "learning"):  # soft actor-critic
            learning = own.learning
            if name.startswith(("gnn", "transformer")):  # other networks, without a grid of actions
                updates, start = min(4, learning.gradient_steps), min(800, learning.actor_start)
                learning = replace(learning, noise_cells=0, gradient_steps=updates, actor_start=start)
            assert config.learning == learning
            assert (config.environment, config.steps) == (own.environment, own.steps)
        if name in ("coarse", "fine"):
            assert config.resolutions == (own.resolutions[0 if name == "coarse" else -1],)
            assert (config.alpha, config.random_steps) == (own.alpha[:1], own.random_steps[:1])
        if name.startswith(("gnn", "transformer")):
            assert algorithm.sees == "state" and config.segments == int(name[-2:])
            assert (config.alpha, config.random_steps) == (own.alpha[0], own.random_steps[0])


def test_a_run_of_the_other_learner_is_resumed_by_the_same_class():
    written = json.loads(json.dumps(to_json(preset("run"))))
    assert (written["algo"], written["learner"]) == ("cfp", "analytic")  # as cfp.train leaves it
    config = configure(written)
    assert to_json(config) == to_json(preset("run")) and algorithm_of(config) is find("analytic")
