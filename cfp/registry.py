"""All algorithms by name; their modules are imported when they are used. ``import baselines`` adds the others."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from cfp.config import RunConfig, update_from_dict
from cfp.envs.make import gpu_memory
from cfp.errors import ConfigError
from cfp.learner import Learner
from cfp.policy import KIND, Policy, policy_file, read_policy
from cfp.presets import DEFAULT_TASK, default_algo, for_gpu, like_start

#: ``"module:Class"`` of each algorithm, a subclass of `cfp.learner.Learner`.
ALGORITHMS: dict[str, str] = {
    "cfp-analytic": "cfp.analytic.learner:CFPAnalytic",
    "cfp-sac": "cfp.sac.learner:CFPSAC",
}
#: What to say of names that are no algorithms but something else; `baselines` knows policies that are not trained.
OTHER_NAMES: dict[str, str] = {}


def find(name: str) -> type[Learner]:
    """The class of an algorithm in `ALGORITHMS`, or of ``"MODULE:CLASS"``; a `ConfigError` if there is none."""
    module, _, attribute = ALGORITHMS.get(name, name).partition(":")
    if name not in ALGORITHMS and not (attribute and module.isidentifier()):  # files must not reach below the folder
        hint = "" if OTHER_NAMES else "; baselines.fit and baselines.Run know others"  # it has not been imported
        allowed = f"one of {', '.join(ALGORITHMS)} or MODULE:CLASS (a module in one word, without dots)"
        raise ConfigError(OTHER_NAMES.get(name, f"algo must be {allowed}, got {name!r}{hint}"))
    try:
        algorithm = getattr(import_module(module), attribute)
    except Exception as error:  # whatever a user's module does
        if name in ALGORITHMS:  # a fault of this library
            raise
        raise ConfigError(f"algo: {name} cannot be imported ({type(error).__name__}: {error})") from error
    if not (isinstance(algorithm, type) and issubclass(algorithm, Learner)):
        raise ConfigError(f"algo must name a subclass of cfp.learner.Learner, got {name!r}")
    return algorithm


def configure(values: dict[str, Any]) -> RunConfig:
    """Options from JSON values; those that are left out come from the preset and the device that the values name.

    The device auto has the options of a CPU, so that the same values are the same training on every machine.

    Raises:
        ConfigError: There is no such algorithm, task, preset or option, or a value is of another type.
    """
    preset = values.get("preset", "quick")
    algo, task = values.get("algo", default_algo(preset)), values.get("task", DEFAULT_TASK)
    learner = find(str(algo))
    if preset not in learner.presets:
        raise ConfigError(f"preset must be {' or '.join(learner.presets)} for {algo}, got {preset!r}")
    defaults = like_start(learner.preset(task, preset), values)
    device = str(values.get("device", defaults.device))
    memory = 0 if device == "auto" else gpu_memory(device)
    return update_from_dict(defaults if memory == 0 else for_gpu(defaults, memory), values)


def load(path: str | Path, device: str | torch.device = "cpu") -> Policy:
    """Load a trained policy of any algorithm; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, the ``.json`` beside one, the name of a policy that comes with the
            package, or ``"hf://OWNER/NAME"`` on the Hugging Face Hub, as in `cfp.load`.
        device: Device of its tensors.

    Returns:
        A policy with stable-baselines3's ``predict``, see `cfp.policy.Policy`. It is a `cfp.ActorPolicy`, a
        `baselines.StatePolicy`, a `baselines.SegmentPolicy` or a `baselines.OpenLoop`, of which the last two have a
        memory: pass the second result of ``predict`` to the next call as ``state``.

    Raises:
        cfp.CheckpointError: The file is missing, damaged, or not a policy, or cannot be downloaded.
        cfp.ConfigError: There is no such device, the policy is of an algorithm that is not known here, or
            huggingface_hub is not installed for an address on the Hub.
    """
    file = policy_file(path)
    return find(algo_of(read_policy(file)[1])).load_policy(file, str(device))


def algo_of(description: Mapping[str, Any]) -> str:
    """Name of an algorithm whose policies are of the same kind as one with a description."""
    return "cfp-sac" if description["kind"] == KIND else str(description["kind"])
