"""What a run shows while it trains: names, pictures, Weights & Biases."""

import sys
from unittest import mock

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from tiny_runs import assert_same_run, resume, run

from cfp.agent.actor import ActorSpec, build_actor
from cfp.analytic.learner import METRICS as ANALYTIC_METRICS
from cfp.evaluation.page import PICTURES, muscles, policy_pictures
from cfp.experiment.callbacks import EVALUATION_COLUMNS, EVALUATION_METRICS, LOG_METRICS
from cfp.sac.learner import METRICS
from cfp.tables import read_table

pytestmark = pytest.mark.usefixtures("short")


def events(folder):
    read = EventAccumulator(str(folder / "tensorboard"), {"images": 0})
    read.Reload()
    return read


@pytest.fixture
def wandb(monkeypatch):
    """Notes what it is given."""
    fake = mock.Mock(Image=lambda pixels: ("image", pixels.shape))
    fake.init.return_value = fake
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


@pytest.mark.parametrize("learner", ["sac", "analytic"])
def test_everything_written_is_explained_and_everything_explained_is_written(learner, request):
    folder = request.getfixturevalue("finished" if learner == "sac" else "finished_analytic")
    rows = set(METRICS | LOG_METRICS if learner == "sac" else ANALYTIC_METRICS | LOG_METRICS)
    columns = set(read_table(folder / "progress.csv")[0])
    assert columns - {"step"} == rows - {"time/steps_per_second"}
    read = events(folder)
    scalars = {"reward/TERM" if name.startswith("reward/") else name for name in read.Tags()["scalars"]}
    assert scalars == rows | set(EVALUATION_METRICS)
    assert set(read.Tags()["images"]) == set(PICTURES)
    assert set(read_table(folder / "evaluations.csv")[0]) == set(EVALUATION_COLUMNS)


def test_evaluations_and_pictures_stand_at_their_steps(finished):
    read, rows = events(finished), read_table(finished / "evaluations.csv")
    points = [(event.step, event.value) for event in read.Scalars("eval/return")]
    assert [step for step, _ in points] == [int(row["step"]) for row in rows] == [60, 70, 70, 120, 150]
    np.testing.assert_allclose([value for _, value in points], [float(row["mean"]) for row in rows], rtol=1e-5)
    assert [event.step for event in read.Images("picture/action")] == [60, 70, 70, 120, 150]
    gates = read.Images("picture/gate")  # the first stage has none
    assert [(event.step, event.height) for event in gates] == [(70, 192), (120, 192), (150, 192)]


def test_terms_of_the_reward_add_up_to_the_return(finished):
    read = events(finished)
    terms = [name for name in read.Tags()["scalars"] if name.startswith("reward/")]
    assert "reward/failure" in terms and len(terms) > 2
    sums = np.sum([[event.value for event in read.Scalars(name)] for name in terms], axis=0)
    np.testing.assert_allclose(sums, [event.value for event in read.Scalars("eval/return")], rtol=1e-5)


def test_options_are_shown_as_hyperparameters(finished):
    content = events(finished).PluginTagToContent("hparams")["_hparams_/session_start_info"]
    options = HParamsPluginData.FromString(content).session_start_info.hparams
    assert options["batch_size"].number_value == 4 and options["resolutions"].string_value == "(4, 8)"


def test_pictures_show_the_mean_action_and_draw_no_random_number():
    torch.manual_seed(0)
    actor = build_actor(ActorSpec((8, 16), (100.0,), patch=64))
    observation = torch.randint(0, 256, (1, 3, 64, 64), dtype=torch.uint8)
    before = torch.get_rng_state()
    pictures = policy_pictures(actor, observation)
    assert torch.equal(torch.get_rng_state(), before)
    assert set(pictures) == set(PICTURES)
    expected = muscles(actor(observation, deterministic=True)[0].detach())
    np.testing.assert_array_equal(pictures["picture/action"], expected)
    assert pictures["picture/gate"][..., 0].min() == 0  # the line between the two
    assert (pictures["picture/gate"][:, :192] == [255, 0, 0]).all()
    assert pictures["picture/observation"][0, 0].tolist() == observation[0, :, 0, 0].tolist()


def test_weights_and_biases_gets_all_rows_and_leaves_learning_as_it_was(finished, wandb, tmp_path):
    folder = tmp_path / "run"
    assert run(folder, *"--wandb offline --wandb-project mine".split()) == 0
    assert_same_run(folder, finished)
    options = wandb.init.call_args.kwargs
    assert (options["mode"], options["project"], options["dir"]) == ("offline", "mine", str(folder))
    assert options["name"] == "cfp-sac-shapematch-quick-0" and options["config"]["batch_size"] == 4
    wandb.define_metric.assert_called_with("*", step_metric="step")
    wandb.finish.assert_called_once()
    points = [call.args[0] for call in wandb.log.call_args_list]
    names = {name for point in points for name in point} - {"step"}
    tags = events(finished).Tags()
    assert names == set(tags["scalars"]) | set(tags["images"])
    last = [point for point in points if "picture/gate" in point][-1]
    assert last["step"] == 150 and last["picture/gate"] == ("image", (192, 386, 3))
    assert all(value is not None for point in points for value in point.values())
    assert resume(folder, "--steps", "160") == 0
    resumed = wandb.init.call_args.kwargs
    assert resumed["id"] == options["id"] and resumed["resume"] == "allow"


def test_weights_and_biases_that_is_not_installed_is_refused_at_once(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)  # importing it raises ImportError
    assert run(tmp_path / "on", "--wandb", "online") == 2
    error = capsys.readouterr().err
    assert "got 'online'" in error and "pip install 'torchmpm[wandb]'" in error
    assert not (tmp_path / "on").exists()
