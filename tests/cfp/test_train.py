"""The command lines, on a robot of a hundred particles that moves one substep at a time."""

import html
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fakes import FakeEnv

import cfp
import dittogym
from cfp import evaluate, train
from cfp.agent.actor import build_actor
from cfp.agent.actor_policy import ActorPolicy
from cfp.agent.spec import ActorSpec
from cfp.envs.vec_env import monitored
from cfp.evaluation import plots as plot
from cfp.evaluation import video
from cfp.evaluation.evaluate import compare
from cfp.experiment.callbacks import StopCallback
from cfp.experiment.cli import program_name
from cfp.experiment.run import Run
from cfp.presets import preset
from cfp.sections import EnvironmentConfig
from cfp.tables import read_table
from cfp.weights import describe, policy_file, save_policy, shipped

TINY = (
    "--task shapematch --particles 100 --substeps 1 --num-envs 2 --resolutions 4 8 --steps 150 --handover 70 "
    "--random-steps 10 4 --batch-size 4 --buffer-size 60 --update-start 8 --gradient-steps 1 --eval-every 60 "
    "--eval-episodes 2 --checkpoint-every 20 --log-every 10 --no-video --device cpu --backend eager"
).split()
PROCESS = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}


def run(folder, *more):
    return train.main([*TINY, "--out", str(folder), *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "whole"
    assert run(folder) == 0
    return folder


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_run_trains_both_stages_and_leaves_its_files(finished):
    for name in ("config.json", "results.json", "curve.png", "policy.safetensors", "policy.json", "stage1.json"):
        assert (finished / name).stat().st_size > 0, name
    assert list((finished / "tensorboard").glob("events*"))
    progress, evaluations = read_table(finished / "progress.csv"), read_table(finished / "evaluations.csv")
    assert [row["step"] for row in progress] == [str(step) for step in range(10, 151, 10)]
    assert [row["stage"] for row in progress] == ["1"] * 7 + ["2"] * 8
    assert [row["step"] for row in evaluations] == ["60", "70", "70", "120", "150"]
    assert progress[-1]["train/gate"] and not progress[3]["train/gate"]
    stages = [json.loads((finished / name).read_text()) for name in ("stage1.json", "policy.json")]
    assert [(stage["stage"], stage["resolution"]) for stage in stages] == [(1, 4), (2, 8)]
    for stage in stages:  # each is the policy with the best evaluation of its stage, the first of equals
        rows = [row for row in evaluations if int(row["stage"]) == stage["stage"]]
        assert stage["steps"] == int(max(rows, key=lambda row: float(row["mean"]))["step"])
    results = json.loads((finished / "results.json").read_text())
    assert [row["policy"] for row in results] == ["zero action", "random action", "stage 1", "stage 2"]
    assert [row["action"] for row in results] == ["4x4", "4x4", "4x4", "8x8"]


def test_handovers_are_named_by_their_stage_where_the_first_was_given():
    rows = [{"stage": stage, "step": step} for stage, step in (("2", "90"), ("2", "100"), ("3", "110"), ("3", "150"))]
    assert plot._handovers(rows) == [(2, 100.0)]


@pytest.mark.parametrize("place", ["finish", "train"])
def test_interrupt_that_is_not_held_back_is_one_line(tmp_path, monkeypatch, capsys, place):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Run, place, interrupt)
    assert run(tmp_path / "a", "--steps", "20", "--handover", "10") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "stopped at once"


def test_policies_are_judged_on_the_device_that_was_chosen(finished, monkeypatch):
    seen = []

    def load(path, device):
        seen.append(device)
        return cfp.load(path, "cpu")

    monkeypatch.setattr("cfp.evaluate.choose_device", lambda name: f"the one that {name} means")
    program = replace(train.PROGRAM, load=load)
    evaluate.open_run(program, finished, "cuda")
    evaluate.open_policy(program, "run", "cuda", None)
    assert seen == ["the one that cuda means"] * 3


def test_one_seed_gives_one_table(finished, tmp_path):
    assert run(tmp_path / "same") == 0
    for name in ("progress.csv", "evaluations.csv", "results.json"):
        assert (tmp_path / "same" / name).read_bytes() == (finished / name).read_bytes()
    assert run(tmp_path / "other", "--seed", "1", "--steps", "40", "--handover", "30") == 0
    assert read_table(tmp_path / "other" / "progress.csv")[2] != read_table(finished / "progress.csv")[2]


@pytest.mark.parametrize(("stop", "number"), [(44, signal.SIGINT), (70, signal.SIGTERM), (110, signal.SIGINT)])
def test_stopped_run_goes_on_as_if_nothing_had_happened(finished, tmp_path, monkeypatch, capsys, stop, number):
    folder, on_step = tmp_path / "stopped", StopCallback._on_step

    def interrupt(callback):
        if callback.stage.step == stop:
            signal.raise_signal(number)
        return on_step(callback)

    monkeypatch.setattr(StopCallback, "_on_step", interrupt)
    assert run(folder) == 128 + number
    assert "--resume" in capsys.readouterr().out
    monkeypatch.undo()
    assert train.main(["--out", str(folder), "--resume"]) == 0
    assert f"resuming {folder} at step" in capsys.readouterr().out
    assert (folder / "results.json").read_bytes() == (finished / "results.json").read_bytes()
    assert (folder / "evaluations.csv").read_bytes() == (finished / "evaluations.csv").read_bytes()
    assert (folder / "progress.csv").read_bytes() == (finished / "progress.csv").read_bytes()


def test_killed_run_repeats_what_no_checkpoint_holds(finished, tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    def die(callback):
        if callback.stage.step == 98:
            raise Killed
        return True

    folder = tmp_path / "killed"
    monkeypatch.setattr(StopCallback, "_on_step", die)
    with pytest.raises(Killed):
        run(folder)
    monkeypatch.undo()
    assert read_table(folder / "progress.csv")[-1]["step"] == "90"
    assert run(folder, "--resume") == 0
    for name in ("progress.csv", "evaluations.csv", "results.json"):
        assert (folder / name).read_bytes() == (finished / name).read_bytes()


def test_layouts_that_are_drawn_anew_go_on_as_if_nothing_had_happened(tmp_path, monkeypatch):
    options = (
        "--resample --resolutions 4 --handover --random-steps 10 --steps 128 --eval-every 0 --eval-episodes 1".split()
    )
    assert run(tmp_path / "whole", *options) == 0
    on_step = StopCallback._on_step

    def interrupt(callback):
        if callback.stage.step == 80:  # in the second episode; the third begins at 120
            signal.raise_signal(signal.SIGINT)
        return on_step(callback)

    monkeypatch.setattr(StopCallback, "_on_step", interrupt)
    assert run(tmp_path / "stopped", *options) == 128 + signal.SIGINT
    monkeypatch.undo()
    assert run(tmp_path / "stopped", *options, "--resume") == 0
    for name in ("progress.csv", "results.json"):
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_folder_with_a_run_is_left_alone(finished, capsys):
    before = contents(finished)
    assert run(finished) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: out:") and "already holds a run" in error and "--resume" in error
    assert contents(finished) == before


def test_other_options_than_the_checkpoint_s_are_refused(finished, tmp_path, capsys):
    before = contents(finished)
    assert run(finished, "--resume", "--gamma", "0.5") == 2
    assert "gamma: the run was started with" in capsys.readouterr().err
    assert run(finished, "--resume", "--task", "run") == 2
    assert "task: the run was started with 'shapematch', got 'run'" in capsys.readouterr().err
    (tmp_path / "new.json").write_text('{"learning": {"gamma": 0.5}}')
    assert train.main(["--out", str(finished), "--resume", "--config", str(tmp_path / "new.json")]) == 2
    assert "gamma: the run was started with 0.9, got 0.5" in capsys.readouterr().err
    assert contents(finished) == before


def test_resume_without_a_run_starts_afresh(tmp_path, capsys):
    assert run(tmp_path / "new", "--resume", "--steps", "30", "--handover", "20") == 0
    assert "starting a new one" in capsys.readouterr().out
    assert read_table(tmp_path / "new" / "progress.csv")[-1]["step"] == "30"


def test_finished_run_can_be_prolonged(tmp_path):
    assert run(tmp_path / "a", "--steps", "40", "--handover", "20") == 0
    assert train.main(["--out", str(tmp_path / "a"), "--resume", "--steps", "60"]) == 0
    assert read_table(tmp_path / "a" / "progress.csv")[-1]["step"] == "60"


def test_results_do_not_outlive_the_steps_they_are_of(tmp_path, monkeypatch):
    assert run(tmp_path / "a", "--steps", "40", "--handover", "20") == 0
    assert (tmp_path / "a" / "results.json").exists()
    on_step = StopCallback._on_step

    def stop(callback):
        signal.raise_signal(signal.SIGTERM)
        return on_step(callback)

    monkeypatch.setattr(StopCallback, "_on_step", stop)
    assert train.main(["--out", str(tmp_path / "a"), "--resume", "--steps", "60"]) == 128 + signal.SIGTERM
    assert not (tmp_path / "a" / "results.json").exists()


def test_evaluation_is_not_haunted_by_the_one_before():
    """With reference parity a reset shows what was before; the environments of an evaluation have nothing before."""
    config = replace(preset("shapematch"), seed=3)
    environment = replace(config.environment, particles=100, substeps=1, num_envs=2, parity="reference")
    config = replace(config, environment=environment)
    policy = ActorPolicy(ActorSpec((8,)), True)
    policy.description = {}
    once, twice = compare(config, {"a": policy}, 2), compare(config, {"a": policy, "b": policy}, 2)
    assert once[-1].returns == twice[-2].returns == twice[-1].returns


def test_damaged_checkpoint_is_an_error_that_names_it(tmp_path, capsys):
    assert run(tmp_path / "a", "--steps", "30", "--handover", "20") == 0
    state = tmp_path / "a" / "checkpoint" / "state.pt"
    state.write_bytes(state.read_bytes()[:1000])
    assert run(tmp_path / "a", "--resume", "--steps", "30", "--handover", "20") == 2
    assert "state.pt: the checkpoint is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "jump"], "task must be catch, dig"),
        (["--preset", "slow"], "preset must be quick or paper for shapematch, got 'slow'"),
        (["--particles", "0"], "particles"),
        (["--target", "no/such.png"], "target"),
        (["--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (["--device", "abacus"], "device must be auto, cpu or cuda, got 'abacus'"),
        (["--config", "no/such.json"], "config: no/such.json cannot be read"),
        (["--backend", "slide-rule"], "backend"),
    ],
)
def test_wrong_option_is_one_line_and_exit_code_two(tmp_path, capsys, arguments, message):
    folder = tmp_path / "none"
    assert train.main(["--out", str(folder), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message in error
    assert not folder.exists()


def test_unknown_option_is_exit_code_two(capsys):
    with pytest.raises(SystemExit) as exit_:
        train.main(["--steppes", "3"])
    assert exit_.value.code == 2


def test_help_names_the_program_that_was_started(tmp_path, monkeypatch, capsys):
    (tmp_path / "pit.py").write_text("import sys, cfp.train\nsys.exit(cfp.train.main())")
    for command, name in (
        (["pit.py", "--out", ".", "--bad"], "python pit.py --help"),
        (["-m", "baselines.distill", "--bad"], "python -m baselines.distill --help"),
    ):
        done = subprocess.run([sys.executable, *command], cwd=tmp_path, env=PROCESS, capture_output=True, text=True)
        assert done.returncode == 2 and name in " ".join(done.stderr.replace("│", " ").split())
    assert program_name("cfp.train", []) == "python -m cfp.train"


def test_evaluation_of_a_folder(finished, capsys):
    assert evaluate.main([str(finished), "--episodes", "2", "--json", "--device", "cpu"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows == json.loads((finished / "results.json").read_text())
    assert evaluate.main([str(finished), "--episodes", "1"]) == 0
    table = capsys.readouterr().out
    assert "stage 2" in table and "± std" in table


def test_evaluation_with_and_without_noise(finished, capsys):
    rows = {}
    for noise in ("with", "without", "both"):
        arguments = [str(finished), "--episodes", "2", "--json", "--device", "cpu", "--noise", noise]
        assert evaluate.main(arguments) == 0
        rows[noise] = {row.pop("policy"): row for row in json.loads(capsys.readouterr().out)[2:]}
    assert list(rows["both"]) == [f"stage {stage}, {how}" for stage in (1, 2) for how in ("noisy", "mean")]
    for stage in ("stage 1", "stage 2"):
        assert rows["both"][f"{stage}, noisy"] == rows["with"][stage]
        assert rows["both"][f"{stage}, mean"] == rows["without"][stage]
    assert rows["with"] != rows["without"]
    assert rows["with"]["stage 1"]["interval"] > 0


def test_evaluation_of_a_single_policy_is_that_of_its_run(finished, capsys):
    common = ["--episodes", "2", "--json", "--device", "cpu"]
    assert evaluate.main(["--policy", str(finished / "policy.safetensors"), *common]) == 0
    alone = json.loads(capsys.readouterr().out)
    assert evaluate.main([str(finished), *common]) == 0
    run = json.loads(capsys.readouterr().out)
    assert alone[-1] | {"policy": "stage 2"} == run[-1]
    assert evaluate.main([str(finished), *common, "--particles", "60"]) == 0
    other = json.loads(capsys.readouterr().out)
    assert [row["mean"] for row in other] != [row["mean"] for row in run]


def test_single_policy_need_not_have_the_grids_of_its_task(tmp_path, monkeypatch):
    monkeypatch.setattr("dittogym.tasks.TASKS", dict(dittogym.TASKS))
    monkeypatch.setattr("dittogym.registration.TASKS", dittogym.tasks.TASKS)
    tens = replace(dittogym.make_spec("run"), name="tens", coarse=10, fine=20, horizon=2)
    dittogym.register("tens", lambda: tens)
    environment = EnvironmentConfig(particles=60, substeps=1)
    config = replace(cfp.preset("tens"), resolutions=(4, 8, 16), gate_bias=(-1.0, -2.0), environment=environment)
    save_policy(tmp_path / "policy.safetensors", build_actor(config.actor_spec(3)), describe(config, 3, 0))
    command = evaluate.Command(policy=str(tmp_path), episodes=1, device="cpu")
    opened, _ = command.open(train.PROGRAM)
    assert (opened.resolutions, opened.gate_bias) == (config.resolutions, config.gate_bias)
    assert "policy" in evaluate.run(train.PROGRAM, command)


def test_other_particles_are_not_those_of_the_reference_s_faults(tmp_path):
    config = cfp.preset("shapematch", "paper")
    save_policy(tmp_path / "policy.safetensors", build_actor(config.actor_spec(1)), describe(config, 1, 0))
    for particles, parity in ((None, "reference"), ("full", "reference"), ("lite", "clean"), (60, "clean")):
        chosen = evaluate.Selection(policy=str(tmp_path), particles=particles)
        environment = chosen.open(train.PROGRAM)[0].environment
        assert (environment.particles, environment.parity) == (particles or "full", parity)
        assert environment.action_indexing == "grid"  # as the policy acts


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "either policy or a folder must be given, got None"),
        (["somewhere", "--policy", "run"], "either policy or a folder must be given"),
        (["--policy", "alchemy"], "(catch, grow, run, shapematch)"),
        (["--policy", "run", "--particles", "0"], "particles"),
    ],
)
def test_evaluation_of_nothing_is_an_error(arguments, message, capsys):
    assert evaluate.main([*arguments, "--episodes", "1"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", shipped())
def test_shipped_policy_acts_in_its_task(name):
    policy = cfp.load(name)
    assert policy.description["task"] == name and policy_file(name).stat().st_size < 1_000_000
    assert json.loads(policy_file(name).with_suffix(".json").read_text()) == policy.description
    env = dittogym.TorchEnv(name, resolution=policy.resolution, particles=100, substeps=1)
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation.numpy())
    assert action.shape == (1, *env.action_shape) and np.abs(action).max() <= 1


def test_task_of_a_module_is_trained_and_evaluated_by_name(tmp_path, monkeypatch, capsys):
    """Each time as in a process that has not seen the module. Loading a policy imports nothing, evaluating it does."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dittogym.tasks.TASKS", dict(dittogym.TASKS))
    monkeypatch.setattr("dittogym.registration.TASKS", dittogym.tasks.TASKS)
    (tmp_path / "bouncing.py").write_text(
        "import dataclasses, dittogym\n"
        "def bounce(): return dataclasses.replace(dittogym.make_spec('run'), name='bounce', horizon=20)\n"
        "dittogym.register('bounce', bounce)"
    )

    def forget():
        sys.modules.pop("bouncing", None)
        dittogym.tasks.TASKS.pop("bounce", None)

    folder = tmp_path / "runs" / "cfp-bounce-quick-0"
    assert train.main([*TINY, "--task", "bouncing:bounce"]) == 0
    forget()
    policy = cfp.load(folder)
    assert policy.description["task"] == "bouncing:bounce" and "bouncing" not in sys.modules
    capsys.readouterr()
    for what in ([str(folder)], ["--policy", str(folder / "policy.safetensors")]):
        forget()
        assert evaluate.main([*what, "--episodes", "1"]) == 0
        assert "stage 2" in capsys.readouterr().out or "policy" in what[-1]
    forget()
    (tmp_path / "bouncing.py").unlink()
    sys.path_importer_cache.clear()
    assert evaluate.main([str(folder), "--episodes", "1"]) == 2
    assert "(module 'bouncing': ModuleNotFoundError" in capsys.readouterr().err


def test_page_shows_the_run_and_opens_from_disk(finished):
    page = (finished / "index.html").read_text()
    assert 'src="curve.png"' in page and "http" not in page and "<video" not in page  # filmed nothing
    for row in json.loads((finished / "results.json").read_text()):
        assert f"<td>{row['policy']}</td>" in page and f"<td>{row['mean']:.1f}</td>" in page
    assert html.escape((finished / "config.json").read_text().strip()) in page


def test_evaluation_without_a_run_is_an_error(tmp_path, capsys):
    assert evaluate.main([str(tmp_path)]) == 2
    assert "there is no run" in capsys.readouterr().err


def test_video_plays_or_tells_how_to_install(finished, tmp_path, monkeypatch, capsys):
    arguments = [str(finished), "--episodes", "1", "--video", str(tmp_path / "film.mp4")]
    monkeypatch.setattr("cfp.evaluation.video.find_spec", lambda name: None)
    assert evaluate.main(arguments) == 0
    assert "pip install 'torchmpm[video]'" in capsys.readouterr().out
    assert evaluate.main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)[-1]["policy"] == "stage 2" and "pip install 'torchmpm[video]'" in told.err
    monkeypatch.undo()
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    assert evaluate.main([*arguments, "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out) and told.err.strip() == f"video: {tmp_path / 'film.mp4'}"
    with imageio.get_reader(tmp_path / "film.mp4") as film:
        metadata = film.get_meta_data()
    assert metadata["codec"].startswith("h264")
    assert tuple(metadata["size"]) == (512, 512)
    assert metadata["duration"] == pytest.approx(4.1, abs=0.15)


def test_film_is_made_picture_by_picture(monkeypatch):
    env = FakeEnv(num_envs=1, horizon=3)
    monkeypatch.setattr(video, "make_env", lambda *_: monitored(env))
    monkeypatch.setattr(video, "attached", lambda policy, venv: policy)

    def predict(observation, memory, start, deterministic):
        seen.append((bool(start[0]), float(torch.rand(()))))
        return np.zeros((1, 2, 8, 8), np.float32), memory

    runs = []
    for _ in range(2):
        seen = []
        torch.rand(())
        before = torch.get_rng_state()
        for count, picture in enumerate(video.film_episode(None, SimpleNamespace(predict=predict), 8, False, 5)):
            assert picture.shape == (512, 512, 3) and len(seen) == count and torch.is_grad_enabled()
            assert torch.equal(torch.get_rng_state(), before)
        runs.append(seen)
    assert count == 3 and runs[0] == runs[1] and [start for start, _ in seen] == [True, False, False]
    assert len({luck for _, luck in seen}) == 3


def test_film_that_fails_leaves_the_old_file(tmp_path):
    pytest.importorskip("imageio_ffmpeg")

    def frames():
        yield from np.zeros((3, 32, 32, 3), np.uint8)
        raise ValueError("the robot is gone")

    (tmp_path / "film.mp4").write_bytes(b"old")
    with pytest.raises(ValueError, match="the robot is gone"):
        video.write_video(tmp_path / "film.mp4", frames())
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"old"
