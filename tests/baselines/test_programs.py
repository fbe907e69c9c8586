"""The command lines with every algorithm, on a robot of a hundred particles that moves one substep at a time."""

import json
import signal

import numpy as np
import pytest
from policy_files import save_actor

import baselines
import cfp.evaluate
import cfp.robustness
import dittogym
from baselines import evaluate, replay, robustness, train
from baselines.registry import sees
from cfp.agent.actor import build_actor
from cfp.envs.disturbances import make_cases
from cfp.errors import ConfigError
from cfp.evaluation.returns import evaluate as play
from cfp.experiment.callbacks import EvaluationCallback
from cfp.experiment.training import parse
from cfp.policy import StatePolicy
from cfp.tables import read_table

pytestmark = pytest.mark.usefixtures("short")

COMMON = "--particles 100 --substeps 1 --eval-episodes 2 --no-video --device cpu".split()
MODULAR = (
    "--num-envs 2 --steps 60 --random-steps 10 --batch-size 4 --buffer-size 60 --update-start 8 --gradient-steps 1 "
    "--eval-every 20 --checkpoint-every 10 --log-every 10"
)
SINGLE = f"{MODULAR} --resolutions 8"
# A tiny run of each algorithm: options, a step at which it is stopped, its policies.
TINY = {
    "cfp": (
        f"{MODULAR} --resolutions 4 8 --handover 30 --random-steps 10 4",
        44,
        ["stage 1", "stage 2"],
    ),
    "coarse": (SINGLE, 44, ["stage 1"]),
    "fine": (SINGLE, 44, ["stage 1"]),
    "distill": (
        "--teacher mpc --planner-grid 4 --horizon 2 --commit 2 --iterations 1 --num-envs 2 --train-particles 100 "
        "--resolutions 4 8 --steps 60 --handover 30 --rollout-steps 5 --updates 2 --batch-size 4 --eval-every 20 "
        "--checkpoint-every 10 --log-every 10",
        50,
        ["stage 1", "stage 2"],
    ),
    "gradient": (
        "--iterations 5 --grid 4 --train-particles 100 --polish 3 --polish-grid 8 "
        "--eval-every 24 --checkpoint-every 8 --log-every 8",
        48,
        ["stage 1", "stage 2", "  own layout"],
    ),
    "mpc": (
        "--grid 8 --horizon 3 --commit 2 --iterations 1 --eval-every 3 --checkpoint-every 2 --log-every 2",
        5,
        ["stage 1", "  own layout"],
    ),
    "cem": (
        "--grid 8 --horizon 3 --commit 2 --iterations 2 --candidates 5 --elites 2 --eval-every 3 "
        "--checkpoint-every 2 --log-every 2",
        5,
        ["stage 1", "  own layout"],
    ),
    "shac": (
        "--train-particles 100 --num-envs 2 --steps 96 --window 6 --grid 8 --max-episode-steps 6 --critic-updates 2 "
        "--eval-every 48 --checkpoint-every 12 --log-every 24",
        60,
        ["stage 1"],
    ),
    "analytic": (
        "--train-particles 100 --num-envs 2 --steps 96 --handover 48 --window 6 --resolutions 4 8 --minibatches 2 "
        "--minibatch-size 8 --critic-updates 2 --eval-every 48 --checkpoint-every 12 --log-every 24",
        60,
        ["stage 1", "stage 2"],
    ),
    "gnn-16": (MODULAR, 44, ["stage 1"]),
    "gnn-64": (MODULAR, 44, ["stage 1"]),
    "transformer-16": (MODULAR, 44, ["stage 1"]),
    "transformer-64": (MODULAR, 44, ["stage 1"]),
}
#: Action grids that are not 8.
PATCHES = {algo: 64 for algo in TINY if "-" in algo}
#: Algorithms whose policies are those of ``cfp``.
LEVELS = ("analytic", "cfp", "coarse", "distill", "fine")


