"""Distillation into the image networks, on robots of a few hundred particles."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional as F
from watching import learn

import cfp
import cfp.train
from baselines import Distill, OpenLoop, Shac, train
from baselines.distillation.learner import METRICS, Collector, Dataset, Labels, drop_entries
from baselines.distillation.teachers import Teacher, project
from baselines.modular.networks import ModularActor, SegmentPolicy
from baselines.modular.segments import Nodes
from baselines.registry import configure
from cfp.analytic.window import Episodes
from cfp.envs.make import make_env
from cfp.errors import NonFiniteError
from cfp.learner import copy_coarse_weights
from cfp.policy import describe_run, read_policy, write_policy
from cfp.resumable import Resumable
from cfp.tables import read_table
from dittogym import TorchEnv
from dittogym.action import patch_field, to_grid_layout

pytestmark = pytest.mark.usefixtures("short")  # SHAPE MATCH only


def options(**changes):
    defaults = {"num_envs": 2, "particles": 300, "substeps": 4, "train_particles": 300, "device": "cpu"}
    defaults |= {"resolutions": (8, 16), "encoder": "small", "rollout_steps": 4, "updates": 2, "batch_size": 8}
    return replace(Distill.preset("run", "quick"), **defaults | changes)


@pytest.fixture
def make(tmp_path):
    """Makes a student; unless one is given, its teacher is a sequence of actions."""

    def make(stage=1, **changes):
        config = options(**changes)
        if "teacher" not in changes:
            path = tmp_path / "sequence.safetensors"
            actions = 2.0 * torch.rand(30, 2, 4, 4, generator=torch.Generator().manual_seed(0)) - 1.0
            write_policy(path, {"actions": actions}, describe_run(config, "gradient", 1, 0) | {"layout": 0})
            config = replace(config, teacher=str(path))
        return Distill("NetworksPolicy", make_env(config.for_training(), 64), config, stage, "cpu")

    return make


class Mirror(Resumable):
    """A teacher that pulls where the image shows matter, by image alone: what a student can copy."""

    def act(self, env, observation):
        """Actions between -0.4 and 0.4."""
        there = F.avg_pool2d(observation[:, :1].float() / 255.0, 8)
        return torch.cat((0.8 * there - 0.4, 0.4 - 0.8 * there), 1)


def go_on(done, infos):
    return True


@pytest.fixture(scope="module")
def segments(tmp_path_factory):
    """An untrained policy of segments, on file."""
    path = tmp_path_factory.mktemp("segments") / "policy.safetensors"
    config = configure({"algo": "gnn-16", "task": "run", "particles": 300, "substeps": 4})
    SegmentPolicy(ModularActor("gnn", 10), Nodes(16, True), describe_run(config, "gnn-16", 1, 0)).save(path)
    return path


def test_how_a_policy_is_evaluated_does_not_change_what_it_learns(make):
    def learned(quiet, **changes):
        student = make(beta_decay=0.0, eval_deterministic=quiet, **changes)
        learn(student, 16)  # the student leads in the second round
        return torch.nn.utils.parameters_to_vector(student.actor.parameters()).detach()

    assert torch.equal(learned(False), learned(True))
    assert not torch.equal(learned(True), learned(True, student_noise=False))


def test_actions_are_lost_on_the_grid_on_which_the_student_decides():
    torch.manual_seed(0)  # which simulations lose entries is drawn
    env, taken = TorchEnv("run", 2, 64, particles=100, substeps=1), []
    collector, step = Collector(Mirror(), Episodes(env, 0, 20, 3), 2, dropout=0.5, grid=16), env.step
    env.step = lambda action: taken.append(action) or step(action)
    collector.collect(8, 0.0, lambda images: torch.ones(2, 2, 64, 64), go_on)
    cells = torch.cat(taken).unflatten(3, (16, 4)).unflatten(2, (16, 4)).transpose(3, 4).flatten(4)
    assert (cells == cells[..., :1]).all() and 0.1 < (cells == 0).float().mean() < 0.4


def test_student_meets_faults_and_labels_do_not(make):
    rounds = {}
    for share in (0.0, 0.9):
        student, looks = make(substeps=5, dropout=share), []
        student.collector.teacher = Mirror()

        def look(images, looks=looks):
            looks.append(images)
            return images[:, 1:, ::8, ::8] / 255

        torch.manual_seed(1)
        rounds[share] = student.collector.collect(8, 0.0, look, go_on), torch.cat(looks)
    (clean, seen), (faulty, blind) = rounds[0.0], rounds[0.9]
    assert torch.equal(clean.observations[:2], faulty.observations[:2]) and torch.equal(clean.observations, seen)
    assert (blind == 0).float().mean() > (seen == 0).float().mean() + 0.2
    assert not torch.equal(faulty.observations, clean.observations), "lost actions lead elsewhere"
    assert torch.equal(faulty.actions, Mirror().act(student.simulation, faulty.observations))


def test_student_learns_from_images_as_its_policy_will_see_them(make):
    """With missing pixels filled."""
    student = make(particles=2000)
    seen = drop_entries(student.simulation.observation(), 0.5)
    action, _ = student.trained_policy.predict(seen.numpy(), deterministic=True)
    loss = student.loss(seen, torch.from_numpy(action) - 0.1)
    assert loss.item() == pytest.approx(0.01, rel=1e-4)
    assert student.spec.fill_missing and not torch.equal(student.spec.filled(seen), seen)


def test_algorithm_acts_by_the_student_on_the_grid_of_its_environment(make):
    student = make()
    images = student.simulation.observation().numpy()
    action, size = student.predict(images, deterministic=True)[0], student.spec.action_size
    wanted = torch.from_numpy(student.trained_policy.predict(images, deterministic=True)[0])
    assert action.shape[2:] == student.action_space.shape[1:] != (size, size)
    assert torch.equal(torch.from_numpy(action), project(wanted, 64, student.simulation.spec.patch))


def test_student_does_as_the_teacher_in_a_closed_loop(make):
    own = {"num_envs": 4, "substeps": 20, "rollout_steps": 16, "updates": 20, "batch_size": 16}
    own |= {"steps": 384, "handover": (2 / 3,)}
    student, fine = make(**own), make(2, **own)
    student.collector.teacher = fine.collector.teacher = Mirror()
    rows = learn(student, 256)
    assert set(rows[0]) >= set(METRICS) - {"rollout/return"}
    assert rows[-1]["train/fresh_loss"] < 0.05 * rows[0]["train/fresh_loss"]
    assert [row["train/beta"] for row in rows[:3]] == pytest.approx([1.0, 0.7, 0.49])
    copy_coarse_weights(fine.actor, student.actor)
    learn(fine, 128)
    frozen, before = fine.actor.get_submodule("coarse").state_dict(), student.actor.state_dict()
    assert all(torch.equal(frozen[name], value) for name, value in before.items())
    for policy in (student.trained_policy, fine.trained_policy):
        env = TorchEnv("run", 2, policy.resolution, particles=300, substeps=20)
        images, _ = env.reset(seed=99)
        for _ in range(20):
            action, _ = policy.predict(images.numpy(), deterministic=True)
            wanted = project(Mirror().act(env, images), policy.resolution, 64)
            assert (torch.as_tensor(action) - wanted).square().mean().sqrt() < 0.06
            images = env.step(torch.as_tensor(action))[0]


def test_resumed_with_a_teacher_that_remembers_it_is_the_same_to_the_last_bit(make, segments):
    """A policy of segments, and episodes that end; `test_programs` resumes with a sequence of actions."""
    whole, first, second = (make(teacher=str(segments), max_episode_steps=6) for _ in range(3))
    learn(whole, 32)
    learn(first, 16)
    second.load_state_dict(first.state_dict())
    second.num_timesteps = first.num_timesteps
    learn(second, 16)
    for name, value in whole.actor.state_dict().items():
        assert torch.equal(value, second.actor.state_dict()[name]), name
    assert len(second.dataset) == len(whole.dataset) == 32
    for mine, theirs in zip(whole.dataset.rounds, second.dataset.rounds, strict=True):
        assert torch.equal(mine.observations, theirs.observations) and torch.equal(mine.actions, theirs.actions)


def test_labels_of_all_rounds_are_drawn_with_their_images():
    torch.manual_seed(0)
    dataset = Dataset()
    for numbers in (torch.arange(4), torch.arange(4, 8)):
        column = numbers[:, None, None, None]
        dataset.add(Labels(column.expand(-1, 3, 64, 64).byte(), column.expand(-1, 2, 8, 8).float()))
    images, actions = dataset.sample(200)
    drawn = actions[:, 0, 0, 0]
    assert len(dataset) == len(drawn.unique()) == 8 and torch.equal(images[:, 0, 0, 0].float(), drawn)


def test_loss_that_is_not_finite_ends_the_training(make):
    student = make()
    with torch.no_grad():
        next(student.actor.parameters()).fill_(float("nan"))
    labels = Labels(torch.zeros(8, 3, 64, 64, dtype=torch.uint8), torch.zeros(8, 2, 8, 8))
    student.collector.collect = lambda *_: labels
    with pytest.raises(NonFiniteError, match="loss became nan"):
        learn(student, 8)


@pytest.mark.parametrize(("given", "wanted"), [(8, 8), (8, 16), (16, 8), (16, 64)])
def test_projected_action_drives_the_muscles_alike(given, wanted):
    action = 0.5 * torch.rand(3, 2, given, given).double() - 0.25
    found, field = project(action, wanted, 64), patch_field(action, 64, 1.0)
    assert found.shape == (3, 2, wanted, wanted)
    error = (patch_field(found, 64, 1.0) - field).square().mean().sqrt()
    if wanted in (given, 64):
        assert error < 1e-12
    else:
        assert error < 0.3 * field.square().mean().sqrt() or wanted < given
        naive = F.interpolate(action, (wanted, wanted), mode="bicubic", align_corners=False)
        assert error < (patch_field(naive, 64, 1.0) - field).square().mean().sqrt()


def test_sequence_teaches_by_the_step_of_the_episode_in_its_own_orientation():
    ramp = torch.linspace(0, 0.9, 10)[:, None, None, None]
    record = OpenLoop(ramp * torch.rand(2, 8, 8), {"environment": {"action_layout": "image"}})
    env = TorchEnv("run", 3, particles=100, substeps=1)
    images, _ = env.reset(seed=0)
    env.env_state = replace(env.env_state, steps=torch.tensor([0, 4, 20]))
    action = Teacher(record, "image").act(env, images)
    assert torch.equal(action, torch.stack((record.actions[0], record.actions[4], torch.zeros(2, 8, 8))))
    assert torch.equal(Teacher(record, "grid").act(env, images), to_grid_layout(action, "image"))


TINY = (
    "--algo distill --task shapematch --particles 100 --substeps 4 --num-envs 2 --resolutions 4 8 --eval-episodes 2 "
    "--no-video --device cpu --checkpoint-every 20 --train-particles 100 --steps 32 --handover 0.5 --rollout-steps 4 "
    "--updates 2 --batch-size 4 --eval-every 0"
).split()


def test_policy_of_the_state_becomes_one_of_images_that_rewards_refine(tmp_path):
    teacher, folder = tmp_path / "teacher.safetensors", tmp_path / "distilled"
    config = replace(Shac.preset("shapematch", "quick"), num_envs=1, particles=300, substeps=4)
    untrained = Shac("NetworksPolicy", make_env(config, config.resolution(1)), config, device="cpu")
    untrained.save_policy(teacher, describe_run(config, "shac", 1, 0))
    assert train.main([*TINY, "--teacher", str(teacher), "--out", str(folder)]) == 0
    assert read_policy(folder / "teacher.safetensors")[1] == read_policy(teacher)[1]
    policy = cfp.load(folder)
    assert policy.description["trained_by"] == "distill" and policy.spec.resolutions == (4, 8)
    std = policy.actor.std(torch.zeros(1, 32, 4, 4))
    assert F.softplus(3 * std - 1).mean() == pytest.approx(0.105, abs=1e-3)
    refined = (
        "--task shapematch --particles 100 --substeps 4 --num-envs 2 --eval-episodes 1 --no-video --device cpu "
        "--steps 24 --handover 0.5 --batch-size 4 --update-start 8 --critics-first 0.5 --eval-every 12 --learner sac"
    ).split()
    words = [*refined, "--refine", "--start-from", str(folder), "--out", str(tmp_path / "refined")]
    assert cfp.train.main(words) == 0
    first = read_table(tmp_path / "refined" / "evaluations.csv")[0]
    assert (first["step"], first["stage"]) == ("12", "2")
    assert cfp.load(tmp_path / "refined").spec.resolutions == (4, 8)


def test_teacher_that_is_only_named_is_trained_first(tmp_path, monkeypatch):
    base = replace(Shac.preset("shapematch", "quick"), steps=32, window=4, train_particles=100, num_envs=2)
    tiny = replace(base, particles=100, substeps=1, eval_every=0, eval_episodes=1, video=False)
    monkeypatch.setattr(Shac, "preset", staticmethod(lambda task, name: tiny))
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "teacher.safetensors").write_bytes(b"of an attempt with other options that left no checkpoint")
    assert train.main([*TINY, "--teacher", "shac", "--out", str(folder)]) == 0
    trained = (folder / "teacher" / "policy.safetensors").read_bytes()
    assert (folder / "teacher.safetensors").read_bytes() == trained


@pytest.mark.parametrize(("task", "alike"), [("grow", True), ("shapematch", False)])
def test_record_of_one_episode_is_warned_of_where_episodes_differ(tmp_path, task, alike):
    config = replace(Distill.preset(task, "quick"), particles=100, substeps=1)
    path, size = tmp_path / "record.safetensors", config.resolution(1)
    write_policy(path, {"actions": torch.ones(3, 2, size, size)}, describe_run(config, "mpc", 1, 0) | {"layout": 0})
    config = replace(config, teacher=str(path))
    Distill.begin(config, tmp_path / "run")
    assert (Distill.warnings(config, tmp_path / "run", 1) == []) == alike
