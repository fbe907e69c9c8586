"""Evaluation of policies on fixed layouts, one episode on each."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import baselines
from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare import paper
from baselines.compare.plan import PlannedRun, reference_config
from baselines.registry import sees
from cfp.config import RunConfig
from cfp.envs.make import choose_device
from cfp.evaluation.returns import Played, evaluate, evaluation_seed, is_plan, make_trial
from cfp.policy import Policy
from cfp.registry import algo_of


@dataclass(frozen=True)
class Protocol:
    """How all policies of a comparison are evaluated."""

    episodes: int = 10  # each on a layout of its own, the same for all policies
    particles: Literal["full", "lite"] | int = "lite"
    noise: Literal["paper", "with", "without"] = "paper"  # paper: except in `paper.WITHOUT_NOISE`

    def deterministic(self, task: str) -> bool:
        """Whether policies act without noise in a task."""
        return task in paper.WITHOUT_NOISE if self.noise == "paper" else self.noise == "without"


def play_episodes(config: RunConfig, policy: Policy, layouts: Sequence[int], deterministic: bool) -> tuple[Played, ...]:
    """Play an episode of a policy on each of some consecutive layouts in the environment of a run's options."""
    trial = make_trial(config, "", policy, len(layouts), deterministic=deterministic, seed=layouts[0])
    return evaluate([trial], config.make_spec().horizon)[0].episodes


def identity(run: PlannedRun) -> str:
    """What tells the policy of a run from others: the hash of its file, or the name of a reference policy."""
    path = run.folder / "policy.safetensors"
    if run.reference:
        return str(run.options["algo"])
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def requirements(run: PlannedRun, protocol: Protocol) -> dict[str, Any]:
    """What must be the same for an evaluation to count."""
    noise = not protocol.deterministic(run.task)
    own = {"episodes": protocol.episodes, "particles": protocol.particles, "noise": noise}
    return {"policy": identity(run), **own}


def evaluate_run(run: PlannedRun, protocol: Protocol) -> None:
    """Evaluate the policy of a run and put the result into its record.

    The layouts are the same for the runs of all seeds: those on which no run of a comparison trains or chooses.
    """
    if run.reference:
        config = reference_config(run.options)
        policy, observes = REFERENCE_POLICIES[run.options["algo"]](config), "nothing"
    else:
        there = baselines.Run(run.folder)
        config, policy = there.config, there.policy
        observes = sees(algo_of(policy.description))
    device = choose_device(run.options["device"])
    config = replace(config, seed=0, device=device, particles=protocol.particles)
    deterministic = protocol.deterministic(run.task)
    layouts = range(evaluation_seed(config), evaluation_seed(config) + protocol.episodes)
    episodes = play_episodes(config, policy, layouts, deterministic)
    own = None
    if is_plan(policy):
        own = play_episodes(config, policy, [policy.description["layout"]], deterministic)[0].total
    found = {
        "observes": observes,
        "layouts": [*layouts],
        "returns": [episode.total for episode in episodes],
        "successes": [episode.success for episode in episodes],
        "own_layout": own,
    }
    run.update_record(evaluation=requirements(run, protocol) | found)


def read_evaluation(run: PlannedRun, protocol: Protocol) -> dict[str, Any] | None:
    """The evaluation of a run under a protocol; None if there is none."""
    found: dict[str, Any] = run.record.get("evaluation", {})
    return found if requirements(run, protocol).items() <= found.items() else None