def run(algo, folder, *more):
    return train.main([*COMMON, "--algo", algo, *TINY[algo][0].split(), "--out", str(folder), *more])


def test_every_algorithm_is_tried_here():
    assert set(TINY) == set(baselines.ALGORITHMS)


#: The same programs as with 16 segments, and several times slower; and as coarse, with another grid.
LARGE = {"gnn-64", "transformer-64", "fine"}
#: The same programs as cfp, mpc and gnn-16, with a single stage, another planner and other networks.
ALIKE = {"coarse", "cem", "transformer-16"}


def algorithms(slow):
    return [pytest.param(algo, marks=[pytest.mark.slow] * (algo in slow)) for algo in TINY]


@pytest.fixture(scope="module", params=algorithms(slow=LARGE))
def finished(request, tmp_path_factory, short):
    folder = tmp_path_factory.mktemp(request.param) / "whole"
    assert run(request.param, folder) == 0
    return request.param, folder


def test_fit_is_the_command_line(tmp_path):
    assert run("cem", tmp_path / "command") == 0
    names = ("grid", "horizon", "commit", "iterations", "candidates", "elites", "eval_every", "checkpoint_every")
    options = dict(zip((*names, "log_every"), (8, 3, 2, 2, 5, 2, 3, 2, 2), strict=True))
    options |= {"particles": 100, "substeps": 1, "eval_episodes": 2, "video": False, "device": "cpu"}
    fitted = baselines.fit("cem", "shapematch", out=tmp_path / "python", **options)
    assert fitted.policy.description["kind"] == "cem" and fitted.results[-1]["policy"] == "  own layout"
    for name in ("config.json", "evaluations.csv", "results.json"):
        assert (fitted.folder / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    with pytest.raises(ConfigError, match=r"algo must be 'cem', that of the run in .* got 'gnn-16'"):
        baselines.fit("gnn16", "shapematch", out=fitted.folder, resume=True)


def test_run_leaves_its_files(finished):
    algo, folder = finished
    for name in ("results.json", "curve.png", "policy.safetensors", "policy.json"):
        assert (folder / name).stat().st_size > 0, name
    assert json.loads((folder / "config.json").read_text())["algo"] == algo
    assert json.loads((folder / "policy.json").read_text())["kind"] == ("cfp" if algo in LEVELS else algo)
    assert list((folder / "tensorboard").glob("events*"))
    stages = {name[-1] for name in TINY[algo][2] if name.startswith("stage")}
    assert {row["stage"] for row in read_table(folder / "progress.csv")} == stages
    assert {row["stage"] for row in read_table(folder / "evaluations.csv")} == stages
    assert {path.stem for path in folder.glob("stage?.json")} == {f"stage{stage}" for stage in sorted(stages)[:-1]}
    rows = json.loads((folder / "results.json").read_text())
    assert [row["policy"] for row in rows] == ["zero action", "random action", *TINY[algo][2]]


def test_policy_is_loaded_by_its_kind(finished):
    algo, folder = finished
    images = np.zeros((3, 3, 64, 64), np.uint8)
    policy = baselines.load(folder)
    if isinstance(policy, StatePolicy):
        env = dittogym.TorchEnv("shapematch", 3, policy.resolution, particles=100)
        env.reset(seed=0)
        policy = policy.attached(env)
    start = np.ones(3, bool)
    actions, _ = policy.predict(images, None, start, True)
    assert actions.shape == (3, 2, policy.resolution, policy.resolution) == policy.predict(images)[0].shape
    assert policy.description["resolution"] == PATCHES.get(algo, 8)
    assert policy.description["task"] == json.loads((folder / "config.json").read_text())["task"]


def test_folder_is_evaluated_whatever_trained_it(finished, capsys):
    algo, folder = finished
    capsys.readouterr()
    assert evaluate.main([str(folder), "--episodes", "2", "--json", "--device", "cpu"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((folder / "results.json").read_text())
    assert cfp.evaluate.main([str(folder), "--episodes", "1", "--device", "cpu"]) == (0 if algo == "cfp" else 2)
    if algo != "cfp":
        assert "baselines.evaluate and baselines.robustness run other algorithms" in capsys.readouterr().err


@pytest.mark.parametrize("finished", algorithms(slow=LARGE | ALIKE), indirect=True)
def test_stopped_run_goes_on_as_if_nothing_had_happened(finished, tmp_path, monkeypatch, capsys, stop_at):
    algo, whole = finished
    folder = tmp_path / "stopped"
    stop_at(TINY[algo][1])
    assert run(algo, folder) == 128 + signal.SIGINT
    assert "python -m baselines.train --resume" in capsys.readouterr().out
    monkeypatch.undo()
    assert train.main(["--out", str(folder), "--resume"]) == 0
    for name in ("results.json", "evaluations.csv"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
    steps = [[row["step"] for row in read_table(place / "progress.csv")] for place in (folder, whole)]
    assert steps[0] == steps[1]


def test_stop_in_the_last_step_leaves_a_whole_stage(tmp_path, stop_at):
    stop_at(8)
    assert run("mpc", tmp_path) == 128 + signal.SIGINT
    assert [row["step"] for row in read_table(tmp_path / "evaluations.csv")] == ["3", "6"]
    assert not (tmp_path / "results.json").exists()
    assert train.main(["--out", str(tmp_path), "--resume"]) == 0
    assert (tmp_path / "results.json").exists()
    assert [row["step"] for row in read_table(tmp_path / "evaluations.csv")] == ["3", "6", "8"]


def test_last_evaluation_that_a_crash_prevented_is_made_up_for(tmp_path, monkeypatch):
    act = EvaluationCallback._act

    def crash(callback):
        if callback.stage.step == 8:
            raise RuntimeError("killed")
        act(callback)

    monkeypatch.setattr(EvaluationCallback, "_act", crash)
    with pytest.raises(RuntimeError, match="killed"):
        run("mpc", tmp_path)
    monkeypatch.undo()
    assert train.main(["--out", str(tmp_path), "--resume"]) == 0
    assert [row["step"] for row in read_table(tmp_path / "evaluations.csv")] == ["3", "6", "8"]
    assert len(baselines.load(tmp_path).actions) == json.loads((tmp_path / "policy.json").read_text())["steps"]


def test_algorithm_is_asked_for_its_scalars_when_a_row_is_written(tmp_path, monkeypatch):
    asked, row = [], baselines.Shac.row
    monkeypatch.setattr(baselines.Shac, "row", lambda model: asked.append(model.num_timesteps) or row(model))
    assert run("shac", tmp_path) == 0
    assert asked == [24, 48, 72, 96] == [int(row["step"]) for row in read_table(tmp_path / "progress.csv")]


@pytest.mark.parametrize("step", [0, 12])
def test_policy_that_a_run_starts_from_is_evaluated_first_and_once(tmp_path, monkeypatch, stop_at, step):
    """Also if the run is stopped in that evaluation, and continues when the policy is no longer there."""
    config = baselines.registry.configure(
        {"algo": "coarse", "resolutions": [8], "environment": {"substeps": 1}, "network": {"encoder": "paper"}}
    )
    start = tmp_path / "start.safetensors"
    save_actor(start, build_actor(config.actor_spec(1)), config, 1, 5)
    words = ["--sees", "image", "--start-from", str(start), "--steps", "24", "--eval-every", "24"]
    stop_at(step or -1)
    if step == 0:

        def interrupted(*given, **named):
            signal.raise_signal(signal.SIGINT)
            return play(*given, **named)

        monkeypatch.setattr("cfp.experiment.callbacks.evaluate", interrupted)
    assert run("shac", tmp_path / "run", *words) == 128 + signal.SIGINT
    assert (tmp_path / "run" / "evaluations.csv").exists() == (step > 0)
    assert baselines.load(tmp_path / "run").description["steps"] == 0
    monkeypatch.undo()
    start.unlink()
    assert train.main(["--out", str(tmp_path / "run"), "--resume"]) == 0
    rows = read_table(tmp_path / "run" / "evaluations.csv")
    assert [row["step"] for row in rows] == ["0", "24"]
    best = max(rows, key=lambda row: float(row["mean"]))
    assert baselines.load(tmp_path / "run").description["steps"] == int(best["step"])


@pytest.mark.parametrize("finished", ["gnn-16"], indirect=True)
def test_episode_is_written_to_watch(finished, tmp_path, capsys):
    _, folder = finished
    page = tmp_path / "replay.html"
    assert replay.main([str(folder), "--out", str(page)]) == 0 and "<!doctype html>" in page.read_text()[:100].lower()
    assert capsys.readouterr().out == f"episode: {page}\n"
    assert replay.main([str(folder), "--out", "replay.txt"]) == 2
    assert "out must end in .html or .mp4" in capsys.readouterr().err


@pytest.mark.parametrize("algo", ["shac", "distill", "gradient"])
def test_new_particles_are_refused_where_the_seed_says_them(algo):
    with pytest.raises(ConfigError, match="resample requires soft actor-critic"):
        parse(train.PROGRAM, ["--algo", algo, "--resample"])
    assert parse(train.PROGRAM, ["--algo", "gnn-16", "--resample"]).run.environment.resample


@pytest.mark.parametrize("finished", ["gradient"], indirect=True)
def test_polish_is_evaluated_on_the_layout_it_is_made_for(finished):
    _, folder = finished
    rows = [row for row in read_table(folder / "evaluations.csv") if row["stage"] == "2"]
    assert {row["episodes"] for row in rows} == {"1"}
    own = json.loads((folder / "results.json").read_text())[-1]
    assert own["returns"] == [pytest.approx(max(float(row["mean"]) for row in rows), abs=1e-3)]
    assert baselines.load(folder).description["layout"] == 0


def test_what_acts_without_looking_is_said_to_see_nothing():
    names = (*baselines.ALGORITHMS, "zero", "random", "scripted")
    assert {name for name in names if sees(name) == "nothing"} == {"gradient", "zero", "random", "scripted"}


@pytest.mark.parametrize("algo", ["zero", "random", "scripted"])
def test_reference_policy_is_not_trained_and_the_error_says_how_to_evaluate_it(algo, capsys):
    assert train.main(["--algo", algo]) == 2
    assert f"torchmpm compare --algos {algo}" in capsys.readouterr().err


@pytest.mark.parametrize("given, name", [("gnn16", "gnn-16"), ("transformer64", "transformer-64"), ("cfp", "cfp")])
def test_algorithm_with_a_count_has_two_spellings(given, name):
    run = parse(train.PROGRAM, ["--algo", given, "--task", "run"]).run
    assert run.name == f"{name}-run-quick-0" and run == baselines.registry.configure({"algo": name, "task": "run"})


@pytest.mark.parametrize("finished", algorithms(slow=set(TINY) - {"cfp", "gradient", "gnn-16"}), indirect=True)
def test_robustness_is_reported_whatever_trained_it(finished, monkeypatch):
    _, folder = finished
    # Not all of them, which test_robustness.py plays.
    monkeypatch.setattr("cfp.robustness.make_cases", lambda *options: make_cases(*options)[:4])
    assert robustness.main([str(folder), "--episodes", "1", "--device", "cpu"]) == 0
    rows = json.loads((folder / "robustness.json").read_text())
    assert rows[0]["case"] == "unperturbed" and rows[0]["ratio"] in (1, None)
    assert {row["episodes"] for row in rows} == {1}
    assert baselines.load(folder).uses_image == any("observation" in row["case"] for row in rows)
