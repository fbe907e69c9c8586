"""The command lines that train and evaluate."""

import html
import json
import re
import shlex
import shutil
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
from policy_files import save_actor
from tiny_runs import TABLES, TINY, assert_same_run, at_step, run

import cfp
import cfp.experiment.run
import dittogym
import torchmpm
from cfp import evaluate, train
from cfp.agent.actor import ActorSpec, build_actor
from cfp.config import to_json
from cfp.evaluation.returns import compare
from cfp.experiment import callbacks
from cfp.experiment.cli import program_name
from cfp.experiment.training import parse
from cfp.policy import ActorPolicy, policy_file, read_policy, shipped
from cfp.presets import sac_preset
from cfp.sections import EnvironmentConfig
from cfp.tables import read_table
from dittogym.render.frame import png
from dittogym.tasks.targets import load_target

pytestmark = pytest.mark.usefixtures("short")


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


def test_another_seed_gives_another_run(tmp_path):
    options = "--resolutions 4 --handover --steps 30 --random-steps 10 --eval-every 0 --eval-episodes 1".split()
    for seed in "01":
        assert run(tmp_path / seed, "--seed", seed, *options) == 0
    first, second = (read_table(tmp_path / seed / "progress.csv")[-1] for seed in "01")
    assert first["train/learning_rate"] == second["train/learning_rate"]
    assert first["train/critic_loss"] != second["train/critic_loss"]


def test_the_end_of_a_run_names_an_earlier_stage_that_returns_more(finished, tmp_path, monkeypatch, capsys):
    folder, real = tmp_path / "run", cfp.experiment.run.compare
    shutil.copytree(finished, folder)

    def end(stage, **returns):
        def adjusted(*arguments):
            return [replace(result, returns=returns.get(result.name[-1], (0.0,))) for result in real(*arguments)]

        monkeypatch.setattr("cfp.experiment.run.compare", adjusted)
        assert train.main(["--out", str(folder), "--resume"]) == 0
        return f"{stage} has the highest mean return" in capsys.readouterr().out

    assert end("stage 1", **{"1": (2.0,), "2": (1.0,), "n": (9.0,)})  # whatever zero and random action return
    assert not end("stage", **{"1": (1.0,), "2": (2.0,)})


def test_stopped_run_goes_on_as_if_nothing_had_happened(finished, tmp_path, capsys):
    folder = tmp_path / "stopped"
    with at_step(44, lambda: signal.raise_signal(signal.SIGINT)):
        assert run(folder) == 128 + signal.SIGINT
    assert "--resume" in capsys.readouterr().out
    with at_step(70, lambda: signal.raise_signal(signal.SIGTERM)):  # the end of a stage
        assert train.main(["--out", str(folder), "--resume"]) == 128 + signal.SIGTERM
    assert f"resuming {folder} at step 44" in capsys.readouterr().out
    assert train.main(["--out", str(folder), "--resume"]) == 0
    assert f"resuming {folder} at step 70" in capsys.readouterr().out
    assert_same_run(folder, finished, (*TABLES, "policy.safetensors"))


def test_run_stopped_in_an_evaluation_repeats_it(finished, tmp_path):
    folder, real = tmp_path / "stopped", callbacks.make_trial

    def stop(*arguments, **options):
        signal.raise_signal(signal.SIGTERM)
        return real(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callbacks, "make_trial", stop)
        assert run(folder) == 128 + signal.SIGTERM
    assert read_table(folder / "evaluations.csv") == []
    evaluate_first = callbacks.EvaluationCallback._on_training_start

    def crash(callback):
        evaluate_first(callback)
        raise RuntimeError("killed")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(RuntimeError, match="killed"):
        patch.setattr(callbacks.EvaluationCallback, "_on_training_start", crash)
        train.main(["--out", str(folder), "--resume"])
    assert train.main(["--out", str(folder), "--resume"]) == 0  # finds the row, and does not add it again
    assert_same_run(folder, finished, (*TABLES, "policy.safetensors"))


@pytest.mark.slow
def test_layouts_that_are_drawn_anew_go_on_as_if_nothing_had_happened(tmp_path):
    options = "--resample --resolutions 4 --handover --random-steps 10 --steps 128 --eval-every 0 --eval-episodes 1"
    assert run(tmp_path / "whole", *options.split()) == 0
    with at_step(80, lambda: signal.raise_signal(signal.SIGINT)):  # in the second episode; the third begins at 120
        assert run(tmp_path / "stopped", *options.split()) == 128 + signal.SIGINT
    assert run(tmp_path / "stopped", *options.split(), "--resume") == 0
    assert_same_run(tmp_path / "stopped", tmp_path / "whole", ("progress.csv", "results.json"))


