"""Every algorithm by the command lines and by stable-baselines3, on a robot that moves one substep at a time."""

import csv
import json
import signal

import numpy as np
import pytest
import torch
from policy_files import save_actor
from watching import at_step, interrupt

import baselines
import dittogym
from baselines import OpenLoop, train
from baselines.registry import configure, find, sees
from cfp import evaluate, robustness
from cfp.agent.actor import build_actor
from cfp.config import to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.callbacks import RunCallback
from cfp.policy import describe_run, read_policy
from cfp.presets import sac_preset
from cfp.tables import read_table
from dittogym.render.recording import attached

pytestmark = pytest.mark.usefixtures("short")

COMMON = "--particles 100 --substeps 1 --eval-episodes 2 --no-video --device cpu".split()
REWARDS = (
    "--num-envs 2 --steps 40 --random-steps 8 --batch-size 4 --buffer-size 60 --update-start 8 --gradient-steps 1 "
    "--eval-every 20 --checkpoint-every 10 --log-every 10"
)
WINDOWS = (
    "--train-particles 100 --num-envs 2 --steps 48 --window 6 --critic-updates 2 --eval-every 24 --checkpoint-every 12 "
    "--log-every 12"
)
PLANNED = "--grid 8 --horizon 3 --commit 2 --eval-every 3 --checkpoint-every 2 --log-every 2"
#: How tables name a policy that is made for one start.
PLANNED_ROWS = ["plan", "plan, replayed from another start"]
# A tiny run of each algorithm: options, a step at which it is stopped, its policies.
TINY = {
    "cfp-analytic": (
        f"{WINDOWS} --handover 0.5 --resolutions 4 8 --minibatches 2 --minibatch-size 8",
        36,
        ["stage 1", "stage 2"],
    ),
    "cfp-sac": (f"{REWARDS} --resolutions 4 8 --handover 0.5 --random-steps 8 4", 34, ["stage 1", "stage 2"]),
    "coarse": (f"{REWARDS} --resolutions 8", 34, ["stage 1"]),
    "fine": (f"{REWARDS} --resolutions 8", 34, ["stage 1"]),
    "gnn-16": (REWARDS, 34, ["stage 1"]),
    "gnn-64": (REWARDS, 34, ["stage 1"]),
    "transformer-16": (REWARDS, 34, ["stage 1"]),
    "transformer-64": (REWARDS, 34, ["stage 1"]),
    "distill": (
        "--num-envs 2 --train-particles 100 --resolutions 4 8 --steps 40 --handover 0.5 --rollout-steps 5 --updates 2 "
        "--batch-size 4 --eval-every 20 --checkpoint-every 10 --log-every 10",
        34,
        ["stage 1", "stage 2"],
    ),
    "gradient": (
        "--iterations 3 --grid 4 --train-particles 100 --polish 2 --polish-grid 8 "
        "--eval-every 16 --checkpoint-every 8 --log-every 8",
        32,
        ["stage 1", *PLANNED_ROWS],
    ),
    "mpc": (f"{PLANNED} --iterations 1 --train-particles 60", 5, PLANNED_ROWS),
    "cem": (f"{PLANNED} --iterations 2 --candidates 5 --elites 2", 5, PLANNED_ROWS),
    "shac": (f"{WINDOWS} --grid 8 --max-episode-steps 6", 36, ["stage 1"]),
}
#: The same programs as gnn-16 and coarse, with more segments, other networks and another grid.
LARGE = {"gnn-64", "transformer-16", "transformer-64", "fine"}
#: The same programs as cfp-sac and mpc, with a single stage and another planner.
ALIKE = {"coarse", "cem"}
#: Algorithms whose policies are those of the coarse-to-fine method.
LEVELS = ("cfp-analytic", "cfp-sac", "coarse", "distill", "fine")


def options_of(algo, folder):
    """Command-line options of a tiny run in a folder, beside which a distillation finds its teacher."""
    options = [*COMMON, "--algo", algo, *TINY[algo][0].split(), "--out", str(folder)]
    return [*options, "--teacher", str(save_teacher(folder.parent))] if algo == "distill" else options


def save_teacher(folder):
    """Write a sequence of actions for the tiny robot; returns its file."""
    path = folder / "teacher.safetensors"
    config = configure({"algo": "gradient", "task": "shapematch", "particles": 100, "substeps": 1})
    actions = 2.0 * torch.rand(30, 2, 4, 4, generator=torch.Generator().manual_seed(0)) - 1.0
    OpenLoop(actions, describe_run(config, "gradient", 1, 0) | {"layout": 0}).save(path)
    return path


