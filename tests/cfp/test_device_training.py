"""Training on a GPU, as far as a CPU can tell: observations, actions and transitions that stay on the device, updates
that do not wait for it, the options of a GPU, and runs that change their device.
"""

import copy
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from device_operators import DeviceOperators
from fakes import FakeEnv
from stable_baselines3.common.logger import Logger
from tiny_runs import resume, run

from cfp import CFP, CFPPolicy, registry, train
from cfp.agent.actor import ActorSpec
from cfp.analytic import window
from cfp.config import Hyperparameters, to_words
from cfp.envs import make as envs
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError, NonFiniteError
from cfp.experiment.checkpoint import ReplayArchive
from cfp.presets import GPU, analytic_preset, for_gpu, sac_preset
from cfp.resumable import generator_state, restore_generator
from cfp.sac import learner, replay
from cfp.tables import read_table

SPEC = ActorSpec((4, 8), (-1.0,), patch=16, encoder="small")
OPTIONS = {"buffer_size": 60, "batch_size": 8, "update_start": 6, "random_steps": 10, "n_steps": 3, "gamma": 0.9}
FIELDS = replay.FIELDS
DEVICES = (["--device", "cpu"], [], ["--device", "cuda"])


def make_model(tensors=True, env=None, cls=CFP, **options):
    env = env or FakeEnv(num_envs=3, resolution=16, horizon=7, end_above=0.2)
    own = Hyperparameters(**OPTIONS | {"noise_cells": 2, "weight_average": 0.9} | options)
    model = cls(CFPPolicy, monitored(env, 5, tensors), own, seed=0, device="cpu", policy_kwargs={"spec": SPEC})
    model.set_logger(Logger(None, []))
    return model


def test_an_update_of_soft_actor_critic_waits_for_nothing():
    model = make_model()
    model.learn(30)
    with DeviceOperators() as device:
        model.train(3, 8)
    assert not device.waits
    with DeviceOperators() as device:
        model.read_updates()
    assert device.waits


def test_training_on_the_device_stores_and_returns_what_arrays_do():
    """The same robots, whose random actions do not depend on where the transitions are."""
    by_arrays, on_device = (make_model(tensors, random_steps=60, update_start=999) for tensors in (False, True))
    for model in (by_arrays, on_device):
        model.learn(60)  # twenty rows, as many as the ring has
    assert isinstance(on_device._last_obs, torch.Tensor) and isinstance(on_device.replay_buffer.rewards, torch.Tensor)
    assert by_arrays.replay_buffer.timeouts.any()
    for name in (*FIELDS, "pos", "full"):
        first, second = (np.asarray(getattr(model.replay_buffer, name)) for model in (by_arrays, on_device))
        np.testing.assert_array_equal(first, second, err_msg=name)
    assert [info["r"] for info in by_arrays.ep_info_buffer] == [info["r"] for info in on_device.ep_info_buffer]
    assert list(by_arrays.ep_success_buffer) == list(on_device.ep_success_buffer)
    numbers = np.random.default_rng(0).permutation(60)
    for model, drawn in ((by_arrays, numbers), (on_device, torch.from_numpy(numbers))):
        model.replay_buffer._draw = lambda size, drawn=drawn: drawn[:size]
    one, other = (model.replay_buffer.sample(40) for model in (by_arrays, on_device))
    assert all(torch.equal(*pair) for pair in zip(one, other, strict=True))


def test_what_is_not_finite_ends_the_training_before_anything_is_saved():
    model = make_model()
    model.learn(30)
    model.read_updates()
    next(model.networks()[1].parameters()).register_hook(lambda gradient: gradient * float("inf"))
    model.train(2, 8)
    with pytest.raises(NonFiniteError, match="a loss or its gradient is not finite in one of the updates"):
        model.state_dict()
    diverged = make_model(update_start=999, random_steps=0)
    with torch.no_grad():
        diverged.networks()[0].trainable_parameters()[-1].fill_(torch.nan)
    with pytest.raises(NonFiniteError, match="the policy has diverged"):
        diverged.learn(3)
    assert diverged.replay_buffer.size() == 0


