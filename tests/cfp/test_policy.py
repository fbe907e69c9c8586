import csv
import json
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import safetensors
import torch
from policy_files import describe_actor, save_actor

import cfp
from cfp.agent.actor import ActorSpec, build_actor
from cfp.config import EnvironmentConfig
from cfp.errors import CheckpointError, ConfigError
from cfp.policy import check_trained_for, policy_file, write_policy
from cfp.presets import sac_preset
from cfp.robustness import SEED, STARTS
from cfp.sac.policies import CFPPolicy
from dittogym.action import trained_layout

#: Rows of returns with 2,000 particles from varied starts, see docs/policies.md.
with open(Path(__file__).parents[2] / "docs" / "evaluations.csv", encoding="utf-8") as table:
    ROWS = list(csv.DictReader(table))
EVALUATED = [
    row
    for row in ROWS
    if row["policy"] not in ("zero", "random")
    and (row["case"], row["particles"], row["noise"]) == ("undisturbed", "lite", "with")
]


def images(count=3):
    return np.random.default_rng(0).integers(0, 256, (count, 3, 64, 64)).astype(np.uint8)


def in_training(policy):
    """The networks of soft actor-critic with the actor of a policy."""
    whole = CFPPolicy(policy.observation_space, policy.action_space, lambda _: 1e-3, policy.spec)
    whole.actor.load_state_dict(policy.actor.state_dict())
    return whole


@pytest.fixture
def saved(tmp_path):
    config = replace(sac_preset("shapematch"), resolutions=(8, 16), gate_bias=(-1.0,))
    actor = build_actor(config.actor_spec(2))
    save_actor(tmp_path / "policy.safetensors", actor, config, 2, 123)
    return tmp_path, actor


@pytest.mark.parametrize("name", ["", "policy", "policy.safetensors", "policy.json"])
def test_loaded_policy_acts_bit_for_bit_as_the_one_in_training(saved, name):
    folder, actor = saved
    policy = cfp.load(folder / name, device=torch.device("cpu"))
    trained = in_training(policy)
    assert all(torch.equal(trained.actor.state_dict()[name], value) for name, value in actor.state_dict().items())
    assert policy.resolution == 64  # blended on the patch
    for observation in (images(), images()[0]):
        for deterministic in (True, False):
            actions = []
            for each in (policy, trained):
                torch.manual_seed(0)
                actions.append(each.predict(observation, deterministic=deterministic)[0])
            np.testing.assert_array_equal(*actions)
            assert actions[0].shape == (*observation.shape[:-3], 2, 64, 64)


@pytest.mark.parametrize("name", ["run", "kick"])
def test_double_precision_as_default_changes_no_action(name):
    torch.set_default_dtype(torch.float64)
    found = cfp.load(name).predict(images(), deterministic=True)[0]
    torch.set_default_dtype(torch.float32)
    np.testing.assert_array_equal(found, cfp.load(name).predict(images(), deterministic=True)[0])


def test_actions_have_single_precision_under_autocast(saved):
    """Of a loaded policy and of the one in training, and the gate."""
    policy = cfp.load(saved[0])
    whole, gate = policy.predict_with_gate(images(), deterministic=True)
    with torch.autocast("cpu", torch.bfloat16):
        found, found_gate = policy.predict_with_gate(images(), deterministic=True)
        other, _ = in_training(policy).predict(images(), deterministic=True)
    for one, precise in ((found, whole), (found_gate, gate), (other, whole)):
        assert one.dtype == np.float32
        np.testing.assert_allclose(one, precise, atol=0.02)


@pytest.mark.parametrize(
    ("image", "given"),
    [
        (np.zeros((3, 64, 64), np.float32), "float32 array"),  # such as a soft observation
        (np.zeros((64, 64, 3), np.uint8), "uint8 array"),
        (torch.zeros(3, 64, 64, dtype=torch.uint8), "Tensor"),
    ],
)
def test_what_is_no_image_is_refused(image, given):
    policy = cfp.load("run")
    for predict in (policy.predict, policy.predict_with_gate, in_training(policy).predict):
        with pytest.raises(ValueError, match=f"observation must be a uint8 array .*, got {given}"):
            predict(image)
    with pytest.raises(ValueError, match=r"observation must be uint8 of shape \(B, 3, 64, 64\), got"):
        policy(torch.as_tensor(image))


