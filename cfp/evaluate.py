"""``python -m cfp.evaluate RUN_FOLDER``: returns of a trained policy; also while it is in training."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from cfp import registry
from cfp.config import Particles, RunConfig, StagedConfig
from cfp.envs.make import choose_device
from cfp.errors import CheckpointError, ConfigError, check_at_least
from cfp.evaluation.returns import Noise, compare, evaluation_seed, format_table, to_rows, without_noise
from cfp.evaluation.video import check_files, record_episode, record_policy, save_media
from cfp.experiment.cli import read_command, run_command
from cfp.experiment.folder import policy_files, read_config
from cfp.files import check_output
from cfp.policy import Policy, environment_of, policy_file, shipped
from dittogym.trajectories import Episode, record, save_episodes

EXAMPLES = (
    "runs/run --episodes 10 --video run.mp4",
    "--policy run --particles full --json",
    "runs/run --noise both --replay run.html",
    "runs/run --episodes 20 --record run.npz",
)


@dataclass(frozen=True)
class Command:
    """Evaluate the policies of a run, or a single policy, in the same episodes, beside zero and random actions.

    They are evaluated in the task that they were trained for.
    """

    folder: tyro.conf.Positional[Path | None] = None
    """Run folder, of a finished training or of one in progress."""
    policy: str | None = None
    """In place of a folder: a policy file, the name of a policy that comes with the package, or hf://OWNER/NAME."""
    seed: int | None = None
    """Seed of initial particle positions and noise; the run's own if not given."""
    particles: Particles | None = None
    """Particles, to be named after the folder: full (the paper's), lite, or counts; the run's own if not given."""
    dt: float | None = None
    """Duration of a substep, s; the run's own if not given."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    episodes: int = 5
    """Episodes of each row. In GROW and OBSTACLE, whose starts are alike, those without noise are all the same."""
    noise: Noise = "default"
    """Action noise of the trained policies: with, without, both in rows of their own, or default, as trained."""
    json: bool = False
    """Print JSON instead of a table."""
    video: Path | None = None
    """Also film an episode of the last stage's policy, with noise if --noise is both: .mp4, .gif, .webp or .png."""
    replay: Path | None = None
    """Also write one episode of it as a page (.html) that plays in any browser."""
    record: Path | None = None
    """Also write its episodes to a file .npz: observations, actions, rewards, ends and particles."""
    record_fields: tuple[Literal["x", "v", "C", "F", "Jp"], ...] = ("x", "v")
    """Fields of the particles in that file: x, v, C, F and Jp are the whole state."""
    size: int = 512
    """Pixels per side of the video."""
    rate: float = 30.0
    """Pictures per second of the video."""
    speed: float | None = None
    """Playback speed, 1 is real time; None: real time, or slower for episodes of less than four seconds."""
    zoom: float | None = None
    """The video shows 1/zoom metres; None: 0.56 m."""

    def open(self) -> tuple[RunConfig, dict[str, Policy]]:
        """Options to evaluate with, and policies by stage, the newest last."""
        if self.folder is not None and self.policy is None:
            if self.folder.is_file() or (not self.folder.exists() and str(self.folder) in shipped()):
                raise ConfigError(f"{self.folder}: there is no such folder; --policy {self.folder} names the policy")
            config, policies = open_run(self.folder, self.device, self.seed)
        elif self.policy is not None and self.folder is None:
            config, policies = open_policy(self.policy, self.device, self.seed)
        else:
            given = "neither" if self.policy is None else "both"
            raise ConfigError(f"either policy or a folder must be given, got {given}")
        if self.particles is not None and self.particles != config.particles:
            config = replace(config, particles=self.particles)
        if self.dt is not None:
            config = config.simulated_with(dt=self.dt, option="dt")
        config.check()
        return config, policies


def open_run(folder: Path, device: str, seed: int | None = None) -> tuple[RunConfig, dict[str, Policy]]:
    """Options of the run in a folder, for evaluation, and its policies by stage, the newest last."""
    config = replace(read_config(folder, registry.configure), device=device)
    if seed is not None:
        config = replace(config, seed=seed)
        config.check()
    files = policy_files(folder, len(config.ends()))
    if not files:
        raise CheckpointError(f"{folder}: no policy has been written yet")
    loaded = choose_device(device)
    policies = {name: registry.load(path, loaded) for name, path in files.items()}
    for name, path in files.items():
        about, stages = policies[name].description, len(config.ends())
        if about["stage"] > stages:
            raise CheckpointError(f"{path}: stage must be between 1 and {stages}, got {about['stage']}")
        given = f"{about['task']} on a grid of {about['resolution']}"
        allowed = f"{config.task} on a grid of {config.resolution(about['stage'])}"
        if given != allowed:
            raise CheckpointError(f"{path}: {name} of this run must be a policy for {allowed}, got one for {given}")
    return config, policies


def open_policy(path: str, device: str, seed: int | None) -> tuple[RunConfig, dict[str, Policy]]:
    """A single policy and options to evaluate it with, as the run that trained it does; see `open_run`."""
    file = policy_file(path)
    policy = registry.load(file, choose_device(device))
    about = policy.description
    base = registry.configure({"algo": registry.algo_of(about), "task": about["task"]})
    # The number of robots that it was trained with does not matter here.
    values = vars(environment_of(about)) | {"num_envs": base.num_envs, "device": device}
    if isinstance(base, StagedConfig):  # in a custom task, the stages of the preset may not fit the networks
        grids = tuple(about["network"]["resolutions"])
        values |= {"resolutions": grids, "handover": tuple(stage / len(grids) for stage in range(1, len(grids)))}
    config = replace(base, **values, seed=about["seed"] if seed is None else seed)
    config.check()
    return config, {file.stem: policy}


def run(command: Command) -> str:
    """Evaluate, film if asked to, and return the table."""
    check_at_least(1, episodes=command.episodes)
    files = {"video": command.video, "replay": command.replay}
    films = {name: getattr(command, name) for name in ("size", "rate", "speed", "zoom")}
    options = {name: value for name, value in films.items() if value != getattr(Command, name)}
    check_files(files, options)
    if command.record is not None and command.record.suffix != ".npz":
        raise ConfigError(f"record must end in .npz, got {command.record}")
    if command.record is None and command.record_fields != Command.record_fields:
        raise ConfigError(f"record_fields requires record, a file .npz, got {' '.join(command.record_fields)}")
    config, policies = command.open()
    for name, path in {**files, "record": command.record}.items():
        if path is not None:
            check_output(name, path)
    results = compare(config, policies, command.episodes, command.noise)
    if any(files.values()):
        recording = record_policy(config, list(policies.values())[-1], command.noise)
        save_media(recording, files, sys.stderr if command.json else None, **options)
    if command.record is not None:
        episodes = _record(command, config, list(policies.values())[-1])
        print(f"record: {save_episodes(command.record, episodes)}", file=sys.stderr if command.json else None)
    return json.dumps(to_rows(results), indent=2) if command.json else format_table(config, results)


def _record(command: Command, config: RunConfig, policy: Policy) -> list[Episode]:
    """The episodes of a policy that were evaluated, played again."""
    deterministic, first = without_noise(policy, command.noise), evaluation_seed(config)
    recorder, seeds = partial(record, fields=command.record_fields), range(first, first + command.episodes)
    return [record_episode(config, policy, deterministic, seed, recorder) for seed in seeds]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: print(run(read_command(Command, "cfp.evaluate", EXAMPLES, arguments))))


if __name__ == "__main__":
    sys.exit(main())
