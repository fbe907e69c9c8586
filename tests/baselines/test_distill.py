"""Distillation into the image networks, on robots of a few hundred particles."""

import json
from dataclasses import replace

import pytest
import torch
from updates import EachUpdate

import baselines
import cfp
import cfp.train
from baselines import Distill, GradientPlannerConfig, OpenLoop, Shac, distill
from baselines.compare.final_evaluation import Protocol
from baselines.compare.jobs import Job
from baselines.compare.results import read_result
from baselines.compare.worker import train
from baselines.distillation.dagger import Collector, Dataset, Labels, drop_entries
from baselines.distillation.teachers import PolicyTeacher, Teacher, project, read_teacher
from baselines.distillation.train import METRICS
from baselines.modular import env as modular_env
from baselines.modular.networks import ModularActor, SegmentPolicy
from baselines.modular.nodes import Nodes
from baselines.registry import configure
from cfp.analytic.episodes import Episodes
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.process import StopSignals
from cfp.policy import describe_run, read_policy, write_policy
from cfp.sections import EnvironmentConfig, ReportConfig
from cfp.tables import read_table
from dittogym import TorchEnv
from dittogym.action import patch_field, to_grid_layout


def make(**changes):
    environment = EnvironmentConfig(changes.pop("num_envs", 2), 300, changes.pop("substeps", 4))
    defaults = {"environment": environment, "train_particles": 300, "device": "cpu", "teacher": "mpc", "batch_size": 8}
    defaults |= {
        "rollout_steps": 4,
        "updates": 2,
        "switch_every": 2,
        "resolutions": (8, 16),
        "planner": GradientPlannerConfig(2, 2, 1),
    }
    return replace(Distill.preset("run", "quick"), **defaults | changes)


@pytest.fixture(scope="module")
def privileged(tmp_path_factory):
    """Untrained policies of the state, on file, by task."""
    paths = {task: tmp_path_factory.mktemp(task) / "policy.safetensors" for task in ("run", "shapematch")}
    for task, path in paths.items():
        config = replace(Shac.preset(task, "quick"), environment=EnvironmentConfig(2, 300, 4), train_particles=300)
        Shac(config).save_policy(path, describe_run(config, "shac", 1, 0))
    return paths


@pytest.fixture(scope="module")
def segments(tmp_path_factory):
    """An untrained policy of segments, on file."""
    path = tmp_path_factory.mktemp("segments") / "policy.safetensors"
    config = configure({"algo": "gnn-16", "task": "run", "environment": {"particles": 300, "substeps": 4}})
    SegmentPolicy(ModularActor("gnn", 10), Nodes(16, True), describe_run(config, "gnn-16", 1, 0)).save(path)
    return path


def test_how_a_policy_is_evaluated_does_not_change_what_it_learns():
    def learned(quiet, **changes):
        config = make(beta_decay=0.0, **changes)
        student = Distill(replace(config, report=replace(config.report, eval_deterministic=quiet)))
        student.learn(16)  # the student leads in the second round
        return torch.nn.utils.parameters_to_vector(student.actor.parameters()).detach()

    assert torch.equal(learned(False), learned(True))
    assert not torch.equal(learned(True), learned(True, student_noise=False))
    assert Distill.preset("shapematch", "quick").student_noise
    assert not Distill.preset("shapematch", "paper").student_noise  # which is evaluated without noise


class Mirror(Teacher):
    """Pulls where the image shows matter, by image alone: what a student can copy."""

    def act(self, env, seen):
        """Actions of +-0.6 by the speed that is seen."""
        there = torch.nn.functional.avg_pool2d(seen[:, :1].float() / 255.0, 8)
        return torch.cat((0.8 * there - 0.4, 0.4 - 0.8 * there), 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"beta_decay": 1.5}, "beta_decay must be between 0 and 1, got 1.5"),
        ({"dropout": -0.1}, "dropout must be between 0 and 1, got -0.1"),
        ({"updates": 0}, "updates must be at least 1, got 0"),
        ({"student_learning_rate": 0.0}, "student_learning_rate must be positive, got 0.0"),
        ({"gate_bias": ()}, "gate_bias must have 1 values"),
        ({"rollout_steps": 90_000}, "steps and handover must give every stage at least"),
    ],
)
def test_impossible_options_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        make(**changes).check()


