"""From one stage to the next, and from another run's policy."""

import json
import shutil
import weakref
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from policy_files import save_actor
from tiny_runs import ONE_STAGE, run

import cfp
from cfp.agent.actor import build_actor
from cfp.presets import sac_preset
from cfp.sac.learner import CFPSAC
from cfp.tables import read_table

pytestmark = pytest.mark.usefixtures("short")


@pytest.fixture
def coarse(finished):
    """The policy of a first stage."""
    return finished / "stage1.safetensors"


def test_second_stage_starts_from_a_policy(coarse, tmp_path):
    folder = tmp_path / "fine"
    assert run(folder, "--start-from", str(coarse), "--steps", "100", "--handover", "0.7") == 0
    assert json.loads((folder / "stage1.json").read_text()) == json.loads(coarse.with_suffix(".json").read_text())
    assert {row["stage"] for row in read_table(folder / "progress.csv")} == {"2"}
    assert read_table(folder / "progress.csv")[0]["step"] == "80"  # its steps go on from the handover
    actor, frozen = (cfp.load(place).actor.state_dict() for place in (folder, coarse))
    assert all(torch.equal(actor[f"coarse.{key}"], value) for key, value in frozen.items())
    results = json.loads((folder / "results.json").read_text())
    assert [row["policy"] for row in results][2:] == ["stage 1", "stage 2"]


def test_second_stage_begins_with_the_small_encoder_of_the_first(tmp_path):
    for encoder in ("small", "paper"):
        config = sac_preset("run")
        config = replace(config, encoder=encoder)
        coarse, actor = (build_actor(config.actor_spec(stage)) for stage in (1, 2))
        (tmp_path / encoder).mkdir()
        save_actor(tmp_path / encoder / "stage1.safetensors", coarse, config, 1, 5)
        assert CFPSAC.warm_start(config, 2, tmp_path / encoder, actor)
        before, after = coarse.encoder.state_dict(), actor.encoder.state_dict()
        assert all(torch.equal(value, actor.coarse.encoder.state_dict()[key]) for key, value in before.items())
        same = before.keys() == after.keys() and all(torch.equal(value, after[key]) for key, value in before.items())
        assert same == (encoder == "small")


def test_the_first_replay_memory_is_gone_when_the_second_stage_begins(tmp_path, monkeypatch):
    """On a GPU each takes a third of the memory."""
    memories, create = weakref.WeakSet(), CFPSAC.create.__func__

    def created(*arguments):
        assert not memories
        learner = create(*arguments)
        memories.add(learner.replay_buffer)
        return learner

    monkeypatch.setattr(CFPSAC, "create", classmethod(created))
    assert run(tmp_path / "run", *"--steps 40 --handover 0.5 --eval-every 0 --eval-episodes 1".split()) == 0
    assert not memories


@pytest.mark.slow
def test_three_stages_in_one_command(tmp_path):
    options = "--resolutions 4 8 16 --steps 90 --handover 0.3334 0.6667 --eval-every 10 --eval-episodes 1".split()
    assert run(tmp_path, *options) == 0
    rows = read_table(tmp_path / "evaluations.csv")
    ends = [(row["stage"], row["step"]) for row in rows if row["step"] in ("30", "60")]
    assert ends == [("1", "30"), ("2", "30"), ("2", "60"), ("3", "60")]
    policies = [cfp.load(tmp_path / f"{name}.safetensors") for name in ("stage1", "stage2", "policy")]
    assert [policy.spec.resolutions for policy in policies] == [(4,), (4, 8), (4, 8, 16)]
    for below, above in pairwise(policy.actor.state_dict() for policy in policies):
        assert all(torch.equal(above[f"coarse.{key}"], value) for key, value in below.items())
    results = json.loads((tmp_path / "results.json").read_text())
    actions = {"stage 1": "4x4", "stage 2": "8x8", "stage 3": "16x16"}
    assert {row["policy"]: row["action"] for row in results[2:]} == actions


def test_run_without_a_checkpoint_is_continued_with_its_own_options_only(coarse, tmp_path, capsys):
    """Its first evaluation, and the policy that it kept, belong to the options that it was started with."""
    folder, options = tmp_path / "a", ["--refine", *ONE_STAGE, "--steps", "40", "--eval-every", "60", "--start-from"]
    assert run(folder, *options, str(coarse)) == 0
    shutil.rmtree(folder / "checkpoint")
    assert run(folder, *options, str(coarse), "--seed", "7", "--resume") == 2
    assert "seed: the run was started with 0, got 7" in capsys.readouterr().err
    (folder / "config.json").unlink()
    assert run(folder, *options, str(coarse), "--resume") == 2
    assert "config.json: cannot be read" in capsys.readouterr().err


def test_refining_goes_on_with_the_weights_of_a_policy(coarse, tmp_path):
    options = "--refine --critics-first 0.99 0 --eval-every 10 --eval-episodes 1 --steps 90 --handover 0.6".split()
    assert run(tmp_path / "a", "--start-from", str(coarse), *options) == 0
    rows = read_table(tmp_path / "a" / "evaluations.csv")
    # Judged before it learns, and at the end of the first stage, in which nothing but the critics has learned.
    assert [(row["step"], row["stage"]) for row in rows[:3]] == [("0", "1"), ("54", "1"), ("54", "2")]
    assert rows[0]["mean"] == rows[1]["mean"]
    begun, given = (cfp.load(place).actor.state_dict() for place in (tmp_path / "a" / "stage1.safetensors", coarse))
    assert all(torch.equal(begun[key], value) for key, value in given.items())
    again = [*"--refine --steps 110 --eval-every 0 --eval-episodes 1 --start-from".split(), str(tmp_path / "a")]
    assert run(tmp_path / "b", *again) == 0
    assert {row["stage"] for row in read_table(tmp_path / "b" / "progress.csv")} == {"2"}
    fine, refined = (cfp.load(place).actor.state_dict() for place in (tmp_path / "b", tmp_path / "a"))
    assert all(torch.equal(fine[f"coarse.{key}"], value) for key, value in given.items())
    assert not torch.equal(fine["mean.0.weight"], refined["mean.0.weight"])