def test_rows_hold_the_means_of_all_updates():
    rows = []
    for tensors in (False, True):
        model = make_model(tensors, random_steps=99)
        model.learn(30, log_interval=None)
        model.read_updates()
        rows.append((dict(model.logger.name_to_count), set(model.logger.name_to_value)))
    assert rows[0] == rows[1] and rows[0][0]["train/critic_loss"] == model._n_updates > 5


def test_what_does_not_fit_on_a_gpu_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10_000_000_000, 0))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 1_000_000_000)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 1_000_000_000)
    replay.check_room(280_000, 25_000, torch.device("cuda"))
    with pytest.raises(ConfigError, match=r"buffer_size must be at most 280,000 on this GPU, .* 10.0 GB are free"):
        replay.check_room(1_000_000, 25_000, torch.device("cuda"))
    env = FakeEnv(num_envs=64)
    window.check_gradient_memory(env, 16, 500_000_000)
    with pytest.raises(ConfigError, match="num_envs must be at most 35 with window 16 on this GPU, got 64"):
        window.check_gradient_memory(env, 16, 1_000_000_000)


# Options.


@pytest.mark.parametrize(
    ("gpu", "reason", "device"), [(False, None, "cpu"), (True, None, "cuda"), (True, "it has 7.5", "cpu")]
)
def test_auto_is_a_gpu_that_the_kernels_run_on(monkeypatch, caplog, gpu, reason, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(envs, "kernels_fail", lambda device: reason)
    envs._automatic_device.cache_clear()
    assert envs.choose_device("auto") == envs.choose_device("auto") == device
    envs._automatic_device.cache_clear()
    said = [record.message for record in caplog.records]
    assert said == (
        [] if reason is None else [f"device auto is the CPU, because the physics would be slow on the GPU: {reason}"]
    )
    assert envs.choose_device("cpu") == "cpu"


@pytest.mark.parametrize("make", [sac_preset, analytic_preset])
@pytest.mark.parametrize("task", ["run", "shapematch", "slot"])
def test_a_gpu_has_as_many_batched_steps_of_more_robots(make, task):
    config = make(task)
    gpu = for_gpu(config)
    gpu.check()
    assert {name: getattr(gpu, name) for name in GPU[config.algo]} == GPU[config.algo]
    assert gpu.steps / gpu.num_envs == config.steps / config.num_envs
    assert gpu.handover == config.handover and gpu.ends()[0] / gpu.steps == config.ends()[0] / config.steps
    if make is sac_preset:
        assert for_gpu(config, 24_000_000_000).buffer_size == 320_000
        assert for_gpu(sac_preset(task, "paper")) == sac_preset(task, "paper")


@pytest.mark.parametrize("learner", ["sac", "analytic"])
def test_a_gpu_that_is_not_named_trains_with_the_options_of_a_cpu(learner, monkeypatch):
    monkeypatch.setattr(registry, "gpu_memory", lambda device: 0 if device == "cpu" else 24_000_000_000)
    usual, found, named = (train.parse(["--task", "run", "--learner", learner, *device]).run for device in DEVICES)
    assert found == replace(usual, device="auto")
    assert named.num_envs == 1_024 > usual.num_envs


@pytest.mark.parametrize("learner", ["sac", "analytic"])
def test_a_command_line_takes_the_options_of_a_gpu_and_the_user_wins(learner, capsys, monkeypatch):
    monkeypatch.setattr(registry, "gpu_memory", lambda device: None)  # whatever this machine has

    def options(*words):
        assert train.main(["--task", "run", "--learner", learner, *words, "--dry-run"]) == 0
        return json.loads(capsys.readouterr().out)

    usual, gpu = options("--device", "cpu"), options("--device=cuda")
    own = for_gpu(registry.find(usual["algo"]).preset("run", "quick"))
    assert gpu == json.loads(json.dumps(asdict(replace(own, device="cuda")))) != usual
    assert options("--device", "cuda", "--num-envs", "64") == gpu | {"num_envs": 64}
    stated = {name: usual[name] for name in usual if usual[name] != gpu[name] and name != "device"}
    assert options("--device", "cuda", *to_words(stated)) == usual | {"device": "cuda"}
    with pytest.raises(SystemExit):
        train.main(["--task", "run", "--learner", learner, "--device", "cuda", "--help"])
    assert "(default: 1024)" in " ".join(capsys.readouterr().out.replace("│", " ").split())


# Runs that change their device.


def philox():
    """A state as a generator on a GPU has it."""
    return torch.arange(16, dtype=torch.uint8)


def test_a_generator_goes_on_from_one_of_another_kind():
    for generator in (torch.Generator(), np.random.default_rng(0)):
        drawn = []
        for state in (philox(), philox(), philox() + 1):
            restore_generator(generator, state)
            drawn.append(str(generator_state(generator)))
        assert drawn[0] == drawn[1] != drawn[2]
    seeded = torch.Generator()
    restore_generator(seeded, np.random.default_rng(0).bit_generator.state)
    assert seeded.initial_seed() != torch.Generator().initial_seed()


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("kind", ["sac", "analytic"])
def test_both_stages_of_a_run_train_on_the_device_and_go_on_on_a_cpu(kind, tmp_path, monkeypatch):
    """A checkpoint of a GPU also differs in the states of generators and the name of the device."""
    folder, make = tmp_path / "run", learner.make_env
    with monkeypatch.context() as patch:
        patch.setattr(learner, "make_env", lambda *options, **changes: make(*options[:-1], True, **changes))
        assert run(folder, "--steps", "64", "--handover", "0.5", learner=kind) == 0
    path = folder / "checkpoint" / "state.pt"
    state = torch.load(path, weights_only=True)
    if kind == "sac":
        assert isinstance(state["learner"]["random"]["replay"], torch.Tensor)
        state["learner"]["random"] |= {"replay": philox(), "cuda": philox()}
    else:
        state["learner"]["generator"] = philox()
    config = json.loads(state["config"]) | {"device": "cuda"}
    torch.save(state | {"config": json.dumps(config)}, path)
    (folder / "config.json").write_text(json.dumps(config))
    assert resume(folder, "--device", "cpu", "--steps", "96") == 0
    assert json.loads((folder / "config.json").read_text())["num_envs"] == 2
    rows = read_table(folder / "progress.csv")
    assert {row["stage"] for row in rows} == {"1", "2"} and rows[-1]["step"] == "96"
    losses = [float(row["train/critic_loss"]) for row in rows if row["train/critic_loss"]]  # none before updates begin
    assert len(losses) > 5 and np.isfinite(losses).all()


def test_a_run_on_the_device_goes_on_to_the_last_bit_there_and_from_arrays(tmp_path):
    saved = {}
    for tensors in (True, False):
        model = make_model(tensors)
        model.learn(30)
        archive = ReplayArchive(tmp_path / str(tensors), 1)
        saved[tensors] = model, copy.deepcopy(model.state_dict()), archive.save(model.replay_buffer, 10)
    for tensors, source in ((True, True), (True, False), (False, True)):
        model, state, chunks = saved[source]
        other = make_model(tensors)
        other.env.reset()
        ReplayArchive(tmp_path / str(source), 1).load(other.replay_buffer, 10, chunks)
        other.load_state_dict(copy.deepcopy(state))  # as a file would
        other.num_timesteps = 30
        for name in FIELDS:
            first, second = (np.asarray(getattr(each.replay_buffer, name)) for each in (model, other))
            np.testing.assert_array_equal(first, second, err_msg=name)
        torch.manual_seed(1)
        other.learn(30, reset_num_timesteps=False)
        assert all(torch.isfinite(value).all() for value in other.networks()[0].state_dict().values())
        if tensors is source is True:
            again = other.networks()[0].state_dict()
    torch.manual_seed(1)
    saved[True][0].learn(30, reset_num_timesteps=False)
    whole = saved[True][0].networks()[0].state_dict()
    assert all(torch.equal(value, again[name]) for name, value in whole.items())