def test_faults_hit_half_of_what_they_may() -> None:
    torch.manual_seed(0)
    values = torch.full((400, 3, 16, 16), 7, dtype=torch.uint8)
    left = (drop_entries(values, 0.2) == 7).float().flatten(1).mean(1)
    whole = left == 1.0
    assert 0.4 < whole.float().mean() < 0.6
    assert left[~whole].mean() == pytest.approx(0.8, abs=0.01)
    assert bool((values == 7).all()) and drop_entries(values, 0.0) is values


def test_actions_are_lost_on_the_grid_on_which_the_student_decides() -> None:
    env, taken = TorchEnv("run", 2, 64, particles=100, substeps=1), []
    collector, step = Collector(Mirror(), Episodes(env, 0, 20, 3), 2, dropout=0.5, grid=16), env.step
    env.step = lambda action: taken.append(action) or step(action)
    collector.collect(8, 0.0, lambda seen: torch.ones(2, 2, 64, 64))
    cells = torch.cat(taken).unflatten(3, (16, 4)).unflatten(2, (16, 4)).transpose(3, 4).flatten(4)
    assert (cells == cells[..., :1]).all() and 0.1 < (cells == 0).float().mean() < 0.4


def test_student_meets_faults_and_labels_do_not() -> None:
    config = make(num_envs=2, substeps=5, rollout_steps=8, steps=64, handover=(32,))
    rounds = {}
    for share in (0.0, 0.9):
        student = Distill(replace(config, dropout=share, beta_decay=0.0))
        student.collector.teacher = Mirror()
        looks = []
        with torch.random.fork_rng():
            torch.manual_seed(1)
            labels = student.collector.collect(
                8, 0.0, lambda seen, looks=looks: (looks.append(seen), seen[:, 1:, ::8, ::8] / 255)[1]
            )
        rounds[share] = labels, torch.cat(looks)
    (clean, seen), (faulty, blind) = rounds[0.0], rounds[0.9]
    assert torch.equal(clean.observations[:2], faulty.observations[:2]) and torch.equal(clean.observations, seen)
    assert (blind == 0).float().mean() > (seen == 0).float().mean() + 0.2
    assert not torch.equal(faulty.observations, clean.observations), "lost actions lead elsewhere"
    assert torch.equal(faulty.actions, Mirror().act(student.env, faulty.observations))


def test_student_does_as_the_teacher_in_a_closed_loop():
    config = make(num_envs=4, substeps=20, rollout_steps=16, updates=20, batch_size=16, steps=384, handover=(256,))
    student, rows = Distill(config), []
    student.collector.teacher = Mirror()
    student.learn(256, EachUpdate(rows.append))
    assert set(rows[0]) == set(METRICS)
    assert rows[-1]["train/fresh_loss"] < 0.05 * rows[0]["train/fresh_loss"]
    assert [row["train/beta"] for row in rows[:3]] == pytest.approx([1.0, 0.7, 0.49])
    fine = Distill(config, 2, student.policy)
    fine.collector.teacher = Mirror()
    fine.learn(128, EachUpdate(rows.append))
    frozen, before = fine.actor.get_submodule("coarse").state_dict(), student.actor.state_dict()
    assert all(torch.equal(frozen[name], value) for name, value in before.items())
    for policy in (student.policy, fine.policy):
        env = TorchEnv("run", 2, policy.resolution, particles=300, substeps=20)
        seen, _ = env.reset(seed=99)
        for _ in range(20):
            action, _ = policy.predict(seen.numpy(), deterministic=True)
            wanted = project(Mirror().act(env, seen), policy.resolution, 64)
            assert (torch.as_tensor(action) - wanted).square().mean().sqrt() < 0.06
            seen = env.step(torch.as_tensor(action))[0]


