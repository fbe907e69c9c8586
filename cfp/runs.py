"""Training from Python: the same runs as those of the command line."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from io import BytesIO
from typing import Any, cast

from cfp import messages, registry
from cfp.config import Particles, Preset, RunConfig
from cfp.envs.make import choose_device
from cfp.errors import CheckpointError, ConfigError
from cfp.evaluation.page import draw_curve
from cfp.evaluation.returns import REPLAYED
from cfp.evaluation.video import record_policy
from cfp.experiment.callbacks import OnEvaluation
from cfp.experiment.cli import Stopped, keep_memory, printable
from cfp.experiment.folder import parse_folder, policy_path, read_config
from cfp.files import parse_json
from cfp.hub import Shareable
from cfp.policy import Policy
from cfp.tables import read_table
from cfp.train import from_python, train
from dittogym.render.recording import Recording, check_film


class Run:
    """A run in its folder, finished, stopped, or still in training.

    Args:
        folder: Where a training, from Python or from the command line, wrote it.

    Raises:
        CheckpointError: There is no run.
        ConfigError: ``folder`` cannot be the name of one.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = parse_folder("folder", folder)
        self.config: RunConfig = read_config(self.folder, registry.configure)

    @cached_property
    def policy(self) -> Policy:
        """The policy of the last stage, that with its best evaluation; read at the first access."""
        return registry.load(policy_path(self.folder), choose_device(self.config.device))

    @property
    def evaluations(self) -> list[dict[str, float | None]]:
        """Rows of ``evaluations.csv``: step, stage, and the mean and spread of the returns; None for no value."""
        rows = read_table(self.folder / "evaluations.csv")
        return [{name: float(value) if value else None for name, value in row.items()} for row in rows]

    @property
    def results(self) -> list[dict[str, Any]]:
        """Rows of the final table, ``results.json``, beside zero and random action.

        Raises:
            CheckpointError: The run is not finished, or the file cannot be read.
        """
        path = self.folder / "results.json"
        if not path.exists():
            raise CheckpointError(f"{self.folder}: the run is not finished (no results.json)")
        try:
            rows: list[dict[str, Any]] = parse_json(path.read_text())
        except (OSError, ValueError) as error:
            raise CheckpointError(f"{path}: cannot be read ({error})") from error
        return rows

    def film(self, path: str | os.PathLike[str] | None = None, **options: Any) -> Recording:
        """Record the first episode of the policy's evaluation, which a notebook shows.

        Args:
            path: A film (``.mp4``, ``.gif``, ``.webp``), a filmstrip (``.png``) or a replay (``.html``) to write.
            options: Such as ``size``, ``speed`` and ``zoom``, see :class:`dittogym.render.recording.FilmOptions`.
        """
        check_film(path, options)  # before the episode
        recording = record_policy(self.config, self.policy)
        if path is not None:
            recording.save(path, **options)
        return recording

    def push(self, repo: str, *, private: bool = False) -> str:
        """Upload the policy to the Hugging Face Hub, with a model card about the run; see `ActorPolicy.push`.

        Args:
            repo: ``"OWNER/NAME"``.
            private: Create the repository as a private one; one that exists stays as visible as it is.
        """
        finished = (self.folder / "results.json").exists()
        return cast(Shareable, self.policy).push(repo, results=self.results if finished else (), private=private)

    def __repr__(self) -> str:
        """Folder, task, action grid of the last stage, and the mean return of its policy, once the run is finished."""
        config, returned = self.config, ""
        with suppress(CheckpointError):
            last = [row for row in self.results if row["policy"] != REPLAYED][-1]
            returned = f", mean_return={last['mean']:.1f}"
        resolution = config.resolution(len(config.ends()))
        about = f"{str(self.folder)!r}, task={config.task!r}, resolution={resolution}{returned}"
        return f"{type(self).__name__}({about})"

    def _repr_png_(self) -> bytes:
        """What a notebook shows: the learning curve, also of a run in training."""
        baselines: dict[str, float] = {}
        with suppress(CheckpointError):
            baselines = {row["policy"]: row["mean"] for row in self.results[:2]}
        picture = BytesIO()
        draw_curve(self.folder, self.config, baselines).savefig(picture, format="png", dpi=100)
        return picture.getvalue()


