"""All algorithms and reference policies by name; their modules are imported when they are used."""

from importlib import import_module
from pathlib import Path
from typing import Any

from baselines.common.reference_policies import REFERENCE_POLICIES, ReferenceConfig, reference_preset
from cfp.analytic.config import AnalyticConfig
from cfp.config import RunConfig
from cfp.errors import ConfigError
from cfp.experiment.algorithm import Algorithm, Sees
from cfp.from_dict import update_from_dict
from cfp.policy import Policy, policy_file, read_policy
from cfp.presets import DEFAULT_TASK, from_json, like_start

#: ``"module:Class"`` of each algorithm, a subclass of `cfp.experiment.algorithm.Algorithm`.
ALGORITHMS: dict[str, str] = {
    "cfp": "cfp.experiment.sac_learner:SACLearner",
    "analytic": "cfp.analytic.learner:AnalyticLearner",
    "coarse": "baselines.common.single_stage:Coarse",
    "fine": "baselines.common.single_stage:Fine",
    "gnn-16": "baselines.modular.train:Modular",
    "gnn-64": "baselines.modular.train:Modular",
    "transformer-16": "baselines.modular.train:Modular",
    "transformer-64": "baselines.modular.train:Modular",
    "distill": "baselines.distillation.train:Distill",
    "gradient": "baselines.trajectory.optimise:Gradient",
    "mpc": "baselines.planning.mpc:MPC",
    "cem": "baselines.planning.mpc:CEM",
    "shac": "baselines.shac.train:Shac",
}

#: Other spellings: gnn16 for gnn-16.
ALIASES = {name.replace("-", ""): name for name in ALGORITHMS if "-" in name}


def find(name: str) -> type[Algorithm]:
    """The class of an algorithm; a `ConfigError` if there is none of that name."""
    name = ALIASES.get(name, name) if isinstance(name, str) else str(name)
    if name in REFERENCE_POLICIES:
        raise ConfigError(
            f"algo: {name!r} is a reference policy, which is not trained; evaluate it with: "
            f"python -m baselines.compare --algos {name}"
        )
    if name not in ALGORITHMS:
        raise ConfigError(f"algo must be one of {', '.join(ALGORITHMS)}, got {name!r}")
    module, _, attribute = ALGORITHMS[name].partition(":")
    algorithm: type[Algorithm] = getattr(import_module(module), attribute)
    return algorithm


def algorithm_of(config: RunConfig) -> type[Algorithm]:
    """The class of the algorithm that the options name; runs of ``python -m cfp.train`` with any learner are cfp."""
    return find("analytic" if isinstance(config, AnalyticConfig) else config.algo)


def sees(name: str) -> Sees:
    """What the policies of an algorithm, or a reference policy, look at."""
    return "nothing" if name in REFERENCE_POLICIES else find(name).sees


def configure(values: dict[str, Any]) -> RunConfig:
    """Options from JSON values, else from the preset they name; a `ConfigError` for a wrong name or type.

    Without ``algo`` they are those of ``python -m cfp.train``, whose learner depends on the preset; ``"cfp"`` is its
    learner ``sac``.
    """
    if "algo" not in values or (values["algo"] == "cfp" and "learner" in values):
        return from_json(values)  # as cfp.train, the program of both learners
    algo, task, preset = values["algo"], values.get("task", DEFAULT_TASK), values.get("preset", "quick")
    if isinstance(algo, str) and algo in ALIASES:
        algo = ALIASES[algo]
        values = {**values, "algo": algo}
    reference = isinstance(algo, str) and algo in REFERENCE_POLICIES
    if not reference and preset not in (allowed := find(algo).presets):
        raise ConfigError(f"preset must be {' or '.join(allowed)} for {algo}, got {preset!r}")
    base = reference_preset(algo, task, preset) if reference else find(algo).preset(task, preset)
    config: RunConfig = update_from_dict(like_start(base, values), values)
    return config


def reference_policy(config: RunConfig) -> Policy:
    """The reference policy that the options of `configure` name."""
    assert isinstance(config, ReferenceConfig)
    return REFERENCE_POLICIES[config.algo](config)


def load(path: str | Path, device: str = "cpu") -> Policy:
    """Load a trained policy of any algorithm; nothing is unpickled.

    Args:
        path: As in `cfp.load`: a run folder, a ``.safetensors`` file, ``"hf://OWNER/NAME"``, ...
        device: Where its tensors go.

    Returns:
        A policy with stable-baselines3's ``predict``. Some have a memory, and expect the second result back as
        ``state``. Its ``description`` tells task and origin.

    Raises:
        CheckpointError: No such file, a damaged one, or one that is not such a policy.
        ConfigError: It is of an algorithm that is not known here.
    """
    file = policy_file(path)
    return find(read_policy(file)[1]["kind"]).load(file, device)