@pytest.mark.parametrize(("kind", "stage"), [("mpc", 1), ("privileged", 2), ("segments", 1)])
def test_resumed_distillation_is_the_same_to_the_last_bit(kind, stage, privileged, segments):
    teacher = {"mpc": "mpc", "privileged": str(privileged["run"]), "segments": str(segments)}[kind]
    config = make(teacher=teacher, max_episode_steps=6, planner=GradientPlannerConfig(3, 3, 1))
    start = Distill(config).policy if stage > 1 else None
    whole, first, second = (Distill(config, stage, start) for _ in range(3))
    whole.learn(32)
    first.learn(16)
    second.load_state_dict(first.state_dict())
    second.num_timesteps = first.num_timesteps
    second.learn(16)
    for name, value in whole.actor.state_dict().items():
        assert torch.equal(value, second.actor.state_dict()[name]), name
    assert torch.equal(whole.env.state.x, second.env.state.x)
    for mine, theirs in zip(whole.dataset.rounds, second.dataset.rounds, strict=True):
        assert torch.equal(mine.observations, theirs.observations) and torch.equal(mine.actions, theirs.actions)


def test_teacher_remembers_its_segments_as_long_as_an_episode_lasts(segments, monkeypatch):
    anew, fit = [], modular_env.fit
    monkeypatch.setattr(modular_env, "fit", lambda x, count: anew.append(len(x)) or fit(x, count))
    Distill(make(teacher=str(segments), max_episode_steps=6)).learn(32)
    assert sum(anew) == 5, "of 16 steps: the first robot begins anew after 3, 9 and 15, the second after 6 and 12"


class Scripted(Teacher):
    """Looks only every third step; answers the number of the call."""

    def __init__(self):
        self.calls = -1

    def act(self, env, seen):
        """A constant action."""
        self.calls += 1
        self.fresh = self.calls % 3 == 0
        return torch.full((env.num_envs, 2, 4, 4), self.calls / 10)


# Robot 0 is cut after calls 0, 2 and 4, robot 1 after 1, 3 and 5; each then waits for the next look.
@pytest.mark.parametrize(("share", "expected"), [(1.0, [0, 0, 1, 3, 3, 4]), (0.0, [0, 0, 3, 3])])
def test_labels_count_only_where_the_teacher_looked_or_led(share, expected):
    env = TorchEnv("run", 2, 64, particles=100, substeps=1)
    collector = Collector(Scripted(), Episodes(env, 0, 2, 3), 3)  # the first robot begins anew after one step
    labels = collector.collect(6, share, lambda seen: torch.zeros(2, 2, 8, 8))
    given = (10 * labels.actions[:, 0, 0, 0]).round().int().tolist()
    assert sorted(given) == expected


def test_labels_are_dropped_oldest_first_and_survive_a_checkpoint():
    dataset = Dataset(10)
    for index in range(4):
        images = torch.full((4, 3, 64, 64), index, dtype=torch.uint8)
        dataset.add(Labels(images, torch.full((4, 2, 8, 8), float(index))))
        dataset.add(Labels(images[:0], torch.zeros(0, 2, 8, 8)))
    assert len(dataset) == 8
    copy = Dataset(10)
    copy.load_state_dict(dataset.state_dict())
    for data in (dataset, copy):
        torch.manual_seed(0)
        images, actions = data.sample(200)
        assert sorted(set(actions[:, 0, 0, 0].tolist())) == [2.0, 3.0]
        assert torch.equal(images[:, 0, 0, 0].float(), actions[:, 0, 0, 0])


def test_round_without_labels_has_no_fresh_loss():
    student, rows = Distill(make()), []
    student.learn(8, EachUpdate(rows.append))
    nothing = Labels(torch.zeros(0, 3, 64, 64, dtype=torch.uint8), torch.zeros(0, 2, 8, 8))
    student.collector.collect = lambda *_: nothing
    student.learn(8, EachUpdate(rows.append))
    assert rows[0]["train/fresh_loss"] > 0 and rows[-1]["train/fresh_loss"] is None
    assert rows[-1]["train/labels"] == rows[-2]["train/labels"] and rows[-1]["train/loss"] > 0


