"""Trained policies and their files: ``*.safetensors`` with a ``*.json`` beside it, both readable without pickle.

Nothing here needs stable-baselines3, so that loading a policy is quick.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import safetensors
import safetensors.torch
import torch
from gymnasium import spaces
from torch import Tensor, nn

from cfp.agent.actor import RESOLUTIONS, Actor, ActorSpec, build_actor
from cfp.config import LARGEST_SEED, TASK_OPTIONS, EnvironmentConfig, RunConfig, update_from_dict
from cfp.errors import CheckpointError, ConfigError, brief
from cfp.files import write_atomically, write_json
from cfp.hub import Shareable, download, is_address
from dittogym import make_spec
from dittogym.action import trained_layout
from dittogym.geometry import NODES
from dittogym.observation import SHAPE
from dittogym.torch_env import find_device

# Arguments of `predict` in stable-baselines3.
Observation: TypeAlias = np.ndarray | dict[str, np.ndarray]
Memory: TypeAlias = tuple[np.ndarray, ...] | None
Start: TypeAlias = np.ndarray | None

VERSION = 1
KIND = "cfp"
#: Key of the description in the metadata of a policy file.
FORMAT = "cfp-policy"
#: Folder of the policies that come with the package.
SHIPPED = Path(__file__).parent / "pretrained"
#: Types, or values, of the entries of a description; those in `_OPTIONAL` may be missing.
_DESCRIBED: dict[str, type | range] = {
    "kind": str,
    "task": str,
    "resolution": range(1, NODES + 1),
    "stage": range(1, 1001),
    "steps": range(2**62),
    "seed": range(LARGEST_SEED + 1),
    "deterministic": bool,
    "environment": dict,
    "layout": range(LARGEST_SEED + 1),  # of a policy for one initial position
}
_OPTIONAL = ("layout",)
#: Words of the file format for the two kinds of networks, and those of `ActorSpec.encoder`.
_ENCODERS = {"full": "paper", "lean": "small"}
#: Characters shown of an error of torch, which lists every layer.
_MAX_REASON = 300


class Policy(Protocol):
    """A trained policy of any kind, as `baselines.load` returns it.

    A policy that acts on the state of a simulation also has a method ``attached``, see
    `baselines.StatePolicy.attached`. Policies can be saved and pushed to the Hugging Face Hub, see
    `cfp.ActorPolicy.save` and `cfp.ActorPolicy.push`.
    """

    @property
    def uses_image(self) -> bool:
        """Whether it uses the pixels of the observation."""

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions, for ``gymnasium.make(..., resolution=...)``."""

    @property
    def deterministic_by_default(self) -> bool:
        """Whether the run that trained it evaluates it without noise."""

    @property
    def description(self) -> dict[str, Any]:
        """What it is and where it comes from, as JSON values by name; empty if that is not known.

        A run stores ``kind``, ``task``, ``resolution`` (the grid R on which it decides), ``stage``, ``steps`` and
        ``seed`` of the training, ``deterministic``, and the options of the ``environment``. A plan for a single start
        also has its ``layout``, the seed of the initial positions.
        """

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Choose actions, with the signature of stable-baselines3's ``predict``.

        Args:
            observation: (3, 64, 64) or (B, 3, 64, 64) uint8.
            state: Memory that the last call returned; ``None`` at the beginning, or for a policy without memory.
            episode_start: (B,) bool, true for elements whose episode begins.
            deterministic: Act without noise.

        Returns:
            Actions (2, R, R) or (B, 2, R, R) float32, and the memory for the next call.
        """


def check_images(observation: object) -> None:
    """Refuse anything but a uint8 image or a batch of them: networks take other numbers as normalised already."""
    if not isinstance(observation, np.ndarray):
        found = type(observation).__name__ + ("; call its numpy()" if isinstance(observation, Tensor) else "")
    elif observation.dtype == np.uint8 and observation.shape[-3:] == SHAPE and observation.ndim in (3, 4):
        return
    else:
        found = f"{observation.dtype} array of shape {observation.shape}"
    raise ValueError(f"observation must be a uint8 array of shape (3, 64, 64) or (B, 3, 64, 64), got {found}")


class ActorPolicy(nn.Module, Shareable):
    """A policy of the coarse-to-fine method, a torch module; `cfp.load` returns one.

    Args:
        spec: Structure of the actor.
        deterministic_by_default: Whether the run that trained it evaluates it without noise.
        actor: An actor of this structure, which is copied; None for one with random weights.

    Attributes:
        spec: Structure of the actor, a `cfp.ActorSpec`.
        actor: The networks, a torch module: ``actor(images, deterministic)`` returns actions (B, 2, R, R) for images
            (B, 3, 64, 64), uint8 or floating point in [-1, 1].
        description: What it is and where it comes from, see `cfp.policy.Policy.description`.
        deterministic_by_default: Whether the run that trained it evaluates it without noise.
        observation_space: ``Box(0, 255, (3, 64, 64), uint8)``.
        action_space: ``Box(-1, 1, (2, R, R), float32)``.
    """

    uses_image = True
    __repr__ = Shareable.__repr__  # that of a module lists every layer

    def __init__(self, spec: ActorSpec, deterministic_by_default: bool = False, actor: Actor | None = None) -> None:
        super().__init__()
        self.spec = spec
        self.deterministic_by_default = deterministic_by_default
        self.description: dict[str, Any] = {}
        self.actor = (build_actor(spec) if actor is None else copy.deepcopy(actor)).requires_grad_(False)
        self.observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2, self.resolution, self.resolution), np.float32)

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions, for ``gymnasium.make(..., resolution=...)``."""
        return self.spec.action_size

    def forward(self, observation: Tensor, deterministic: bool = False) -> Tensor:
        """Return actions for a batch of images.

        For gradients with respect to an image call ``actor``, which takes floating-point images in [-1, 1].

        Args:
            observation: (B, 3, 64, 64) uint8.
            deterministic: Act without noise.

        Returns:
            (B, 2, R, R).

        Raises:
            ValueError: ``observation`` has another type or shape.
        """
        if observation.dtype != torch.uint8 or observation.shape[1:] != SHAPE:
            kind, shape = str(observation.dtype).removeprefix("torch."), tuple(observation.shape)
            raise ValueError(
                f"observation must be uint8 of shape (B, 3, 64, 64), got {kind} of shape {shape}; policy.actor takes "
                "images in [-1, 1]"
            )
        action: Tensor = self.actor(self.spec.filled(observation), deterministic)
        return action

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a file ``.safetensors``, and its description to a file ``.json`` beside it.

        Args:
            path: The file, whose name ends in ``.safetensors``.

        Raises:
            cfp.ConfigError: ``path`` has another suffix, or ``description`` is not complete, as it is for a policy that
                comes from no run.
        """
        write_policy(path, self.actor.state_dict(), self.description, shared=True)

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Choose actions, with the signature of stable-baselines3's ``predict``.

        Args:
            observation: (3, 64, 64) or (B, 3, 64, 64) uint8.
            state: Returned as it is: the policy has no memory.
            episode_start: (B,) bool, without effect.
            deterministic: Act without noise.

        Returns:
            Actions (2, R, R) or (B, 2, R, R) float32, and ``state``.

        Raises:
            ValueError: The observation is neither an image nor a batch of images.
        """
        return self.predict_with_gate(observation, deterministic)[0], state

    @torch.no_grad()
    def predict_with_gate(
        self, observation: Observation, deterministic: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose actions, and show how the last stage blends them with those of the coarser one.

        Args:
            observation: (3, 64, 64) or (B, 3, 64, 64) uint8.
            deterministic: Act without noise.

        Returns:
            Actions (2, A, A) or (B, 2, A, A) float32, where A is `resolution`; and the gate of the last stage (2, R, R)
            or (B, 2, R, R) on its action grid R, from 0 where the coarser action is kept to 1 where it is replaced, or
            ``None`` for a policy of one stage.

        Raises:
            ValueError: The observation is neither an image nor a batch of images.
        """
        check_images(observation)
        # A copy: torch takes no negative strides, as of a mirrored image, and warns of arrays that are read-only.
        images = torch.as_tensor(np.array(observation, order="C"), device=next(self.parameters()).device)
        sample = self.actor.sample(self.spec.filled(images.reshape(-1, *SHAPE)), deterministic)
        # This rounds as stable-baselines3 does when it maps [-1, 1] to the bounds of the space.
        action: np.ndarray = (sample.action.cpu().numpy() + 1) - 1
        gate = None if sample.gate is None else sample.gate.cpu().numpy()
        if images.ndim == 3:
            return action[0], None if gate is None else gate[0]
        return action, gate


def load(path: str | Path, device: str | torch.device = "cpu") -> ActorPolicy:
    """Load a trained coarse-to-fine policy; nothing is unpickled. `baselines.load` also loads those of others.

    Args:
        path: A run folder, a ``.safetensors`` file, the ``.json`` beside one, the name of a policy that comes with
            the package, such as ``"run"``, or ``"hf://OWNER/NAME"`` on the Hugging Face Hub, with ``@REVISION`` (a
            branch, a tag or a commit) if wanted.
        device: Device of its tensors.

    Returns:
        A policy with stable-baselines3's ``predict``. ``policy.resolution`` is for ``gymnasium.make(...,
        resolution=...)``, and ``policy.description`` holds the task and the options of its training.

    Raises:
        cfp.CheckpointError: The file is missing, damaged, or not a coarse-to-fine policy, or cannot be downloaded.
        cfp.ConfigError: There is no such device, or huggingface_hub is not installed for an address on the Hub.

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
    return policy.to(device).eval()


