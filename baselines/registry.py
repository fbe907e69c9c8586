"""The other algorithms, which this module adds to `cfp.registry`."""

from baselines.common.reference_policies import REFERENCE_POLICIES
from cfp import registry
from cfp.errors import ConfigError
from cfp.learner import Sees
from cfp.registry import ALGORITHMS, configure, find, load

__all__ = ["ALGORITHMS", "configure", "find", "load", "sees"]

ALGORITHMS |= {
    "coarse": "baselines.single_stage:Coarse",
    "fine": "baselines.single_stage:Fine",
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