def test_other_options_than_the_checkpoint_s_are_refused(finished, tmp_path, capsys):
    assert run(finished, "--resume", "--task", "run") == 2
    assert "task: the run was started with 'shapematch', got 'run'" in capsys.readouterr().err
    (tmp_path / "new.json").write_text('{"learning": {"gamma": 0.5}}')
    assert train.main(["--out", str(finished), "--resume", "--config", str(tmp_path / "new.json")]) == 2
    assert "gamma: the run was started with 0.95, got 0.5" in capsys.readouterr().err


def test_finished_run_can_be_prolonged_and_its_results_do_not_outlive_it(tmp_path, capsys):
    folder = tmp_path / "run"
    assert run(folder, *"--resume --steps 40 --handover 20 --eval-every 0 --eval-episodes 1".split()) == 0
    assert "holds no run yet" in capsys.readouterr().out and (folder / "results.json").exists()
    with at_step(44, lambda: signal.raise_signal(signal.SIGTERM)):
        assert train.main(["--out", str(folder), "--resume", "--steps", "60"]) == 128 + signal.SIGTERM
    assert not (folder / "results.json").exists()
    assert train.main(["--out", str(folder), "--resume"]) == 0
    assert read_table(folder / "progress.csv")[-1]["step"] == "60" and (folder / "results.json").exists()
    before = {path: path.read_bytes() for path in folder.glob("*.json")}
    capsys.readouterr()
    assert train.main(["--out", str(folder), "--resume", "--steps", "44"]) == 2
    assert "steps must be at least 60, those that the run has taken, got 44" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.glob("*.json")} == before


def test_resuming_nothing_is_an_error_unless_a_task_is_named(tmp_path, capsys):
    assert train.main(["--out", str(tmp_path / "none"), "--resume"]) == 2
    assert "none holds no run to resume; name a --task to start one there" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_without_evaluations_the_newest_policy_is_kept(tmp_path):
    folder, policy = tmp_path / "run", tmp_path / "run" / "policy.safetensors"
    assert run(folder, *"--steps 40 --handover 20 --eval-every 8 --eval-episodes 1".split()) == 0
    assert train.main(["--out", str(folder), "--resume", "--steps", "60", "--eval-every", "0"]) == 0
    assert read_policy(policy)[1]["steps"] == 60


def test_help_names_the_program_that_was_started(monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)  # as in a script
    monkeypatch.setattr(sys, "argv", ["pit.py", "--out", ".", "--bad"])
    with pytest.raises(SystemExit):
        train.main()
    assert "python pit.py --help" in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert program_name("cfp.train", []) == "python -m cfp.train"


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--video film.html", "video must end in .mp4 or .gif or .webp or .png, got film.html"),
        ("--video film.avi", "video must end in .mp4 or .gif or .webp or .png, got film.avi"),
        ("--replay film.mp4", "replay must end in .html, got film.mp4"),
        ("--video film.mp4 --size 3", "size must be at least 16, got 3"),
    ],
)
def test_files_of_films_are_checked_first(options, message, capsys):
    assert evaluate.main(["no/such/folder", *options.split()]) == 2
    assert message in capsys.readouterr().err


def test_evaluation_is_not_haunted_by_the_one_before():
    """The environments of an evaluation have nothing before."""
    config = replace(sac_preset("shapematch"), seed=3)
    environment = replace(config.environment, particles=100, substeps=1, num_envs=2)
    config = replace(config, environment=environment)
    policy = ActorPolicy(ActorSpec((8,)), True)
    policy.description = {}
    once, twice = compare(config, {"a": policy}, 2), compare(config, {"a": policy, "b": policy}, 2)
    assert once[-1].returns == twice[-2].returns == twice[-1].returns


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
    config = replace(sac_preset("tens"), resolutions=(4, 8, 16), gate_bias=(-1.0, -2.0), environment=environment)
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(3)), config, 3, 0)
    command = evaluate.Command(policy=str(tmp_path), episodes=1, device="cpu")
    opened, _ = command.open(train.PROGRAM)
    assert (opened.resolutions, opened.gate_bias) == (config.resolutions, config.gate_bias)
    assert "policy" in evaluate.run(train.PROGRAM, command)


def test_policies_with_parity_in_their_header_act_as_they_did(tmp_path):
    config = sac_preset("shapematch", "paper")
    config = replace(config, environment=replace(config.environment, parity="reference"))
    save_actor(tmp_path / "policy.safetensors", build_actor(config.actor_spec(1)), config, 1, 0)
    for particles in (None, "full", "lite", 60):
        chosen = evaluate.Selection(policy=str(tmp_path), particles=particles)
        environment = chosen.open(train.PROGRAM)[0].environment
        assert environment.particles == (particles or "full")
        assert environment.action_indexing == "grid"  # as the policy acts


