"""Policy files: ``*.safetensors`` with a ``*.json`` beside it, both readable without pickle."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from cfp.agent.actor_policy import ActorPolicy
from cfp.agent.spec import RESOLUTIONS, ActorSpec
from cfp.config import LARGEST_SEED, TASK_OPTIONS, EnvironmentConfig, RunConfig, update_from_dict
from cfp.errors import CheckpointError, ConfigError
from cfp.files import FORMAT, parse_json, write_policy
from cfp.hub import download, is_address
from cfp.validation import brief
from dittogym import make_spec
from dittogym.action import trained_layout
from dittogym.geometry import NODES
from dittogym.tasks import fingerprint
from dittogym.torch_env import find_device

VERSION = 1
KIND = "cfp"
#: Types, or values, of the entries of a description; only policies for one initial position have a layout.
_DESCRIBED: dict[str, type | range] = {
    "kind": str,
    "task": str,
    "resolution": range(1, NODES + 1),
    "stage": range(1, 1001),
    "steps": range(2**62),
    "seed": range(LARGEST_SEED + 1),
    "deterministic": bool,
    "environment": dict,
    "layout": range(LARGEST_SEED + 1),
    "task_file": str,
    "target_picture": str,
}
_OPTIONAL = ("layout", "task_file", "target_picture")
#: Characters shown of an error of torch, which lists every layer.
MAX_REASON = 300
#: Folder of the policies that come with the package.
SHIPPED = Path(__file__).parent / "pretrained"


def describe_run(config: RunConfig, kind: str, stage: int, steps: int) -> dict[str, Any]:
    """Description of a policy of any kind, as JSON values; ``kind`` is the algorithm that can load it."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": kind,
        "task": config.task,
        "resolution": config.resolution(stage),
        "stage": stage,
        "steps": steps,
        "seed": config.seed,
        "deterministic": config.eval_deterministic,
        "environment": dataclasses.asdict(config.environment),
    } | _contents(config)


def _contents(config: RunConfig) -> dict[str, str]:
    """SHA-256 of the files that the task's options name: that of a custom task, and a chosen target picture."""
    target = Path(config.target or "")
    picture = hashlib.sha256(target.read_bytes()).hexdigest() if target.is_file() else None
    files = {"task_file": fingerprint(config.task), "target_picture": picture}
    return {name: value for name, value in files.items() if value is not None}


def is_of_another_task(description: Mapping[str, Any], config: RunConfig) -> bool:
    """Whether the file of a custom task, or a target picture, has changed since a policy was trained."""
    return any(description.get(name, value) != value for name, value in _contents(config).items())


def shipped() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(file.stem for file in SHIPPED.glob("*.safetensors"))


def policy_file(path: str | Path) -> Path:
    """The ``.safetensors`` file of a policy; see `load` for what ``path`` may be."""
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise CheckpointError(f"path must be a folder, a file or the name of a policy, got {brief(path)}")
    if is_address(path):
        return download(str(path))
    file = Path(path)
    if file.is_dir():
        file /= "policy.safetensors"
    elif file.suffix == ".json":
        file = file.with_suffix(".safetensors")
    elif file.suffix != ".safetensors":
        file = Path(f"{file}.safetensors")
    if not file.exists() and str(path) in shipped():
        file = SHIPPED / f"{path}.safetensors"
    if not file.exists():
        raise CheckpointError(f"{file}: there is no policy, and no shipped one has that name ({', '.join(shipped())})")
    return file


def read_policy(path: str | Path, device: str = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights by name and description of a policy that `write_policy` wrote; nothing is unpickled."""
    file = policy_file(path)
    try:
        find_device(device)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    try:
        with safetensors.safe_open(file, framework="pt", device=device) as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}
        description = parse_json(metadata.get(FORMAT, "{}"))
    except (OSError, ValueError, MemoryError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{file}: the policy is damaged ({error})") from error
    try:
        _check_description(description)
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{file}: weights must be finite, got NaN or infinity in {name}")
    return tensors, description


def copy_policy(source: str | Path, target: Path) -> None:
    """Copy a policy, its ``.safetensors`` file and the ``.json`` beside it."""
    write_policy(target, *read_policy(source))


def _check_description(description: Any) -> None:
    """Check the entries of a description that every kind of policy has."""
    known = isinstance(description, dict) and description.get("format") == FORMAT
    if not known or description.get("version") != VERSION:
        raise ConfigError(f"the file must have a {FORMAT} description of version {VERSION}")
    for name, allowed in _DESCRIBED.items():
        value = description.get(name)
        if name in _OPTIONAL and value is None:
            continue
        if isinstance(allowed, range):
            if type(value) is not int or value not in allowed:  # isinstance would accept a bool
                raise ConfigError(f"{name} must be between {allowed[0]} and {allowed[-1]}, got {value!r}")
        elif not isinstance(value, allowed):
            raise ConfigError(f"{name} must be of type {allowed.__name__}, got {value!r}")
    environment_of(description)


def environment_of(description: Mapping[str, Any]) -> EnvironmentConfig:
    """The environment in which the policy with a description was trained.

    Policies of the first version could be trained with the reference's faults, which are gone; their actions then were
    laid out as the reference's unless the description says otherwise.
    """
    values = dict(description["environment"])
    faulty = values.pop("parity", "clean") == "reference"
    if values.get("action_layout", "") is None:
        values["action_layout"] = "grid" if faulty else "image"
    return update_from_dict(EnvironmentConfig(), values)


@contextmanager
def report_mismatch(path: str | Path) -> Iterator[None]:
    """Report errors while a policy is built from its file as a `CheckpointError` that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:MAX_REASON] or type(error).__name__
        raise CheckpointError(f"{policy_file(path)}: weights and description do not match ({reason})") from error


