"""Policies to share: ``*.safetensors`` with a ``*.json`` beside it, both readable without pickle."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch

from cfp.actor import Actor, ActorSpec
from cfp.config import Config
from cfp.errors import CheckpointError
from cfp.files import write_atomically, write_json
from cfp.policy import ActorPolicy

FORMAT = "cfp-policy"
VERSION = 1


def describe(config: Config, level: int, steps: int) -> dict[str, Any]:
    """What a policy is and comes from, as JSON values.

    Args:
        config: The run that trained it.
        level: Its level in the ladder, 0 is the coarsest.
        steps: Environment steps of the run so far.
    """
    spec = config.actor_spec(level)
    return {
        "format": FORMAT,
        "version": VERSION,
        "task": config.task,
        "resolution": spec.resolutions[-1],
        "stage": level + 1,
        "steps": steps,
        "seed": config.seed,
        "deterministic": config.report.eval_deterministic,
        "network": dataclasses.asdict(spec),
        "environment": dataclasses.asdict(config.environment),
    }


def save_policy(path: Path, actor: Actor, description: dict[str, Any]) -> None:
    """Write an actor with its frozen levels.

    The description goes into the weights file too, so that the two can never disagree; the JSON file is for reading.

    Args:
        path: The ``.safetensors`` file; the ``.json`` file gets the same name.
        actor: The network.
        description: From `describe`.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in actor.state_dict().items()}
    content = safetensors.torch.save(tensors, {FORMAT: json.dumps(description)})
    write_atomically(path, lambda file: file.write(content))
    write_json(path.with_suffix(".json"), description)


def load(path: str | Path, device: str = "cpu") -> ActorPolicy:
    """Load a trained policy; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, or the ``.json`` beside one.
        device: Where its tensors go.

    Returns:
        A policy with stable-baselines3's ``predict(observation, deterministic=...)``: uint8 (3, 64, 64) or
        (B, 3, 64, 64) in, float32 (2, R, R) or (B, 2, R, R) out. Its ``description`` tells task and origin.

    Raises:
        CheckpointError: No such file, a damaged one, or one that is not such a policy.
    """
    file = Path(path)
    file = file / "policy.safetensors" if file.is_dir() else file.with_suffix(".safetensors")
    if not file.exists():
        raise CheckpointError(f"{file}: there is no policy")
    try:
        with safetensors.safe_open(file, framework="pt", device=device) as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}
    except (OSError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{file}: the policy is damaged ({error})") from error
    description = json.loads(metadata.get(FORMAT, "{}"))
    if description.get("format") != FORMAT or description.get("version") != VERSION:
        raise CheckpointError(f"{file}: got a file without a {FORMAT} description of version {VERSION}")
    try:
        policy = ActorPolicy(ActorSpec.from_json(description["network"]), bool(description["deterministic"]))
        policy.actor.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{file}: weights and description do not fit ({str(error).splitlines()[0]})") from error
    policy.description = description
    policy.to(device)
    policy.set_training_mode(False)
    return policy
