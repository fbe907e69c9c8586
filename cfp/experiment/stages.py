"""The stages of the coarse-to-fine policy, whatever learns them: where each one begins, and its files."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cfp.agent.actor import Actor, SmallEncoder
from cfp.config import StagedConfig
from cfp.errors import ConfigError
from cfp.experiment.algorithm import Algorithm, Position
from cfp.experiment.folder import policy_path, start_path
from cfp.policy import (
    KIND,
    ActorPolicy,
    copy_policy,
    load,
    policy_for,
    read_policy,
    report_mismatch,
    write_policy,
)


class CoarseToFineStages(Algorithm):
    """Trains the coarse-to-fine policy, each stage over the frozen policy of the coarser one (paper, Section 4.2)."""

    config: StagedConfig
    stage: int

    @classmethod
    def initialize(cls, config: Any, folder: Path) -> Position:
        """Take the first stages from a policy if the options say so; its steps count as those before its handover."""
        if config.start_from is None:
            return Position()
        policy, refine = policy_for(config, config.start_from), config.refine
        stages, resolutions = len(policy.spec.resolutions), config.resolutions
        if policy.spec.resolutions != resolutions[:stages] or (stages == len(resolutions) and not refine):
            allowed = f"the first resolutions of {resolutions}" + ("" if refine else ", but not all")
            raise ConfigError(f"start_from must be a policy of {allowed}, got {policy.spec.resolutions}")
        if policy.spec.encoder != (encoder := config.network.encoder):
            raise ConfigError(f"start_from must be a policy with encoder {encoder}, got {policy.spec.encoder}")
        if stages > 1 and policy.spec != (allowed_spec := config.actor_spec(stages)):
            raise ConfigError(f"start_from must have networks {allowed_spec}, got {policy.spec}")
        stage = stages if refine else stages + 1
        copy = start_path(folder) if refine else policy_path(folder, stages)
        copy_policy(config.start_from, copy)
        return Position(stage, (0, *config.handover)[stage - 1])

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> ActorPolicy:
        """Load a policy."""
        return load(path, device)

    @property
    @abstractmethod
    def trained_actor(self) -> Actor:
        """The actor that is the policy."""

    @property
    def policy(self) -> ActorPolicy:
        """What has been learned so far."""
        spec, deterministic = self.config.actor_spec(self.stage), self.config.report.eval_deterministic
        return ActorPolicy(spec, deterministic, self.trained_actor)

    @classmethod
    def warm_start(cls, config: Any, stage: int, folder: Path, actor: Actor) -> bool:
        """Copy into a new ``actor`` the trained weights that its stage starts from; False if there are none."""
        device = str(next(actor.parameters()).device)
        if refines(config, folder, stage):
            actor.load_state_dict(load(start_path(folder), device).actor.state_dict())
        elif stage > 1:
            path = policy_path(folder, stage - 1)
            with report_mismatch(path):
                copy_coarse_weights(actor, load(path, device).actor)
        else:
            return False
        return True

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the actor with its frozen coarser stages."""
        network = asdict(self.config.actor_spec(self.stage))
        write_policy(path, self.trained_actor.state_dict(), description | {"kind": KIND, "network": network})


def copy_coarse_weights(actor: Actor, coarse: Actor) -> None:
    """Copy a trained coarse actor into the new stage above it, and its small encoder too."""
    actor.get_submodule("coarse").load_state_dict(coarse.state_dict())
    if isinstance(actor.encoder, SmallEncoder):  # heads and critics start from trained features
        actor.encoder.load_state_dict(coarse.encoder.state_dict())


def refines(config: Any, folder: Path, stage: int) -> bool:
    """Whether the actor of a stage begins as the one that is refined."""
    start = start_path(folder)
    return config.refine and start.exists() and bool(read_policy(start)[1]["stage"] == stage)
