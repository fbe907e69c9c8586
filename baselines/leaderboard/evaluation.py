"""Evaluation of policies under a protocol of the leaderboard."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torchmpm
from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.results import read_cost
from baselines.leaderboard.protocol import FixedProtocol
from baselines.leaderboard.submission import Scores, Submission, Training, read_submission
from baselines.registry import configure, load, reference_policy, sees
from cfp.envs.make import make_env
from cfp.errors import ConfigError
from cfp.evaluation.returns import Trial, play
from cfp.experiment.folder import make_folder
from cfp.files import write_json
from cfp.hub import is_address
from cfp.policy import Policy, check_trained_for, policy_file, shipped
from cfp.sections import EnvironmentConfig
from dittogym.action import trained_layout

#: Name under which the policy of the package with a task's own name is submitted.
PRETRAINED = "pretrained"


@dataclass(frozen=True)
class Candidate:
    """A policy, and its submission without the episodes."""

    submission: Submission
    policy: Policy
    environment: EnvironmentConfig  # in which it is evaluated

    @property
    def file(self) -> str:
        """Name of the file of the submission."""
        return f"{self.submission.task}-{self.submission.policy}.json"


def submit(protocol: FixedProtocol, names: Sequence[str], tasks: Sequence[str], folder: Path) -> None:
    """Evaluate policies and write their submissions; those that this version has made before are kept.

    Args:
        protocol: The protocol.
        names: Policies, as in `baselines.load`, or reference policies.
        tasks: Where reference policies act.
        folder: Where the submissions go.
    """
    found = []
    for name in names:
        if name in REFERENCE_POLICIES:
            found += [_reference(protocol, name, task) for task in tasks]
        else:
            found.append(_trained(protocol, name))
    files = [each.file for each in found]
    if twice := [name for name in files if files.count(name) > 1]:
        raise ConfigError(f"policies for a task must have different names, got several for {twice[0]}")
    make_folder(folder)
    for candidate in found:
        path = folder / candidate.file
        if not _is_there(path, candidate.submission):
            write_json(path, asdict(evaluate(protocol, candidate)))
        scores = read_submission(path).scores
        print(f"{path}: {scores.mean:,.1f} ± {scores.interval:,.1f}, success {scores.success:.0%}", flush=True)


def _reference(protocol: FixedProtocol, name: str, task: str) -> Candidate:
    protocol.check_task(task)
    submission = Submission(protocol.version, task, name, library=torchmpm.__version__)
    return Candidate(submission, reference_policy(configure({"algo": name, "task": task})), protocol.environment)


def _trained(protocol: FixedProtocol, path: str) -> Candidate:
    file = policy_file(path)
    policy = load(file)
    about = policy.description
    cost = read_cost(file.parent) if file.name == "policy.safetensors" else None  # that of the whole run
    protocol.check_task(about["task"])
    check_trained_for("policies", about, about["task"], protocol.environment)
    training = Training(about["steps"])
    if cost is not None and cost.steps == cost.last_step:  # else a session was killed and left no record
        minutes = (cost.seconds + cost.teacher_seconds) / 60
        training = Training(cost.last_step + cost.teacher_steps, round(minutes, 1))
    submission = Submission(
        protocol=protocol.version,
        task=about["task"],
        policy=_name(path, about["task"]),
        sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        sees=about.get("sees", sees(about["kind"])),
        training=training,
        library=torchmpm.__version__,
    )
    return Candidate(submission, policy, replace(protocol.environment, action_layout=trained_layout(policy)))


def _name(path: str, task: str) -> str:
    """The name of a policy: that of its run folder, its file or its repository."""
    if path == task and path in shipped() and not Path(path).exists():
        return PRETRAINED
    place = Path(re.split("[@?]", path)[0] if is_address(path) else path).resolve()
    name = place.parent.name if place.stem == "policy" else place.name.removesuffix(".safetensors")
    return re.sub(r"[^\w.,+()-]", "-", name, flags=re.ASCII)[:60]


def evaluate(protocol: FixedProtocol, candidate: Candidate) -> Submission:
    """Play an episode on each layout."""
    task, size, seeds = candidate.submission.task, candidate.policy.resolution, protocol.seeds
    configs = {seed: protocol.config(task, seed, candidate.environment) for seed in seeds}
    trial = Trial(
        name=candidate.file,
        resolution=size,
        policy=candidate.policy,
        make_env=lambda seed, count: make_env(configs[seed], size, count),
        episodes=len(seeds),
        deterministic=protocol.deterministic,
        seed=seeds[0],
    )
    (episodes,) = play([trial], configs[seeds[0]].make_spec().horizon)
    returns = tuple(round(episode.total, 3) for episode in episodes)
    successes = tuple(bool(episode.success) for episode in episodes)
    return replace(candidate.submission, returns=returns, successes=successes, scores=Scores.of(returns, successes))


def _is_there(path: Path, submission: Submission) -> bool:
    """Whether a file holds a valid submission of the same policy by the same version."""
    try:
        there = read_submission(path)
    except ConfigError:
        return False
    return (there.key, there.library) == (submission.key, submission.library)