def test_a_single_image_is_a_batch_of_one(saved):
    policy = cfp.load(saved[0])
    both = policy.predict_with_gate(images(), deterministic=True)
    for one, batch in zip(policy.predict_with_gate(images()[0], deterministic=True), both, strict=True):
        np.testing.assert_allclose(one, batch[0], atol=1e-6)


def test_gradients_with_respect_to_an_image_are_those_of_the_actor() -> None:
    """Pixels that are filled in would have none, and images in other units are not what it was trained on."""
    policy, image = cfp.load("run"), torch.from_numpy(images())
    soft = (image / 255 * 2 - 1).requires_grad_()
    with pytest.raises(ValueError, match=r"observation must be uint8 .* got float32"):
        policy(soft)
    action = policy.actor(soft, True)
    torch.testing.assert_close(action, policy.actor(image, True))
    assert torch.autograd.grad(action.sum(), soft)[0].abs().sum() > 0


def test_images_that_are_views_of_others() -> None:
    """Mirrored ones, and read-only ones without a warning."""
    policy, image = cfp.load("run"), np.random.default_rng(0).integers(0, 256, (3, 64, 64), np.uint8)
    for view in (image[..., ::-1], np.broadcast_to(image, (2, 3, 64, 64))):
        actions = [policy.predict(each, deterministic=True)[0] for each in (view, view.copy())]
        assert np.array_equal(*actions)


def test_description_stands_beside_and_inside_the_weights(saved):
    folder, _ = saved
    beside = json.loads((folder / "policy.json").read_text())
    with safetensors.safe_open(folder / "policy.safetensors", "pt") as file:
        assert beside == json.loads(file.metadata()["cfp-policy"])
    assert (beside["task"], beside["resolution"], beside["stage"], beside["steps"]) == ("shapematch", 16, 2, 123)
    (folder / "policy.json").unlink()
    assert cfp.load(folder).description["steps"] == 123


@pytest.mark.parametrize(("word", "encoder"), [("full", "paper"), ("lean", "small")])
def test_words_of_the_file_format_stay(tmp_path, word, encoder):
    spec = ActorSpec((4, 8), (0.0,), patch=64, encoder=encoder)
    actor, description = build_actor(spec), describe_actor(sac_preset("run"), 1, 0) | {"network": asdict(spec)}
    write_policy(tmp_path / "policy.safetensors", actor.state_dict(), description)
    assert json.loads((tmp_path / "policy.json").read_text())["network"]["encoder"] == word
    loaded = cfp.load(tmp_path)
    assert loaded.spec == spec and loaded.description["network"]["encoder"] == encoder
    torch.testing.assert_close(*(each(torch.from_numpy(images()), True) for each in (loaded, actor)), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("environment", "layout"),
    [
        ({"parity": "clean"}, "image"),
        ({"parity": "reference"}, "grid"),
        ({"parity": "reference", "action_layout": "image"}, "image"),
    ],
)
def test_policies_with_parity_in_their_header_load(tmp_path, environment, layout):
    actor, description = build_actor(ActorSpec((8,))), describe_actor(sac_preset("run", "paper"), 1, 0)
    description["environment"] |= {"action_layout": None, **environment}
    write_policy(tmp_path / "policy.safetensors", actor.state_dict(), description)
    policy = cfp.load(tmp_path)
    assert "parity" not in policy.description["environment"] and trained_layout(policy) == layout


@pytest.mark.parametrize(
    ("task", "own", "here", "differs"),
    [
        ("slot", {"variant": None}, {"variant": "registered"}, None),  # the default of a task may be named or not
        ("slot", {"variant": None}, {"variant": "published"}, "variant"),
        ("slot", {"variant": "published"}, {"variant": None}, "variant"),
        ("shapematch", {"target": None}, {"target": "star"}, None),
        ("shapematch", {"target": "M"}, {"target": "star"}, "target"),
        ("run", {"substeps": 100}, {"dt": 2e-4}, None),
        ("run", {"dt": 2e-4, "substeps": 50}, {}, None),
        ("run", {"substeps": 50}, {}, "environment steps"),
    ],
)
def test_task_and_duration_of_a_step_must_be_those_of_the_training(task, own, here, differs):
    description, environment = {"task": task, "environment": own}, EnvironmentConfig(**here)
    refused = pytest.raises(ConfigError, match=f"teacher must be a policy for .*{differs}")
    with refused if differs else nullcontext():
        check_trained_for("teacher", description, task, environment)