# Files.


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
    if not file.exists() and (SHIPPED / f"{path}.safetensors").exists():
        file = SHIPPED / f"{path}.safetensors"
    if not file.exists():
        also = f"no shipped one has that name ({', '.join(shipped())})"
        raise CheckpointError(f"{path}: there is no policy (a file .safetensors), and {also}")
    return file


def read_policy(path: str | Path, device: str | torch.device = "cpu") -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights by name and description of a policy that `write_policy` wrote; nothing is unpickled."""
    file = policy_file(path)
    try:
        place = str(find_device(device))
    except ValueError as error:
        raise ConfigError(str(error)) from error
    try:
        with safetensors.safe_open(file, framework="pt", device=place) as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}
        description = json.loads(metadata.get(FORMAT, "{}"))
    except (OSError, ValueError, MemoryError, RecursionError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{file}: the policy is damaged ({error})") from error
    try:
        _check_description(description)
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{file}: weights must be finite, got NaN or infinity in {name}")
    return tensors, _translated(description, _ENCODERS)


def _check_description(description: Any) -> None:
    """Check the entries of a description that every kind of policy has, and bring older ones up to date."""
    known = isinstance(description, dict) and description.get("format") == FORMAT
    if not known or description.get("version") != VERSION:
        raise ConfigError(f"description must be that of a {FORMAT} of version {VERSION}, see cfp.policy.describe_run")
    for name, allowed in _DESCRIBED.items():
        value = description.get(name)
        if name in _OPTIONAL and value is None:
            continue
        if isinstance(allowed, range):
            if type(value) is not int or value not in allowed:  # isinstance would accept a bool
                raise ConfigError(f"{name} must be between {allowed[0]} and {allowed[-1]}, got {value!r}")
        elif not isinstance(value, allowed):
            raise ConfigError(f"{name} must be of type {allowed.__name__}, got {value!r}")
    environment = description["environment"]
    faulty = environment.pop("parity", "clean") == "reference"  # trained with faults of the reference, which are gone
    if environment.get("action_layout") is None:
        environment["action_layout"] = "grid" if faulty else "image"
    environment_of(description)


def environment_of(description: Mapping[str, Any]) -> EnvironmentConfig:
    """The environment in which the policy with a description was trained."""
    return update_from_dict(EnvironmentConfig(), description["environment"])


def _translated(description: dict[str, Any], words: Mapping[str, str]) -> dict[str, Any]:
    """A description whose word for the kind of networks is replaced."""
    network = description.get("network")
    if not isinstance(network, dict) or (word := words.get(str(network.get("encoder")))) is None:
        return description
    return {**description, "network": {**network, "encoder": word}}


def write_policy(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], description: dict[str, Any], shared: bool = False
) -> None:
    """Write a policy of any kind: weights with the description, that of `describe_run` and more, and its JSON.

    For ``shared`` see `cfp.files.write_atomically`.

    Raises:
        ConfigError: ``path`` does not end in ``.safetensors``, or the description is not one that can be read back.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ConfigError(f"path must end in .safetensors, got {str(path)!r}")
    _check_description(copy.deepcopy(description))  # it brings older ones up to date in place
    description = _translated(description, {own: word for word, own in _ENCODERS.items()})
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = safetensors.torch.save(plain, {FORMAT: json.dumps(description)})
    write_atomically(path, lambda file: file.write(content), shared)
    write_json(path.with_suffix(".json"), description, shared)