def run(algo, folder, *more):
    return train.main([*options_of(algo, folder), *more])


def test_every_algorithm_is_tried_here():
    assert set(TINY) == set(baselines.ALGORITHMS)


def algorithms(slow):
    return [pytest.param(algo, marks=[pytest.mark.slow] * (algo in slow)) for algo in TINY]


@pytest.fixture(scope="module", params=algorithms(slow=LARGE))
def finished(request, tmp_path_factory, short):
    folder = tmp_path_factory.mktemp(request.param) / "whole"
    assert run(request.param, folder) == 0
    return request.param, folder


def test_run_leaves_its_files(finished):
    algo, folder = finished
    for name in ("results.json", "curve.png", "policy.safetensors", "index.html"):
        assert (folder / name).stat().st_size > 0, name
    assert json.loads((folder / "config.json").read_text())["algo"] == algo
    assert json.loads((folder / "policy.json").read_text())["kind"] == ("cfp" if algo in LEVELS else algo)
    stages = {str(1 + number) for number in range(len({*TINY[algo][2]} - {"plan"}))}
    assert {row["stage"] for row in read_table(folder / "progress.csv")} == stages
    assert {row["stage"] for row in read_table(folder / "evaluations.csv")} == stages
    rows = json.loads((folder / "results.json").read_text())
    assert [row["policy"] for row in rows] == ["zero action", "random action", *TINY[algo][2]]