@pytest.mark.parametrize(("given", "wanted"), [(8, 8), (8, 16), (16, 8), (16, 64)])
def test_projected_action_drives_the_muscles_alike(given, wanted):
    action = 0.5 * torch.rand(3, 2, given, given).double() - 0.25
    found = project(action, wanted, 64)
    assert found.shape == (3, 2, wanted, wanted)
    field = lambda image: patch_field(image, 64, 1.0)  # noqa: E731
    error = (field(found) - field(action)).square().mean().sqrt()
    if wanted in (given, 64):
        assert error < 1e-12
    else:
        assert error < 0.3 * field(action).square().mean().sqrt() or wanted < given
        naive = torch.nn.functional.interpolate(action, (wanted, wanted), mode="bicubic", align_corners=False)
        assert error < (field(naive) - field(action)).square().mean().sqrt()


def test_action_of_the_other_layout_acts_at_the_same_place():
    record = OpenLoop(torch.rand(5, 2, 8, 8), {"environment": {"action_layout": "image"}})
    env = TorchEnv("run", 1, particles=100)
    env.reset(seed=0)
    seen = torch.zeros(1, 3, 64, 64, dtype=torch.uint8)
    action = PolicyTeacher(record, "image").act(env, seen)
    as_grid = PolicyTeacher(record, "grid").act(env, seen)
    assert torch.equal(as_grid, to_grid_layout(action, "image"))
    record.description["environment"] = {"action_layout": "grid"}
    back = PolicyTeacher(record, "image").act(env, seen)
    assert torch.equal(to_grid_layout(back, "image"), action)


def test_sequence_teaches_by_the_step_of_the_episode():
    record = OpenLoop(torch.linspace(0, 0.9, 10)[:, None, None, None].expand(10, 2, 8, 8))
    env = TorchEnv("run", 3, particles=100, substeps=1)
    seen, _ = env.reset(seed=0)
    env.env_state = replace(env.env_state, steps=torch.tensor([0, 4, 20]))
    action = PolicyTeacher(record, "image").act(env, seen)
    assert action[:, 0, 0, 0].tolist() == pytest.approx([0.0, 0.4, 0.0])


def test_loss_that_is_not_finite_ends_the_training():
    student = Distill(make())
    with torch.no_grad():
        next(student.actor.parameters()).fill_(float("nan"))
    student.collector.collect = lambda *_: Labels(torch.zeros(8, 3, 64, 64, dtype=torch.uint8), torch.zeros(8, 2, 8, 8))
    with pytest.raises(NonFiniteError, match="loss became nan"):
        student.learn(8)


TINY = (
    "--task shapematch --particles 100 --substeps 4 --num-envs 2 --resolutions 4 8 --eval-episodes 2 "
    "--no-video --device cpu --checkpoint-every 20"
).split()
LESSONS = (
    "--train-particles 100 --steps 32 --handover 16 --rollout-steps 4 --updates 2 --batch-size 4 --eval-every 0".split()
)


def test_privileged_policy_becomes_one_of_images_that_cfp_refines(privileged, tmp_path, capsys):
    folder = tmp_path / "distilled"
    assert distill.main([*TINY, *LESSONS, "--teacher", str(privileged["shapematch"]), "--out", str(folder)]) == 0
    assert read_policy(folder / "teacher.safetensors")[1] == read_policy(privileged["shapematch"])[1]
    policy = cfp.load(folder)
    assert policy.description["trained_by"] == "distill" and policy.spec.resolutions == (4, 8)
    std = policy.actor.std(torch.zeros(1, 32, 4, 4))
    assert torch.nn.functional.softplus(3 * std - 1).mean() == pytest.approx(0.105, abs=1e-3)
    options = "--steps 24 --handover 12 --batch-size 4 --update-start 8 --actor-start 6 --eval-every 12".split()
    grids = TINY.index("--resolutions")
    refined = [*TINY[:grids], *TINY[grids + 3 :], *options, "--learner", "sac", "--refine", "--start-from", str(folder)]
    assert cfp.train.main([*refined, "--out", str(tmp_path / "refined")]) == 0
    first = read_table(tmp_path / "refined" / "evaluations.csv")[0]
    assert (first["step"], first["stage"]) == ("12", "2")
    refined_policy = cfp.load(tmp_path / "refined")
    assert refined_policy.description["task"] == "shapematch" and refined_policy.spec.resolutions == (4, 8)
    assert baselines.load(folder).spec == policy.spec
    capsys.readouterr()