@pytest.mark.parametrize("name", shipped())
def test_shipped_policy_acts_in_its_task(name):
    policy = cfp.load(name)
    task = policy.description["task"]
    assert name in (task, f"{task}-success") and policy_file(name).stat().st_size < 1_000_000
    assert json.loads(policy_file(name).with_suffix(".json").read_text()) == policy.description
    env = dittogym.TorchEnv(task, resolution=policy.resolution, particles=100, substeps=1)
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
    short = "--steps 40 --handover 20 --eval-every 0 --eval-episodes 1".split()
    assert train.main([*TINY, *short, "--task", "bouncing:bounce"]) == 0
    forget()
    policy = cfp.load(folder)
    assert policy.description["task"] == "bouncing:bounce" and "bouncing" not in sys.modules
    capsys.readouterr()
    for what, name in (([str(folder)], "stage 2"), (["--policy", str(folder / "policy.safetensors")], "policy")):
        forget()
        assert evaluate.main([*what, "--episodes", "1"]) == 0
        printed = capsys.readouterr()
        assert f"\n{name} " in printed.out and "has changed" not in printed.err
    forget()
    with (tmp_path / "bouncing.py").open("a") as file:
        file.write("\n# another task now")
    assert evaluate.main([str(folder), "--episodes", "1"]) == 0
    assert "a file of task 'bouncing:bounce' has changed since the policy was trained" in capsys.readouterr().err
    forget()
    (tmp_path / "bouncing.py").unlink()
    sys.path_importer_cache.clear()
    assert evaluate.main([str(folder), "--episodes", "1"]) == 2
    assert "No module named 'bouncing'" in capsys.readouterr().err


def test_page_shows_the_run_and_opens_from_disk(finished):
    page = (finished / "index.html").read_text()
    assert 'src="curve.png"' in page and "http" not in page and "<video" not in page  # filmed nothing
    for row in json.loads((finished / "results.json").read_text()):
        means = {f"<td>{row['mean'] + rounding:.1f}</td>" for rounding in (-5e-4, 5e-4)}  # the file has three digits
        assert f'<td class="text">{row["policy"]}</td>' in page and any(mean in page for mean in means)
    assert html.escape((finished / "config.json").read_text().strip()) in page


def test_page_of_a_run_with_a_film_and_a_target(tmp_path, capsys):
    folder, drawing = tmp_path / "run", tmp_path / "bar & box.png"
    pixels = np.full((90, 200, 3), 255, np.uint8)
    pixels[30:60, 20:120] = 0
    drawing.write_bytes(png(pixels))
    options = ["--video", "--target", str(drawing), "--eval-every", "0", "--eval-episodes", "1", "--seed", "3"]
    assert run(folder, *options, "--steps", "40", "--handover", "20") == 0
    assert f"target: {folder / 'target.png'}" in capsys.readouterr().out
    target = load_target(drawing)
    assert np.array_equal(load_target(folder / "target.png"), target) and np.ptp(np.argwhere(target), 0)[1] > 30
    page = (folder / "index.html").read_text()
    for part in ('poster="poster.png"', 'href="replay.html"', "Intersection over union", "No evaluation was made"):
        assert part in page
    cells = "".join(f'<td class="text">{cell}</td>' for cell in ("environment.particles", "100", "lite"))
    assert page.count("data:image/png") == 3 and cells in page
    assert "environment.dtype</td>" not in page and f"torchmpm {torchmpm.__version__}" in page
    assert (folder / "poster.png").stat().st_size > 1000 and (folder / "replay.html").stat().st_size > 10_000
    command = html.unescape(re.sub("</?span>", "", re.search("<pre>(<span>python<.*)</pre>", page)[1]))
    again = parse(train.PROGRAM, shlex.split(command)[3:]).run
    assert to_json(again) == json.loads((folder / "config.json").read_text(), object_hook=with_tuples)


def with_tuples(values):
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


def test_a_run_that_failed_before_its_first_checkpoint_does_not_block_its_folder(tmp_path, capsys):
    def fail():
        raise OSError("no space left on device")

    options = "--steps 40 --handover 20 --eval-every 0 --eval-episodes 1".split()
    with at_step(14, fail):
        assert run(tmp_path / "run", *options) == 1
    assert [row["step"] for row in read_table(tmp_path / "run" / "progress.csv")] == ["10"]
    assert run(tmp_path / "run", *options) == 0
    assert "holds no checkpoint: starting from the beginning" in capsys.readouterr().out
    assert [row["step"] for row in read_table(tmp_path / "run" / "progress.csv")] == ["10", "20", "30", "40"]
    assert run(tmp_path / "run", *options) == 2
    assert "already holds a run" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "run" / "checkpoint")  # a finished run is not started anew
    assert run(tmp_path / "run", "--resume", *options) == 2
    assert "the run is finished, but its checkpoint is missing" in capsys.readouterr().err
