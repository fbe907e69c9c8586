"""The other algorithms, which this module adds to `cfp.registry`."""

from baselines.common.reference_policies import REFERENCE_POLICIES
from cfp.learner import Sees
from cfp.registry import ALGORITHMS, OTHER_NAMES, configure, find, load

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
OTHER_NAMES |= {
    name: f"algo: {name!r} is a reference policy, which is not trained; evaluate it: torchmpm compare --algos {name}"
    for name in REFERENCE_POLICIES
}


def sees(name: str) -> Sees:
    """What the policies of an algorithm, or a reference policy, look at."""
    return "nothing" if name in REFERENCE_POLICIES else find(name).sees
