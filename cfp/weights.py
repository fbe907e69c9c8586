"""Policies to share: ``*.safetensors`` with a ``*.json`` beside it, both readable without pickle."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from cfp.agent.actor import Actor
from cfp.agent.policies import ActorPolicy
from cfp.agent.spec import RESOLUTIONS, ActorSpec
from cfp.config import LARGEST_SEED, Config, RunConfig
from cfp.errors import CheckpointError, ConfigError
from cfp.files import parse_json, write_atomically, write_json
from cfp.from_dict import type_name, update_from_dict
from cfp.sections import TASK_OPTIONS, EnvironmentConfig
from dittogym import make_spec
from dittogym.geometry import NODES
from dittogym.tasks import fingerprint

FORMAT = "cfp-policy"
VERSION = 1
KIND = "cfp"
_DESCRIBED: dict[str, tuple[type, int | None, int]] = {
    "kind": (str, None, 0),
    "task": (str, None, 0),
    "resolution": (int, 1, NODES),
    "stage": (int, 1, 1000),
    "steps": (int, 0, 2**62),
    "seed": (int, 0, LARGEST_SEED),
    "deterministic": (bool, None, 0),
    "environment": (dict, None, 0),
    "layout": (int, 0, LARGEST_SEED),
    "task_file": (str, None, 0),
}
"""What every description holds: type, least and largest value."""
_OPTIONAL = ("layout", "task_file")
"""What some have not: they were not made for one layout; the task comes with the library."""
REASON = 300
"""Characters of an error of torch that are shown: it lists every layer."""
SHIPPED = Path(__file__).parent / "pretrained"
"""Policies that come with the package, by name."""


def origin(config: RunConfig, kind: str, level: int, steps: int) -> dict[str, Any]:
    """What a policy of any kind is and comes from, as JSON values.

    Args:
        config: The run that trained it.
        kind: Says who can load it.
        level: Its stage, 0 is the first.
        steps: Environment steps of the run so far.
    """
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": kind,
        "task": config.task,
        "resolution": config.resolution(level),
        "stage": level + 1,
        "steps": steps,
        "seed": config.seed,
        "deterministic": config.report.eval_deterministic,
        "environment": dataclasses.asdict(config.environment),
    } | ({} if (file := fingerprint(config.task)) is None else {"task_file": file})


def is_of_another_task(description: Mapping[str, Any], task: str) -> bool:
    """Whether a policy was trained when the file that a task of one's own comes from was another."""
    then, now = description.get("task_file"), fingerprint(task)
    return then is not None and now is not None and then != now


def describe(config: Config, level: int, steps: int) -> dict[str, Any]:
    """What an actor is and comes from, see `origin`."""
    return origin(config, KIND, level, steps) | {"network": dataclasses.asdict(config.actor_spec(level))}