def load(path: str | Path, device: str = "cpu") -> ActorPolicy:
    """Load a trained policy; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, the ``.json`` beside one, the name of a policy that comes with
            the package, such as ``"run"``, or ``"hf://OWNER/NAME"`` on the Hugging Face Hub, with ``@REVISION`` (a
            branch, a tag or a commit) and ``?sha256=HASH`` if wanted.
        device: Device of its tensors.

    Returns:
        A policy with stable-baselines3's ``predict``. ``policy.resolution`` is for ``gymnasium.make(...,
        resolution=...)``; ``policy.description`` holds the task and the options of its training.

    Raises:
        CheckpointError: The file is missing, damaged, or not such a policy.
        ConfigError: There is no such device, or huggingface_hub is not installed for an address on the Hub.

    Examples:
        >>> import cfp, dittogym, gymnasium
        >>> policy = cfp.load("run")
        >>> env = gymnasium.make("dittogym/run-coarse-v0", resolution=policy.resolution, particles="lite")
        >>> observation, info = env.reset(seed=0)
        >>> action, _ = policy.predict(observation, deterministic=True)
        >>> action.shape, policy.description["task"]
        ((2, 8, 8), 'run')
    """
    tensors, description = read_policy(path, device)
    if description["kind"] != KIND:
        raise CheckpointError(
            f"{policy_file(path)}: kind must be {KIND!r}, got {description['kind']!r}; see baselines.load"
        )
    with report_mismatch(path):
        spec = update_from_dict(ActorSpec(resolutions=RESOLUTIONS[:1]), description["network"])
        policy = ActorPolicy(spec, description["deterministic"])
        policy.actor.load_state_dict(tensors)
    policy.description = description
    policy.to(device)
    policy.eval()
    return policy


def policy_for(config: RunConfig, path: str) -> ActorPolicy:
    """Load the policy that a run starts from, which must be for its task, physics and orientation of actions."""
    policy = load(path)
    check_trained_for("start_from", policy.description, config.task, config.environment)
    if (found := trained_layout(policy)) != (expected := config.action_layout):
        raise ConfigError(f"start_from must be a policy for action_layout {expected}, got {found}")
    return policy


def check_trained_for(option: str, description: Mapping[str, Any], task: str, environment: EnvironmentConfig) -> None:
    """Check that a policy, named by an option, was trained for a task, its target, material and control step."""
    if (found := description["task"]) != task:
        raise ConfigError(f"{option} must be a policy for {task}, got one for {found}")
    own = environment_of(description)
    if not math.isclose(found := own.control_step, allowed := environment.control_step):
        raise ConfigError(f"{option} must be a policy for environment steps of {allowed} s, got {found}")
    for name in TASK_OPTIONS:
        given, expected = getattr(own, name), getattr(environment, name)
        try:
            same = is_same_task(task, name, given, expected)
        except (ValueError, TypeError, OSError) as error:
            raise ConfigError(f"{option}: cannot compare its {name} {given} with {expected} ({error})") from error
        if not same:
            raise ConfigError(
                f"{option} must be a policy for the {name} {expected or 'of the task'}, got {given or 'the default'}"
            )


def is_same_task(task: str, option: str, value: str | None, other: str | None) -> bool:
    """Whether two values of one of `TASK_OPTIONS` result in the same task; None is the task's default."""
    if value == other:
        return True
    options: list[dict[str, Any]] = [{} if each is None else {option: each} for each in (value, other)]
    first, second = (make_spec(task, **each) for each in options)
    return first == second and np.array_equal(np.asarray(first.target), np.asarray(second.target))