def copy_policy(source: str | Path, target: Path) -> None:
    """Copy a policy, its ``.safetensors`` file and the ``.json`` beside it."""
    write_policy(target, *read_policy(source))


@contextmanager
def report_mismatch(path: str | Path) -> Iterator[None]:
    """Report errors while a policy is built from its file as a `CheckpointError` that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, RuntimeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:_MAX_REASON] or type(error).__name__
        raise CheckpointError(f"{policy_file(path)}: weights and description do not match ({reason})") from error


# What a policy was trained for.


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
    }


def policy_for(config: RunConfig, path: str) -> ActorPolicy:
    """Load the policy that a run starts from, which must be for its task, physics and orientation of actions."""
    policy = load(path)
    check_trained_for("start_from", policy.description, config.task, config.environment)
    if (found := trained_layout(policy)) != (expected := config.action_layout):
        raise ConfigError(f"start_from must be a policy for action_layout {expected}, got {found}")
    return policy


def check_names(policies: Iterable[tuple[str, str, str | None]]) -> None:
    """Refuse different policies of one name, whose results would replace each other.

    Args:
        policies: Task, name, and hash of the file of each; None for a policy without a file.
    """
    files: dict[tuple[str, str], str | None] = {}
    for task, name, sha256 in policies:
        if files.setdefault((task, name), sha256) != sha256:
            raise ConfigError(f"policies must have names of their own, got two called {name!r} on {task}")


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
