"""Whatever is in a file of options, a picture or a policy: the documented errors come out, or what it says."""

import json
import resource
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from policy_files import describe_actor, write_stranger

import baselines
from baselines.registry import ALGORITHMS, configure, find
from cfp.agent.actor import build_actor
from cfp.config import to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.policy import write_policy
from cfp.presets import sac_preset
from dittogym.tasks.targets import load_target

#: Bytes by which the memory may grow at most while a file of a few kilobytes is refused.
LARGEST_GROWTH = 2**30
FUZZ = settings(max_examples=60, deadline=20_000, suppress_health_check=list(HealthCheck))
SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from([2**63, 10**400, -1, 0, "run", "quick", "cfp-sac", "../../x", "\x00"])
)
JSON = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@pytest.fixture(autouse=True)
def bounded_memory():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < LARGEST_GROWTH


def paths(values, prefix=()):
    """Every place in nested dictionaries, groups included."""
    for name, value in values.items():
        yield (*prefix, name)
        if isinstance(value, dict):
            yield from paths(value, (*prefix, name))


def replaced(values, path, value):
    name, *rest = path
    return {**values, name: replaced(values[name], rest, value) if rest else value}


def damaged(content, cuts, changes):
    """Bytes with some overwritten and the end cut off."""
    result = bytearray(content[: len(content) - cuts])
    for place, byte in changes:
        if result:
            result[place % len(result)] = byte
    return bytes(result)


CHANGES = st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 255)), max_size=12)
CUTS = st.sampled_from([0, 0, 0, 1, 9, 500])


@pytest.mark.parametrize("algo", ["cfp-analytic", "cfp-sac", "distill", "gradient", "shac"])
@FUZZ
@given(data=st.data())
def test_options_of_any_kind(algo, data):
    values = to_json(find(algo).preset("shapematch", "quick"))
    for _ in range(data.draw(st.integers(1, 3))):
        values = replaced(values, data.draw(st.sampled_from(sorted(paths(values)))), data.draw(JSON))
    try:
        config = configure(values)
        config.check()
    except ConfigError as error:
        assert str(error)
    else:
        assert configure(json.loads(json.dumps(to_json(config)))) == config


def pictures():
    grey = np.zeros((48, 48), np.uint8)
    grey[10:38, 12:36] = 255
    return {kind: cv2.imencode(kind, grey)[1].tobytes() for kind in (".png", ".jpg", ".bmp", ".tiff", ".webp")}


@pytest.mark.parametrize("kind", pictures())
@pytest.mark.filterwarnings("ignore")
@FUZZ
@given(cuts=CUTS, changes=CHANGES)
@example(cuts=0, changes=[(33, 188)])  # in a PNG: a chunk that claims to be 3 GB long
def test_pictures_of_any_bytes(kind, tmp_path_factory, cuts, changes):
    path = tmp_path_factory.getbasetemp() / f"picture{kind}"
    path.write_bytes(damaged(pictures()[kind], cuts, changes))
    try:
        target = load_target(path)
    except ValueError as error:
        assert str(error).startswith("target ")
    else:
        assert target.shape == (64, 64) and target.dtype == bool


CONFIG = replace(sac_preset("shapematch"), resolutions=(4, 8), gate_bias=(-1.0,))
OF_OTHERS = {"inputs": 10, "noise": 0.1, "features": {}, "nodes": {"count": 16, "graph": True}}
DESCRIPTION = json.loads(json.dumps(describe_actor(CONFIG, 1, 7))) | OF_OTHERS


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """A valid policy: path, bytes, weights."""
    actor = build_actor(CONFIG.actor_spec(1))
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    write_policy(path, actor.state_dict(), DESCRIPTION)
    return path, path.read_bytes(), actor


def loaded(path):
    try:
        policy = baselines.load(path)
    except (CheckpointError, ConfigError) as error:
        assert str(error)
    else:
        assert policy.resolution >= 1 and isinstance(policy.description["task"], str)


@FUZZ
@given(cuts=CUTS, changes=CHANGES)
def test_policies_of_any_bytes(policy, cuts, changes):
    path, content, _ = policy
    path.write_bytes(damaged(content, cuts, changes))
    loaded(path)


@FUZZ
@given(
    kind=st.sampled_from(["cfp"] * len(ALGORITHMS) + sorted(ALGORITHMS)),
    place=st.sampled_from(sorted(paths(DESCRIPTION))),
    value=JSON,
)
@example(kind="cfp", place=("network",), value=[])
def test_policies_of_any_description(policy, kind, place, value):
    path, _, actor = policy
    write_stranger(path, actor.state_dict(), replaced(DESCRIPTION | {"kind": kind}, place, value))
    loaded(path)
