"""The other algorithms, which this module adds to `cfp.registry`, and the reference policies, by name."""

from typing import Any

from baselines.common.reference_policies import REFERENCE_POLICIES, ReferenceConfig, reference_preset
from cfp import registry
from cfp.config import RunConfig, update_from_dict
from cfp.errors import ConfigError
from cfp.learner import Sees
from cfp.policy_protocols import Policy
from cfp.presets import DEFAULT_TASK
from cfp.registry import ALGORITHMS, find, load

__all__ = ["ALGORITHMS", "configure", "find", "load", "reference_policy", "sees"]

ALGORITHMS |= {
    "coarse": "baselines.common.single_stage:Coarse",
    "fine": "baselines.common.single_stage:Fine",
    "gnn-16": "baselines.modular.learner:Modular",
    "gnn-64": "baselines.modular.learner:Modular",
    "transformer-16": "baselines.modular.learner:Modular",
    "transformer-64": "baselines.modular.learner:Modular",
    "distill": "baselines.distillation.learner:Distill",
    "gradient": "baselines.trajectory:Gradient",
    "mpc": "baselines.planning.mpc:MPC",
    "cem": "baselines.planning.mpc:CEM",
    "shac": "baselines.shac:Shac",
}


def _is_not_trained(name: str) -> ConfigError | None:
    if name not in REFERENCE_POLICIES:
        return None
    return ConfigError(
        f"algo: {name!r} is a reference policy, which is not trained; evaluate it with: torchmpm compare --algos {name}"
    )


registry.EXPLANATIONS.append(_is_not_trained)


def sees(name: str) -> Sees:
    """What the policies of an algorithm, or a reference policy, look at."""
    return "nothing" if name in REFERENCE_POLICIES else find(name).sees


def configure(values: dict[str, Any]) -> RunConfig:
    """Options from JSON values, also those of reference policies; see `cfp.registry.configure`."""
    if str(values.get("algo")) not in REFERENCE_POLICIES:
        return registry.configure(values)
    base = reference_preset(values["algo"], values.get("task", DEFAULT_TASK), values.get("preset", "quick"))
    return update_from_dict(base, values)


def reference_policy(config: RunConfig) -> Policy:
    """The reference policy that the options of `configure` name."""
    assert isinstance(config, ReferenceConfig)
    return REFERENCE_POLICIES[config.algo](config)