def fit(
    task: str,
    *,
    algo: str | None = None,
    preset: Preset | None = None,
    steps: int | None = None,
    seed: int | None = None,
    num_envs: int | None = None,
    particles: Particles | None = None,
    resolutions: Sequence[int] | None = None,
    start_from: str | os.PathLike[str] | None = None,
    eval_every: int | None = None,
    eval_episodes: int | None = None,
    video: bool | None = None,
    device: str | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    quiet: bool = False,
    on_evaluation: OnEvaluation | None = None,
    **options: Any,
) -> Run:
    """Train a policy, as ``torchmpm train`` does, with the same folder of the run.

    Options that are not given, or None, have the values of `cfp.preset`. Ctrl-C writes a checkpoint and raises
    `KeyboardInterrupt`; the same call with ``resume=True`` continues. On Linux glibc keeps freed memory from then on,
    which makes updates of the networks a third faster.

    Args:
        task: Task, or ``"MODULE:NAME"`` for a custom one.
        algo: ``"cfp-analytic"`` or ``"cfp-sac"``, None: that of the preset; `baselines.fit` has others.
        preset: ``"quick"``, ``"long"`` or ``"paper"``; None: quick.
        steps: Environment steps of all stages together.
        seed: Of everything that is random; None: 0.
        num_envs: Robots simulated side by side.
        particles: ``"full"`` (the paper's), ``"lite"`` (about 2,000), a number, or those of robot and object.
        resolutions: Action grid R of each stage.
        start_from: A trained policy for the first stages.
        eval_every: Environment steps between evaluations; 0: none.
        eval_episodes: Episodes of an evaluation and of the final table.
        video: Whether to record a video at the end.
        device: ``"cpu"``, ``"cuda"`` or ``"auto"``.
        out: Folder of the run; None: in ``runs/``, named by algorithm, task, preset and seed.
        resume: Continue the run in the folder, or start one if it holds none.
        quiet: Print nothing, and show no progress bar.
        on_evaluation: Called with each new row of ``evaluations.csv``, see `Run.evaluations`. An exception that it
            raises ends the training and comes out here; the run can be resumed from its last checkpoint.
        options: All further ones of the command line, with underscores, such as ``handover=(0.5,)``.

    Returns:
        The finished run.

    Raises:
        ConfigError: An option does not exist or is wrong.
        CheckpointError: A policy or the checkpoint is missing, damaged, or of other options.
        CFPError: Another process trains in the folder.
        NonFiniteError: Training has diverged.
    """
    options |= _given(algo=algo, preset=preset, steps=steps, seed=seed, num_envs=num_envs, particles=particles)
    options |= _given(resolutions=resolutions, start_from=start_from, video=video, device=device)
    options |= _given(eval_every=eval_every, eval_episodes=eval_episodes)
    for name, flag in (("resume", resume), ("quiet", quiet)):
        if not isinstance(flag, bool):
            raise ConfigError(f"{name} must be True or False, got {flag!r}")
    if on_evaluation is not None and not callable(on_evaluation):
        raise ConfigError(f"on_evaluation must be a function of a row, got {on_evaluation!r}")
    command = from_python({"task": task, **options}, None if out is None else parse_folder("out", out), resume)
    keep_memory()
    try:
        with printable(), messages.quiet(quiet):
            train(command, "the same call with resume=True continues the run", on_evaluation)
    except Stopped as stopped:
        raise KeyboardInterrupt(str(stopped)) from None
    assert command.out is not None
    return Run(command.out)


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
