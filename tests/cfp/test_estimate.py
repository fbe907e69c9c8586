"""``--dry-run``: options and costs, and nothing written."""

import json
import re

import pytest

from baselines import train as baselines_train
from cfp import train
from cfp.agent.actor_policy import ActorPolicy
from cfp.agent.sac import CFP
from cfp.config import Config
from cfp.experiment.algorithm import mean_seconds
from cfp.experiment.estimate import _duration
from cfp.from_dict import update_from_dict
from cfp.presets import preset
from dittogym import make_spec

TINY = "--particles 100 --substeps 1 --num-envs 2 --device cpu --steps 150".split()
LEARNS = "--handover 70 --random-steps 4 4 --update-start 20 --batch-size 4".split()


def test_dry_run_tells_options_and_costs_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, *LEARNS, "--buffer-size", "60", "--dry-run"]
    assert train.main(arguments) == 0
    assert not list(tmp_path.iterdir())
    options, end = json.JSONDecoder().raw_decode(printed := capsys.readouterr().out)
    config: Config = update_from_dict(preset("shapematch"), options)
    assert (config.steps, config.handover, config.environment.particles) == (150, (70,), 100)
    header, first, second, time, memory = printed[end:].strip().splitlines()
    assert header.split()[:3] == ["stage", "action", "steps"]
    assert first.split()[:3] == ["1", "32x32", "70"] and second.split()[:3] == ["2", "64x64", "80"]
    rows = 60 * (2 * 3 * 64 * 64 + 2 * 64 * 64 * 4 + 3 * 4)  # two images, an action, three numbers each
    assert f"{rows / 2**20:.0f} MiB" in second
    assert time.startswith("time: about") and memory.startswith("memory: about")


def test_stages_that_learn_nothing_are_named(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = [*TINY[:-2], "--steps", "400", "--batch-size", "4", "--buffer-size", "60", "--task", "run", "--dry-run"]
    assert train.main(quick) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "stage 1: all its 267 steps are random (--random-steps 480)",
        "stage 2: no update in its 133 steps (--update-start 256)",
    ]
    assert train.main([*quick, "--random-steps", "9", "0", "--update-start", "50"]) == 0
    assert "stage 1: " not in capsys.readouterr().out
    refined = "--substeps 100 --start-from run --refine --random-steps 600 0 --update-start 50".split()
    assert train.main([*quick, *refined, "--resolutions", "8", "16"]) == 0
    assert "are random" not in capsys.readouterr().out


def test_an_actor_that_waits_longer_than_its_stage_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    updates, update = [], CFP._update_actor
    monkeypatch.setattr(CFP, "_update_actor", lambda *given: (updates.append(1), update(*given))[1])
    assert train.main([*TINY, *LEARNS, "--buffer-size", "60", "--actor-start", "75", "--dry-run"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "stage 1: no actor update in its 70 steps (--actor-start 75)"
    assert len(updates) == 2 * (3 + 1)  # what is timed is a whole update all the same


def test_what_follows_the_training_is_counted_with_the_policies_own_time(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked, predict = [], ActorPolicy.predict
    monkeypatch.setattr(ActorPolicy, "predict", lambda *given: (asked.append(1), predict(*given))[1])
    monkeypatch.setattr("cfp.experiment.estimate.mean_seconds", lambda action: action() or 1.0)
    monkeypatch.setattr("cfp.experiment.estimate.available", lambda: True)
    episode = make_spec("shapematch").horizon
    command = [*TINY, *LEARNS, "--buffer-size", "60", "--eval-every", "50", "--dry-run"]
    assert train.main(command) == 0  # a row for zero, random and two stages; a film
    assert f"{_duration(5 * episode)} of it for" in capsys.readouterr().out
    asked.clear()
    assert train.main([*command, "--no-video"]) == 0
    printed = capsys.readouterr().out
    assert f"{_duration(4 * episode)} of it for" in printed and len(asked) == 4
    stages = [re.split("  +", line.strip()) for line in printed.splitlines()[-4:-2]]
    assert [stage[5] for stage in stages] == [_duration(2 * episode), _duration(3 * episode)]  # 50 70, 70 100 150


def test_dry_run_of_a_run_that_goes_on_counts_what_is_left(tmp_path, capsys):
    folder = ["--out", str(tmp_path / "run")]
    options = [*TINY, *LEARNS, "--buffer-size", "60", "--eval-every", "0", "--eval-episodes", "1", "--no-video"]
    assert train.main([*options, *folder]) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert train.main([*folder, "--resume", "--steps", "99000150", "--dry-run"]) == 0
    begun, header, second, *_ = capsys.readouterr().out.splitlines()[-5:]
    assert begun.endswith("run is at step 150 of 99,000,150; what is left of it:")
    cells = [re.split("  +", line.strip()) for line in (header, second)]
    assert len(cells[0]) == len(cells[1]) == 7 and cells[1][:3] == ["2", "64x64", "99,000,000"]
    assert train.main([*folder, "--resume", "--dry-run"]) == 0
    assert "2    64x64            0" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_replay_of_blended_actions_is_as_small_as_their_parts(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [*TINY, *LEARNS, "--task", "run", "--buffer-size", "6000", "--dry-run"]
    assert train.main(arguments) == 0
    first, second = capsys.readouterr().out.strip().splitlines()[-4:-2]
    for line, numbers in ((first, 2 * 8**2), (second, 2 * 8**2 + 4 * 16**2)):  # not the 2 x 64 x 64 of the patch
        rows = 6000 * (2 * 3 * 64 * 64 + numbers * 4 + 3 * 4)
        assert line.split()[-2:] == [f"{rows / 2**20:.0f}", "MiB"]


def test_dry_run_counts_only_levels_that_will_be_trained(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [*LEARNS, "--task", "run", "--substeps", "100", "--start-from", "run", "--buffer-size", "60"]
    assert train.main([*TINY, *arguments, "--dry-run"]) == 0
    header, stage, time = capsys.readouterr().out.strip().splitlines()[-4:-1]
    assert header.startswith("stage") and stage.split()[:3] == ["2", "16x16", "80"] and time.startswith("time: about")


def test_dry_run_of_another_algorithm(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        baselines_train.main([*TINY[:-2], "--algo", "gradient", "--train-particles", "100", "--grid", "4", "--dry-run"])
        == 0
    )
    assert "4x4" in capsys.readouterr().out and not list(tmp_path.iterdir())


def test_dry_run_names_wrong_options(capsys):
    assert train.main(["--particles", "0", "--dry-run"]) == 2
    assert "particles" in capsys.readouterr().err


def test_the_first_time_is_not_timed(monkeypatch):
    now, calls = [0.0], []
    monkeypatch.setattr("cfp.experiment.algorithm.time.perf_counter", lambda: now[0])

    def action():
        now[0] += 100.0 if not calls else 2.0
        calls.append(1)

    assert mean_seconds(action, 4) == pytest.approx(2.0)