@pytest.mark.parametrize(
    ("name", "first", "total"),
    [
        ("catch", [0.2109666, 0.7468424], 9.758241),
        ("dig", [0.2289765, 0.5387932], 8.150450),
        ("grow", [0.4803942, -0.1347967], 7.376204),
        ("grow-success", [0.0958432, 0.3856710], 34.103118),
        ("kick", [-0.2148942, -0.1457828], -42.157841),
        ("obstacle", [0.4148184, -0.0170039], 39.385894),
        ("obstacle-rewards", [0.8237975, 0.9191539], 7.084496),
        ("run", [0.2113186, 0.1430961], 35.223017),
        ("run-rewards", [0.9962099, -0.9383458], 9.159965),
        ("shapematch", [-0.0237988, 0.1482136], -92.028098),
        ("slot", [0.2086875, 0.2795640], 21.970284),
        ("slot-success", [0.1976125, 0.2541370], 22.108836),
    ],
)
def test_shipped_policies_act_as_when_they_were_shipped(name, first, total):
    policy = cfp.load(name)
    task, file = policy.description["task"], policy_file(name)
    assert name.partition("-")[0] == task == json.loads(file.with_suffix(".json").read_text())["task"]
    assert file.stat().st_size < 1_000_000
    actions, _ = policy.predict(images(), deterministic=True)
    np.testing.assert_allclose(actions[0, 0, 0, :2], first, atol=1e-5)
    assert actions.sum(dtype=np.float64) == pytest.approx(total, abs=1e-3, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("row", EVALUATED, ids=lambda row: row["policy"])
def test_shipped_policies_return_what_was_measured(row):
    """The first two of the hundred episodes."""
    policy, options = cfp.load(row["policy"]), {"particles": "lite", "conditions": STARTS}
    result = cfp.evaluate_policy(policy, row["task"], 2, seed=SEED, **options)
    assert float(row["lowest"]) <= result.mean <= float(row["highest"])


def test_representation_says_what_a_policy_is_for():
    policy = cfp.load("run")
    steps, seed = policy.description["steps"], policy.description["seed"]
    assert repr(policy) == f"ActorPolicy(task='run', resolution={policy.resolution}, steps={steps}, seed={seed})"
    assert repr(cfp.ActorPolicy(policy.spec)) == f"ActorPolicy(resolution={policy.resolution})"


def test_a_folder_without_a_policy_hides_no_shipped_one(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path)
    assert cfp.load("run").description["task"] == "run"


def test_file_of_a_policy_may_be_named_without_its_suffix(tmp_path):
    for stem in ("p", "p-1", "p-1.2"):
        (tmp_path / f"{stem}.safetensors").touch()
    for name, expected in (("p", "p"), ("p.json", "p"), ("p-1.2", "p-1.2")):
        assert policy_file(tmp_path / name) == tmp_path / f"{expected}.safetensors"
    with pytest.raises(CheckpointError, match=r"p\.backup: there is no policy"):
        policy_file(tmp_path / "p.backup")


def test_the_policy_of_an_actor_is_a_copy_made_without_random_numbers():
    spec = ActorSpec((4, 8), (-1.0,))
    actor, state = build_actor(spec), torch.get_rng_state()
    policy = cfp.ActorPolicy(spec, True, actor)
    assert torch.equal(torch.get_rng_state(), state) and policy.deterministic_by_default
    before = policy.predict(images(), deterministic=True)[0]
    with torch.no_grad():
        next(actor.parameters()).add_(1.0)
    np.testing.assert_array_equal(policy.predict(images(), deterministic=True)[0], before)


def test_loading_a_policy_imports_neither_tensorboard_nor_tyro():
    program = "import sys, cfp; cfp.load('run'); print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "cfp.policy" in modules
    assert not {"tensorboard", "torch.utils.tensorboard", "tyro", "stable_baselines3"} & set(modules)