def write_policy(path: Path, tensors: Mapping[str, Tensor], description: dict[str, Any]) -> None:
    """Write a policy of any kind.

    The description goes into the weights file too, so that the two can never disagree; the JSON file is for reading.

    Args:
        path: The ``.safetensors`` file; the ``.json`` file gets the same name.
        tensors: By name.
        description: From `origin`, and what else its kind needs.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = safetensors.torch.save(plain, {FORMAT: json.dumps(description)})
    write_atomically(path, lambda file: file.write(content))
    write_json(path.with_suffix(".json"), description)


def shipped() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(file.stem for file in SHIPPED.glob("*.safetensors"))


def policy_file(path: str | Path) -> Path:
    """The ``.safetensors`` file that a path stands for.

    Args:
        path: A run folder, that file itself, the ``.json`` beside it, or, where nothing has that path, the name of a
            policy that comes with the package.

    Raises:
        CheckpointError: There is none.
    """
    file = Path(path)
    if not file.exists() and str(path) in shipped():
        file = SHIPPED / str(path)
    file = file / "policy.safetensors" if file.is_dir() else file.with_suffix(".safetensors")
    if not file.exists():
        raise CheckpointError(f"{file}: there is no policy, and none of that name is shipped ({', '.join(shipped())})")
    return file


def read_policy(path: str | Path, device: str = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `write_policy` wrote: tensors by name, and the description; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, or the ``.json`` beside one.
        device: Where the tensors go.

    Raises:
        CheckpointError: No such file, a damaged one, or one that is not such a policy.
    """
    file = policy_file(path)
    try:
        with safetensors.safe_open(file, framework="pt", device=device) as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}
        description = parse_json(metadata.get(FORMAT, "{}"))
    except (OSError, ValueError, MemoryError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{file}: the policy is damaged ({error})") from error
    try:
        description = _checked(description)
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{file}: {name}: got weights that are NaN or infinite, allowed are finite ones")
    return tensors, description


def _checked(description: Any) -> dict[str, Any]:
    """The description of a policy, once all that every kind has is what it should be.

    Raises:
        ConfigError: It is not.
    """
    known = isinstance(description, dict) and description.get("format") == FORMAT
    if not known or description.get("version") != VERSION:
        raise ConfigError(f"got a file without a {FORMAT} description of version {VERSION}")
    description = {"kind": KIND, **description}  # files older than kinds are all of this one
    for name, (kind, least, most) in _DESCRIBED.items():
        value: Any = description.get(name)
        if name in _OPTIONAL and value is None:
            continue
        wrong = type(value) is not kind  # a truth value is no number here
        if wrong or (least is not None and not least <= value <= most):
            allowed = type_name(kind) if least is None else f"{least} to {most}"
            raise ConfigError(f"{name}: got {value!r}, allowed {allowed}")
    update_from_dict(EnvironmentConfig(), description["environment"], "environment")
    return description


@contextmanager
def fitting(path: str | Path) -> Iterator[None]:
    """Turn what goes wrong while a policy is built from its file into an error that names the file.

    Raises:
        CheckpointError: Tensors and description do not fit.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:REASON] or type(error).__name__
        raise CheckpointError(f"{policy_file(path)}: weights and description do not fit ({reason})") from error


def save_policy(path: Path, actor: Actor, description: dict[str, Any]) -> None:
    """Write an actor with its frozen levels, see `write_policy`.

    Args:
        path: The ``.safetensors`` file.
        actor: The network.
        description: From `describe`.
    """
    write_policy(path, actor.state_dict(), description)


def load(path: str | Path, device: str = "cpu") -> ActorPolicy:
    """Load a trained policy; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, the ``.json`` beside one, or the name of a policy that comes with
            the package, such as ``"run"``.
        device: Where its tensors go.

    Returns:
        A policy with stable-baselines3's ``predict(observation, deterministic=...)``, uint8 (3, 64, 64) or
        (B, 3, 64, 64) in, float32 (2, A, A) or (B, 2, A, A) out. ``policy.resolution`` is A, for
        ``gymnasium.make(..., resolution=...)``: the patch after several levels, see `ActorSpec`. Its ``description``
        tells task and origin.

    Raises:
        CheckpointError: No such file, a damaged one, or one that is not such a policy.
    """
    tensors, description = read_policy(path, device)
    if description["kind"] != KIND:
        raise CheckpointError(f"{policy_file(path)}: got a policy of kind {description['kind']!r}, allowed {KIND!r}")
    with fitting(path):
        spec = update_from_dict(ActorSpec(resolutions=RESOLUTIONS[:1]), description["network"], "network")
        policy = ActorPolicy(spec, description["deterministic"])
        policy.actor.load_state_dict(tensors)
    policy.description = description
    policy.to(device)
    policy.set_training_mode(False)
    return policy


def policy_for(config: RunConfig, path: str) -> ActorPolicy:
    """Load the policy that a run's option start_from names.

    Args:
        config: The run's options.
        path: The option.

    Raises:
        ConfigError: The policy is for another task, target, physics or action layout.
        CheckpointError: See `load`.
    """
    policy = load(path)
    check_trained_for("start_from", policy.description, config.task, config.environment)
    environment: EnvironmentConfig = update_from_dict(EnvironmentConfig(), policy.description["environment"])
    if (made := environment.action_indexing) != (asked := config.environment.action_indexing):
        raise ConfigError(f"start_from: got a policy for action layout {made}, allowed {asked}")
    return policy


def check_trained_for(option: str, description: Mapping[str, Any], task: str, environment: EnvironmentConfig) -> None:
    """Check that what a policy was trained for is what it shall go on with, or teach.

    Args:
        option: Names the policy, for the message.
        description: Of the policy.
        task: What shall be done.
        environment: Where.

    Raises:
        ConfigError: It was another task, target, or matter and time under an action.
    """
    if description["task"] != task:
        raise ConfigError(f"{option}: got a policy for {description['task']}, allowed {task}")
    theirs: EnvironmentConfig = update_from_dict(EnvironmentConfig(), description["environment"])
    if theirs.substeps != environment.substeps:
        raise ConfigError(f"{option}: got a policy for substeps {theirs.substeps}, allowed {environment.substeps}")
    for name in TASK_OPTIONS:
        given, allowed = getattr(theirs, name), getattr(environment, name)
        try:
            same = is_same_task(task, name, given, allowed)
        except (ValueError, TypeError, OSError) as error:
            raise ConfigError(f"{option}: its {name} or the one wanted cannot be read ({error})") from error
        if not same:
            raise ConfigError(f"{option}: got a policy for the {name} {given}, allowed {allowed}")


def is_same_task(task: str, option: str, one: str | None, other: str | None) -> bool:
    """Whether two values of an option make the same of a task; None is the task's default.

    Args:
        task: Its name.
        option: One of `cfp.sections.TASK_OPTIONS`.
        one: A value.
        other: Another.

    Raises:
        ValueError: The task refuses a value.
        TypeError: It has no such option.
        OSError: A picture cannot be read.
    """
    if one == other:
        return True
    given: list[dict[str, Any]] = [{} if value is None else {option: value} for value in (one, other)]
    first, second = (make_spec(task, **options) for options in given)
    if first.target is not None:  # such a task judges by a function made for the picture
        second = replace(second, judge=first.judge)
    return first == second and np.array_equal(np.asarray(first.target), np.asarray(second.target))
