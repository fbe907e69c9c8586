"""Evaluation of policies on fixed layouts, one episode on each."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import baselines
from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare import paper
from baselines.compare.plan import Run, reference_config
from baselines.registry import configure, sees
from cfp.config import RunConfig
from cfp.envs.make import choose_device
from cfp.evaluation.returns import Played, evaluation_seed, make_trial, play
from cfp.policy import Policy
from cfp.registry import algo_of

#: Episodes after which an evaluation is written down, so that one that is stopped goes on from there.
BATCH = 10


@dataclass(frozen=True)
class Protocol:
    """How all policies of a comparison are evaluated."""

    episodes: int = 10  # each on a layout of its own, the same for all policies
    particles: Literal["full", "lite"] | int = "lite"
    noise: Literal["paper", "with", "without"] = "paper"  # paper: except in `paper.WITHOUT_NOISE`

    def deterministic(self, task: str) -> bool:
        """Whether policies act without noise in a task."""
        return task in paper.WITHOUT_NOISE if self.noise == "paper" else self.noise == "without"


def play_episodes(config: RunConfig, policy: Policy, layouts: Sequence[int], deterministic: bool) -> list[Played]:
    """Play an episode of a policy on each of some consecutive layouts in the environment of a run's options."""
    trial = make_trial(config, "", policy, len(layouts), deterministic=deterministic, seed=layouts[0])
    return play([trial])[0]


def identity(run: Run) -> str:
    """What tells the policy of a run from others: the hash of its file, or the name of a reference policy."""
    path = run.folder / "policy.safetensors"
    if run.reference:
        return str(run.options["algo"])
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def evaluate_run(run: Run, protocol: Protocol) -> None:
    """Evaluate the policy of a run as far as its record does not hold that yet.

    The layouts are the same for the runs of all seeds: those on which no run of a comparison trains or chooses.
    """
    device = choose_device(run.options["device"])
    if run.reference:
        config = configure(reference_config(run.options))
        policy, observes = REFERENCE_POLICIES[run.options["algo"]](config), "nothing"
    else:
        there = baselines.Run(run.folder)
        config, policy, about = there.config, there.policy, there.policy.description
        observes = about.get("sees", sees(algo_of(about)))
    config = replace(config, seed=0, device=device, particles=protocol.particles)
    deterministic = protocol.deterministic(run.task)
    conditions = {"policy": identity(run), "particles": protocol.particles, "noise": not deterministic}
    found = run.record.get("evaluation", {})
    if any(found.get(name) != value for name, value in conditions.items()):
        found = {**conditions, "observes": observes, "layouts": [], "returns": [], "successes": [], "own_layout": None}
    while (done := len(found["returns"])) < protocol.episodes:
        first = evaluation_seed(config) + done
        layouts = range(first, first + min(BATCH, protocol.episodes - done))
        episodes = play_episodes(config, policy, layouts, deterministic)
        found["layouts"] += layouts
        found["returns"] += [episode.total for episode in episodes]
        found["successes"] += [episode.success for episode in episodes]
        run.update_record(evaluation=found)
    if "layout" in policy.description and found["own_layout"] is None:
        (episode,) = play_episodes(config, policy, [policy.description["layout"]], deterministic)
        run.update_record(evaluation=found | {"own_layout": episode.total})


def read_evaluation(run: Run, protocol: Protocol) -> dict[str, Any] | None:
    """The evaluation of a run under a protocol; None if it is not complete."""
    found: dict[str, Any] = run.record.get("evaluation", {})
    noise = not protocol.deterministic(run.task)
    conditions = {"policy": identity(run), "particles": protocol.particles, "noise": noise}
    if any(found.get(name) != value for name, value in conditions.items()):
        return None
    if len(found["returns"]) < protocol.episodes:
        return None
    return found | {name: found[name][: protocol.episodes] for name in ("layouts", "returns", "successes")}
