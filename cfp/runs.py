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
from cfp.envs.make import all_generators_kept, choose_device
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
        folder: The folder that a training, from Python or from the command line, wrote.

    Attributes:
        folder: The folder, a ``pathlib.Path``.
        config: The options of the run, such as a `cfp.AnalyticConfig`.

    Raises:
        cfp.CheckpointError: There is no run in the folder, or its options cannot be read.
        cfp.ConfigError: ``folder`` cannot be the name of a folder, or the run is of an algorithm that is not known;
            ``import baselines`` adds those of `baselines.ALGORITHMS`.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = parse_folder("folder", folder)
        self.config: RunConfig = read_config(self.folder, registry.configure)

    @cached_property
    def policy(self) -> Policy:
        """The policy of the last stage that had the best evaluation, a `cfp.policy.Policy`; read at the first access.

        Raises:
            cfp.CheckpointError: There is no policy yet, or its file is damaged.
        """
        return registry.load(policy_path(self.folder), choose_device(self.config.device))

    @property
    def evaluations(self) -> list[dict[str, float | None]]:
        """Rows of ``evaluations.csv``, one for each evaluation, empty before the first.

        A row holds ``step`` and ``stage``, the number of ``episodes``, ``mean``, ``std``, ``lowest`` and ``highest`` of
        their returns, and the share of ``success``, None where the task does not define it.
        """
        rows = read_table(self.folder / "evaluations.csv")
        return [{name: float(value) if value else None for name, value in row.items()} for row in rows]

    @property
    def results(self) -> list[dict[str, Any]]:
        """Rows of the final table, ``results.json``, for zero and random actions and for the policy.

        A row holds ``policy``, its name; ``action``, its grid, such as ``"8x8"``; the number of ``episodes``; ``mean``,
        ``std`` and half the 95 % confidence ``interval`` of their ``returns``; and the values ``success``,
        ``success_whole``, ``torn``, ``piece`` and ``mean_piece`` of `cfp.evaluation.returns.Result`.

        Raises:
            cfp.CheckpointError: The run is not finished, or the file cannot be read.
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
        """Record the first episode of the policy's final evaluation.

        Args:
            path: A film (``.mp4``, ``.gif``, ``.webp``), a filmstrip (``.png``) or a replay (``.html``) to write; None
                writes nothing.
            options: Options of the file, such as ``size``, ``speed`` and ``zoom``, see
                :class:`dittogym.render.recording.FilmOptions`.

        Returns:
            The recording, which a notebook shows.

        Raises:
            cfp.CheckpointError: There is no policy yet, or its file is damaged.
            ValueError: An option is out of range, the file does not take it, or ``path`` has another suffix.
            TypeError: There is no such option, or options are given without ``path``.
            dittogym.render.film.VideoUnavailable: An MP4 without the extra ``video``, or with an ffmpeg that fails.
        """
        check_film(path, options)  # before the episode
        recording = record_policy(self.config, self.policy)
        if path is not None:
            recording.save(path, **options)
        return recording

    def push(self, repo: str, *, private: bool = False) -> str:
        """Upload the policy to the Hugging Face Hub, with a model card about the run, see `cfp.ActorPolicy.push`.

        Args:
            repo: Name of the repository, ``"OWNER/NAME"``; it is created if it does not exist.
            private: Whether a new repository is private; one that exists stays as visible as it is.

        Returns:
            The address of this commit, for `cfp.load` or `baselines.load`.

        Raises:
            cfp.CheckpointError: There is no policy yet, or its file is damaged.
            cfp.ConfigError: huggingface_hub is not installed, or the Hub refuses the upload.
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
    """Train a coarse-to-fine policy in a run folder, as ``torchmpm train`` does.

    Options that are not given, or None, have the values of `cfp.preset`. Ctrl-C writes a checkpoint and raises a
    KeyboardInterrupt; the same call with ``resume=True`` then continues. As a side effect, on Linux glibc keeps freed
    memory for the rest of the process, which makes updates of the networks a third faster.

    Args:
        task: A task name, or ``"MODULE:NAME"`` for a custom task.
        algo: ``"cfp-analytic"`` or ``"cfp-sac"``; None for that of the preset. `baselines.fit` takes others.
        preset: ``"quick"``, ``"long"`` or ``"paper"``, see `cfp.preset`; None for quick.
        steps: Environment steps of all robots in all stages together.
        seed: Seed of everything that is random; None for that of the preset, which is 0 but for two tasks of paper.
        num_envs: Number of robots simulated side by side.
        particles: ``"full"`` (the paper's number), ``"lite"`` (about 2,000), the number of the robot's particles, or
            the numbers of robot and object.
        resolutions: Action grid R of each stage, coarsest first.
        start_from: A trained policy whose stages come first, in the forms that `cfp.load` takes.
        eval_every: Environment steps between evaluations; 0 for no evaluations.
        eval_episodes: Episodes of an evaluation and of the final table.
        video: Whether to record a video at the end.
        device: ``"cpu"``, ``"cuda"`` or ``"auto"``.
        out: Folder of the run; None for a folder in ``runs/`` that is named by algorithm, task, preset and seed.
        resume: Continue the run in the folder, or start one if there is none.
        quiet: Print nothing, and show no progress bar.
        on_evaluation: Called with each new row of ``evaluations.csv``, see `cfp.Run.evaluations`. An exception that it
            raises ends the training and leaves this function; the run can be resumed from its last checkpoint.
        options: All other options of the algorithm, the fields of `cfp.AnalyticConfig` or `cfp.SACConfig`, such as
            ``handover=(0.5,)``.

    Returns:
        The finished run.

    Raises:
        cfp.ConfigError: There is no such option, or a value is wrong.
        cfp.CheckpointError: A policy or the checkpoint is missing, damaged, or of other options.
        cfp.CFPError: Another process trains in the folder.
        cfp.NonFiniteError: The training has diverged.

    Examples:
        >>> import cfp
        >>> run = cfp.fit("run", steps=6400, video=False, out="runs/short")  # doctest: +SKIP
        >>> returns = [row["mean"] for row in run.evaluations]  # doctest: +SKIP
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
        with printable(), messages.quiet(quiet), all_generators_kept():
            train(command, "the same call with resume=True continues the run", on_evaluation)
    except Stopped as stopped:
        raise KeyboardInterrupt(str(stopped)) from None
    assert command.out is not None
    return Run(command.out)


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