def test_policy_is_loaded_by_its_kind_and_evaluated(finished, tmp_path, capsys):
    algo, folder = finished
    images, policy = np.zeros((3, 3, 64, 64), np.uint8), baselines.load(folder)
    env = dittogym.TorchEnv("shapematch", 3, policy.resolution, particles=100)
    env.reset(seed=0)
    policy = attached(policy, env)
    actions, _ = policy.predict(images, None, np.ones(3, bool), True)
    assert actions.shape == (3, 2, policy.resolution, policy.resolution) == policy.predict(images)[0].shape
    size = 64 if algo.startswith(("gnn", "transformer")) else 8
    assert policy.description["resolution"] == size and policy.description["task"] == "shapematch"
    capsys.readouterr()
    words = ["--episodes", "2", "--json", "--device", "cpu", "--replay", str(tmp_path / "replay.html")]
    assert evaluate.main([str(folder), *words]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((folder / "results.json").read_text())
    assert "<!doctype html>" in (tmp_path / "replay.html").read_text()[:100].lower()


@pytest.mark.parametrize("finished", algorithms(slow=LARGE | ALIKE), indirect=True)
def test_stopped_run_goes_on_as_if_nothing_had_happened(finished, tmp_path, capsys):
    algo, whole = finished
    folder = tmp_path / "stopped"
    with at_step(TINY[algo][1], interrupt):
        assert run(algo, folder) == 128 + signal.SIGINT
    assert "python -m baselines.train --resume" in capsys.readouterr().out
    assert train.main(["--out", str(folder), "--resume"]) == 0
    for name in ("results.json", "evaluations.csv"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
    weights, wanted = (read_policy(place)[0] for place in (folder, whole))
    assert all(torch.equal(weights[name], value) for name, value in wanted.items())
    steps = [[row["step"] for row in read_table(place / "progress.csv")] for place in (folder, whole)]
    assert steps[0] == steps[1]


@pytest.mark.parametrize("finished", algorithms(slow=set(TINY) - {"cfp-sac", "gradient", "gnn-16"}), indirect=True)
def test_robustness_is_reported_whatever_trained_it(finished, tmp_path, monkeypatch):
    _, folder = finished
    monkeypatch.setattr(robustness, "check_trained_for", lambda *_: None)  # steps of one substep are quick to train
    words = "--episodes 1 --full 0 --disturbed 1 --cases action latency --device cpu".split()
    assert robustness.main([str(folder), *words, "--rows", str(tmp_path / "rows.csv")]) == 0
    with (tmp_path / "rows.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["policy"] == folder.name]
    assert [row["case"] for row in rows] == ["undisturbed", "action dropout", "latency", "action noise"]


@pytest.mark.parametrize("finished", ["gradient"], indirect=True)
def test_polish_is_evaluated_on_the_layout_it_is_made_for(finished):
    rows = [row for row in read_table(finished[1] / "evaluations.csv") if row["stage"] == "2"]
    assert {row["episodes"] for row in rows} == {"1"}
    own = json.loads((finished[1] / "results.json").read_text())[-2]
    assert own["policy"] == "plan" and own["returns"] == [
        pytest.approx(max(float(row["mean"]) for row in rows), abs=1e-3)
    ]
    assert baselines.load(finished[1]).description["layout"] == 0


@pytest.mark.parametrize("finished", ["cem"], indirect=True)
def test_fit_is_the_command_line(finished, tmp_path):
    names = ("grid", "horizon", "commit", "iterations", "candidates", "elites", "eval_every", "checkpoint_every")
    options = dict(zip((*names, "log_every"), (8, 3, 2, 2, 5, 2, 3, 2, 2), strict=True))
    options |= {"particles": 100, "substeps": 1, "eval_episodes": 2, "video": False, "device": "cpu"}
    fitted = baselines.fit("cem", "shapematch", out=tmp_path / "python", **options)
    assert fitted.policy.description["kind"] == "cem" and [row["policy"] for row in fitted.results[2:]] == PLANNED_ROWS
    for name in ("config.json", "evaluations.csv", "results.json"):
        assert (fitted.folder / name).read_bytes() == (finished[1] / name).read_bytes(), name
    with pytest.raises(ConfigError, match="algo must be 'cem'"):
        baselines.fit("gnn-16", "shapematch", out=fitted.folder, resume=True)


def test_last_evaluation_that_a_crash_prevented_is_made_up_for(tmp_path, monkeypatch):
    """The policy is the newest, not the best: as long as the episode, whatever its evaluations were."""
    act = RunCallback._evaluate

    def crash(callback):
        if callback.stage.step == 8:
            raise RuntimeError("killed")
        act(callback)

    monkeypatch.setattr(RunCallback, "_evaluate", crash)
    with pytest.raises(RuntimeError, match="killed"):
        run("mpc", tmp_path)
    monkeypatch.undo()
    assert train.main(["--out", str(tmp_path), "--resume"]) == 0
    assert [row["step"] for row in read_table(tmp_path / "evaluations.csv")] == ["3", "6", "8"]
    assert len(baselines.load(tmp_path).actions) == json.loads((tmp_path / "policy.json").read_text())["steps"] == 8


def test_policy_that_a_run_starts_from_is_evaluated_first_and_once(tmp_path):
    """Also if the run goes on when the policy is no longer there."""
    config = configure({"algo": "coarse", "resolutions": [8], "substeps": 1, "encoder": "paper"})
    start = tmp_path / "start.safetensors"
    save_actor(start, build_actor(config.actor_spec(1)), config, 1, 5)
    words = ["--refine", "--start-from", str(start), "--resolutions", "8", "--steps", "24", "--eval-every", "24"]
    with at_step(12, interrupt):
        assert run("cfp-analytic", tmp_path / "run", *words, "--warmup", "0") == 128 + signal.SIGINT
    assert baselines.load(tmp_path / "run").description["steps"] == 0
    start.unlink()
    assert train.main(["--out", str(tmp_path / "run"), "--resume"]) == 0
    rows = read_table(tmp_path / "run" / "evaluations.csv")
    assert [row["step"] for row in rows] == ["0", "24"]
    best = max(rows, key=lambda row: float(row["mean"]))
    assert baselines.load(tmp_path / "run").description["steps"] == int(best["step"])


SHAC = {"train_particles": 100, "num_envs": 2, "window": 4, "critic_updates": 1, "grid": 8}
SAC = {"num_envs": 2, "batch_size": 4, "buffer_size": 60, "update_start": 8}
CONFORMS = {
    "shac": SHAC,
    "coarse": SAC | {"resolutions": [8], "random_steps": [4]},
    "gnn-16": SAC | {"random_steps": 4},
    "distill": {
        **{"num_envs": 2, "train_particles": 100, "resolutions": [8]},
        **{"rollout_steps": 4, "updates": 1, "batch_size": 4},
    },
}


@pytest.mark.parametrize("name", CONFORMS)
def test_algorithm_is_one_of_stable_baselines3(name, tmp_path):
    own = CONFORMS[name] | ({"teacher": str(save_teacher(tmp_path))} if name == "distill" else {})
    config = configure({"algo": name, "particles": 100, "substeps": 1, "device": "cpu", **own})
    model = find(name).create(config, 1, tmp_path)
    calls = []
    model.learn(100, lambda *_: calls.append("of all robots") or len(calls) < 5)
    assert len(calls) == 5 and model.num_timesteps == 10
    model.learn(16)
    assert model.num_timesteps == 16
    env = model.get_env()
    images = env.reset()
    actions = model.predict(images, deterministic=True)[0]
    assert actions.shape == (2, *env.action_space.shape) and np.abs(actions).max() > 0
    model.save(tmp_path / "model.zip")
    if name not in ("shac", "gnn-16"):  # which act on the state
        assert np.array_equal(type(model).load(tmp_path / "model.zip").predict(images, deterministic=True)[0], actions)
    again = type(model).load(tmp_path / "model.zip", env=env)
    images = env.reset()
    assert np.array_equal(*(each.predict(images, deterministic=True)[0] for each in (model, again)))
    assert again.learn(8, reset_num_timesteps=False).num_timesteps == 24


def test_what_acts_without_looking_is_said_to_see_nothing():
    names = (*baselines.ALGORITHMS, "zero", "random", "scripted")
    assert {name for name in names if sees(name) == "nothing"} == {"gradient", "zero", "random", "scripted"}


@pytest.mark.parametrize("preset", ["quick", "long", "paper"])
@pytest.mark.parametrize("task", dittogym.TASKS)
def test_presets_are_valid_survive_json_and_agree(task, preset):
    own = sac_preset(task, preset)
    for name in baselines.ALGORITHMS:
        values = {"algo": name, "task": task, "preset": preset}
        if preset not in find(name).presets:
            with pytest.raises(ConfigError, match="preset"):
                configure(values)
            continue
        config = configure(values)
        config.check()
        assert configure(json.loads(json.dumps(to_json(config)))) == config, name
        if name in ("cfp-analytic", "cfp-sac"):
            stages = range(1, len(config.resolutions) + 1)
            assert sum(config.stage_steps(stage) for stage in stages) == config.steps
            assert [config.actor_spec(stage).resolutions[-1] for stage in stages] == list(config.resolutions)
        if find(name).sees in ("image", "state"):  # the others have no noise
            assert config.eval_deterministic == own.eval_deterministic, name
        if isinstance(config, type(own)) or name.startswith(("gnn", "transformer")):
            assert (config.environment, config.steps, config.gamma) == (own.environment, own.steps, own.gamma)
            wanted, found = (each.hyperparameters(1) for each in (own, config))
            for option in ("alpha", "random_steps"):
                assert getattr(found, option) == getattr(wanted, option), option
            most = wanted.actor_start if name in LEVELS else 800
            assert found.actor_start == min(most, wanted.actor_start)
        if name in ("coarse", "fine"):
            assert config.resolutions == (own.resolutions[0 if name == "coarse" else -1],)
            with pytest.raises(ConfigError, match="resolutions"):
                configure(values | {"resolutions": [4, 8], "handover": [0.5]}).check()


ACTIONS = torch.arange(3 * 2 * 4 * 4).reshape(3, 2, 4, 4) / 100.0


def test_open_loop_plays_from_the_beginning_of_each_episode():
    policy, images = OpenLoop(ACTIONS), np.zeros((2, 3, 64, 64), np.uint8)
    memory, played = None, []
    for starts in ([True, True], [False, True], [False, False], [False, False]):
        actions, memory = policy.predict(images, memory, np.array(starts))
        played.append(actions)
    expected = np.concatenate((ACTIONS.numpy(), np.zeros((1, 2, 4, 4))))
    np.testing.assert_array_equal(played, expected[[[0, 0], [1, 0], [2, 1], [3, 2]]])
    assert memory[0].tolist() == [4, 3]
    assert np.array_equal(policy.predict(images[0])[0], ACTIONS[0].numpy())


def test_open_loop_goes_through_its_file(tmp_path):
    description = describe_run(configure({"algo": "gradient", "task": "run"}), "gradient", 1, 0)
    OpenLoop(ACTIONS, description).save(tmp_path / "policy.safetensors")
    again = baselines.load(tmp_path)
    assert torch.equal(again.actions, ACTIONS) and again.description == description
    OpenLoop(ACTIONS, description | {"kind": "cfp"}).save(tmp_path / "policy.safetensors")
    with pytest.raises(CheckpointError, match="weights and description do not match"):
        baselines.load(tmp_path)  # says that it is an actor
    with pytest.raises(ValueError, match="actions must have shape"):
        OpenLoop(torch.zeros(3, 2, 4, 5))
