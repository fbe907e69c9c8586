"""The command line that evaluates: a folder, a single policy, films, recorded episodes, tasks of modules."""

import json
import sys
from dataclasses import replace
from unittest import mock

import pytest
from policy_files import save_actor
from short_episodes import HORIZON
from tiny_runs import TINY

import cfp
import dittogym
from cfp import evaluate, train
from cfp.agent.actor import build_actor
from cfp.presets import sac_preset
from dittogym.trajectories import load_episodes

pytestmark = pytest.mark.usefixtures("short")


def rows_of(capsys, *words):
    assert evaluate.main([*words, "--json", "--device", "cpu"]) == 0
    return json.loads(capsys.readouterr().out)


def test_evaluation_of_a_folder_and_of_its_policy(finished, capsys):
    folder, two = str(finished), ("--episodes", "2")
    rows = rows_of(capsys, folder, *two)
    assert rows == json.loads((finished / "results.json").read_text())
    alone = rows_of(capsys, "--policy", str(finished / "policy.safetensors"), *two)
    assert alone[-1] | {"policy": "stage 2"} == rows[-1]
    other = rows_of(capsys, folder, *two, "--particles", "60")
    assert [row["mean"] for row in other] != [row["mean"] for row in rows]
    assert evaluate.main([folder, "--episodes", "1"]) == 0
    table = capsys.readouterr().out
    assert "stage 2" in table and "± std" in table


def test_evaluation_with_and_without_noise(finished, capsys):
    rows = {}
    for noise in ("with", "without", "both"):
        told = rows_of(capsys, str(finished), "--episodes", "2", "--noise", noise)[2:]
        rows[noise] = {row.pop("policy"): row for row in told}
    assert list(rows["both"]) == [f"stage {stage}, {how}" for stage in (1, 2) for how in ("noisy", "mean")]
    for stage in ("stage 1", "stage 2"):
        assert rows["both"][f"{stage}, noisy"] == rows["with"][stage]
        assert rows["both"][f"{stage}, mean"] == rows["without"][stage]
    assert rows["with"] != rows["without"]
    assert rows["with"]["stage 1"]["interval"] > 0


def test_single_policy_need_not_have_the_grids_of_its_task(tmp_path, monkeypatch):
    tens = replace(dittogym.make_spec("run"), name="tens", coarse=10, fine=20, horizon=2)
    monkeypatch.setitem(dittogym.TASKS, "tens", lambda: tens)
    own = {"resolutions": (4, 8, 16), "gate_bias": (-1.0, -2.0), "handover": (0.3, 0.6), "particles": 60, "substeps": 1}
    config = replace(sac_preset("tens"), **own)
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(3)), config, 3, 0)
    command = evaluate.Command(policy=str(tmp_path), episodes=1, device="cpu")
    assert command.open()[0].resolutions == config.resolutions
    assert "policy" in evaluate.run(command)


@mock.patch.dict(dittogym.TASKS)
def test_task_of_a_module_is_trained_and_evaluated_by_name(tmp_path, monkeypatch, capsys):
    """Each time as in a process that has not seen the module. Loading a policy imports nothing, evaluating it does."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bouncing.py").write_text(
        "import dataclasses, dittogym\n"
        "def bounce(): return dataclasses.replace(dittogym.make_spec('run'), name='bounce', horizon=20)\n"
        "dittogym.register('bounce', bounce)"
    )

    def forget():
        sys.modules.pop("bouncing", None)
        dittogym.TASKS.pop("bounce", None)

    folder = tmp_path / "runs" / "cfp-sac-bounce-quick-0"
    short = "--steps 40 --handover 0.5 --eval-every 0 --eval-episodes 1".split()
    assert train.main([*TINY, *short, "--task", "bouncing:bounce"]) == 0
    forget()
    policy = cfp.load(folder)
    assert policy.description["task"] == "bouncing:bounce" and "bouncing" not in sys.modules
    capsys.readouterr()
    for what, name in (([str(folder)], "stage 2"), (["--policy", str(folder / "policy.safetensors")], "policy")):
        forget()
        assert evaluate.main([*what, "--episodes", "1"]) == 0
        assert f"\n{name} " in capsys.readouterr().out
    forget()
    (tmp_path / "bouncing.py").unlink()
    sys.path_importer_cache.clear()
    assert evaluate.main([str(folder), "--episodes", "1"]) == 2
    assert "No module named 'bouncing'" in capsys.readouterr().err


def test_video_and_replay_or_how_to_install(finished, tmp_path, monkeypatch, capsys):
    films = "--size 128 --rate 20 --video".split()
    arguments = [str(finished), "--episodes", "1", "--json", *films, str(tmp_path / "film.mp4")]
    monkeypatch.setattr("dittogym.render.film.find_spec", lambda name: None)
    assert evaluate.main([*arguments, "--replay", str(tmp_path / "replay.html")]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)[-1]["policy"] == "stage 2" and "pip install 'torchmpm[video]'" in told.err
    assert f"replay: {tmp_path / 'replay.html'}" in told.err and (tmp_path / "replay.html").stat().st_size > 10_000
    monkeypatch.undo()
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    assert evaluate.main(arguments) == 0
    assert capsys.readouterr().err.strip() == f"video: {tmp_path / 'film.mp4'}"
    with imageio.get_reader(tmp_path / "film.mp4") as film:
        metadata = film.get_meta_data()
    assert metadata["codec"].startswith("h264") and tuple(metadata["size"]) == (128, 128) and metadata["fps"] == 20


def test_recorded_episodes_are_those_that_were_evaluated(finished, tmp_path, capsys):
    file = tmp_path / "episodes.npz"
    options = f"--episodes 2 --json --record {file} --record-fields x".split()
    assert evaluate.main([str(finished), *options]) == 0
    told = capsys.readouterr()
    episodes = load_episodes(file)
    assert [episode.rewards.sum() for episode in episodes] == pytest.approx(
        json.loads(told.out)[-1]["returns"], abs=2e-3
    )
    assert [list(episode.particles) for episode in episodes] == [["x"], ["x"]] and f"record: {file}" in told.err
    assert episodes[0].seed + 1 == episodes[1].seed and episodes[0].actions.shape == (HORIZON, 2, 64, 64)