def test_teacher_that_is_only_named_is_trained_first(tmp_path, monkeypatch, capsys):
    base = Shac.preset("shapematch", "quick")
    tiny = replace(base, steps=32, window=4, train_particles=100, environment=EnvironmentConfig(2, 100, 1))
    tiny = replace(tiny, report=ReportConfig(eval_every=0, eval_episodes=1, video=False))
    monkeypatch.setattr(Shac, "preset", staticmethod(lambda task, name: tiny))
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "teacher.safetensors").write_bytes(b"of an attempt with other options that left no checkpoint")
    assert distill.main([*TINY, *LESSONS, "--teacher", "shac", "--out", str(folder)]) == 0
    assert read_table(folder / "teacher" / "progress.csv")
    trained = (folder / "teacher" / "policy.safetensors").read_bytes()
    assert (folder / "teacher.safetensors").read_bytes() == trained
    capsys.readouterr()
    config = configure(json.loads((folder / "config.json").read_text()))
    job = Job("distill", config, tmp_path / "timed", Protocol(1))
    with StopSignals() as signals:
        train(job, signals, False)
    cost = read_result(job).cost
    assert (cost.steps, cost.last_step, cost.teacher_steps) == (32, 32, 32)
    assert cost.teacher_seconds > 0 and cost.seconds > 0.01


@pytest.mark.parametrize(
    ("task", "kind", "target", "message"),
    [
        ("shapematch", "gradient", "T", "teacher must be a policy for the target star, got T"),
        ("kick", "gradient", None, "teacher must be a policy for run, got one for kick"),
        ("run", "gradient", "T", "teacher: cannot compare its target"),
        (None, "", None, "teacher must be mpc, shac, gradient, catch, dig, grow, grow-success, kick, obstacle, run, "),
    ],
)
def test_teacher_that_does_not_fit_is_refused(tmp_path, capsys, task, kind, target, message):
    path = tmp_path / "policy.safetensors"
    if task:
        config = replace(Distill.preset(task, "quick"), environment=EnvironmentConfig(1, 100, 4, target=target))
        write_policy(path, {"actions": torch.zeros(3, 2, 8, 8)}, describe_run(config, kind, 1, 0))
    folder = tmp_path / "run"
    student = ["--target", "star"] if task == "shapematch" else ["--task", "run"]
    assert distill.main([*TINY, *LESSONS, *student, "--teacher", str(path), "--out", str(folder)]) == 2
    assert message in capsys.readouterr().err
    assert not folder.exists()


@pytest.mark.parametrize(("task", "alike"), [pytest.param("grow", True, marks=pytest.mark.slow), ("shapematch", False)])
def test_record_of_one_episode_teaches(tmp_path, capsys, task, alike):
    config = replace(Distill.preset(task, "quick"), environment=EnvironmentConfig(1, 100, 1))
    path, size = tmp_path / "record.safetensors", config.resolution(1)
    write_policy(path, {"actions": torch.ones(3, 2, size, size)}, describe_run(config, "mpc", 1, 0) | {"layout": 0})
    teacher = read_teacher(path, task, config.environment)
    assert isinstance(teacher, OpenLoop) and len(teacher.actions) == 3
    student = ["--task", task, "--teacher", str(path), "--substeps", "1"]
    assert distill.main([*TINY, *LESSONS, *student, "--out", str(tmp_path / "run")]) == 0
    remark = f"teacher: the record of one planned episode, while every episode of {task} starts differently"
    assert (remark in capsys.readouterr().out) != alike
