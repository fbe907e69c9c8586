"""All algorithms by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cfp
from baselines.common import single_level as ladder
from baselines.common.algorithm import Entry
from baselines.common.reference_policies import Random, Scripted, Zero
from baselines.distillation.run import DistillRun
from baselines.distillation.train import Distill
from baselines.modular import train as modular
from baselines.planning.mpc import CEM, MPC
from baselines.shac.train import Shac
from baselines.trajectory.optimise import Gradient
from cfp.config import RunConfig, merge
from cfp.errors import ConfigError
from cfp.evaluation.evaluate import Policy
from cfp.experiment.cfp_run import Runner
from cfp.experiment.process import StopSignals
from cfp.experiment.run import Run
from cfp.weights import read_policy

ALGORITHMS: dict[str, Entry] = {
    "cfp": Entry("image", cfp.preset, Runner, cfp.load),
    "coarse": ladder.entry("coarse"),
    "fine": ladder.entry("fine"),
    "gnn-16": modular.entry("gnn-16"),
    "gnn-64": modular.entry("gnn-64"),
    "transformer-16": modular.entry("transformer-16"),
    "transformer-64": modular.entry("transformer-64"),
    "distill": Entry(Distill.sees, Distill.preset, DistillRun, Distill.load),
    "gradient": Gradient.entry(),
    "mpc": MPC.entry(),
    "cem": CEM.entry(),
    "shac": Shac.entry(),
    "zero": Zero.entry(),
    "random": Random.entry(),
    "scripted": Scripted.entry(),
}
ALIASES = {name.replace("-", ""): name for name in ALGORITHMS if "-" in name}
"""Other spellings: gnn16 for gnn-16."""


def find(name: str) -> Entry:
    """An algorithm.

    Raises:
        ConfigError: There is none of that name.
    """
    name = ALIASES.get(name, name) if isinstance(name, str) else name
    if not isinstance(name, str) or name not in ALGORITHMS:
        raise ConfigError(f"algo: got {name!r}, allowed {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def configure(values: dict[str, Any]) -> RunConfig:
    """Options from JSON values; what they leave out comes from the preset they name.

    Raises:
        ConfigError: An unknown name or a value of the wrong type.
    """
    entry = find(values.get("algo", "cfp"))
    if values.get("algo") in ALIASES:
        values = {**values, "algo": ALIASES[values["algo"]]}
    config: RunConfig = merge(entry.preset(values.get("task", "shapematch"), values.get("preset", "quick")), values)
    return config


def open_run(config: RunConfig, folder: Path, resume: bool, signals: StopSignals) -> Run:
    """Open a run of any algorithm, see `cfp.experiment.run.Run`."""
    return find(config.algo).open(config, folder, resume, signals)


def load(path: str | Path, device: str = "cpu") -> Policy:
    """Load a trained policy of any algorithm; nothing is unpickled.

    Args:
        path: A run folder, a ``.safetensors`` file, or the ``.json`` beside one.
        device: Where its tensors go.

    Returns:
        A policy with stable-baselines3's ``predict``. Some remember, and want the second result back as ``state``.
        Its ``description`` tells task and origin.

    Raises:
        CheckpointError: No such file, a damaged one, or one that is not such a policy.
        ConfigError: It is of an algorithm that is not known here.
    """
    return find(read_policy(path)[1]["kind"]).load(Path(path), device)
