"""The presets of the eight tasks: default options of both learners, and where a task differs from them.

Those of ``paper`` are from the reference's configuration files and the paper (DittoGym, ICLR 2024, Section 5 and
Appendix B).
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import replace
from typing import Any

import dittogym
from cfp.config import AnalyticConfig, CoarseToFineConfig, Config, LearningConfig, Preset, SACConfig, check_task
from cfp.errors import ConfigError
from cfp.policy import load

#: Task of a command line that names none.
DEFAULT_TASK = "shapematch"
#: Tasks in which gradient methods are trained on speed to the right instead of the task's reward.
ON_SPEED = ("run", "obstacle")

#: Published options of RUN, which are also those of a custom task, for which nothing was published.
PUBLISHED: dict[str, Any] = {
    "steps": 550_000,
    "handover": (301_000 / 550_000,),
    "resolutions": (8, 16),
    "random_steps": (6_000, 100),
    "alpha": (0.01,),
    "gate_bias": (-1.0,),
    "gate_penalty": (0.01,),
    "num_envs": 1,
    "particles": "full",
    "interpolation": "aligned",
    "fill_missing": False,
}
#: Where the published options of a task differ. Steps and handover are those of the paper's curves. For GROW and CATCH
#: no second stage was published; the first one's values are used.
PAPER: dict[str, dict[str, Any]] = {
    "run": {},
    "shapematch": {
        "steps": 400_000,
        "handover": (142_000 / 400_000,),
        "resolutions": (32, 64),
        "random_steps": (500, 100),
        "alpha": (0.01, 0.0),
        "gate_bias": (-2.0,),
        "gate_penalty": (0.8,),
        "eval_deterministic": True,
    },
    "grow": {"steps": 600_000, "handover": (407_000 / 600_000,)},
    "kick": {"handover": (132_000 / 550_000,), "alpha": (0.05,), "gate_penalty": (0.0,)},
    "dig": {
        "steps": 780_000,
        "handover": (567_000 / 780_000,),
        "alpha": (0.05,),
        "gate_bias": (0.0,),
        "gate_penalty": (3.0,),
        "split": True,
        "gate_scale": 0.25,
    },
    "obstacle": {
        "steps": 700_000,
        "handover": (530_000 / 700_000,),
        "alpha": (0.05,),
        "gate_penalty": (0.04,),
    },
    "catch": {"steps": 380_000, "handover": (243_000 / 380_000,), "alpha": (0.1,), "seed": 2},
    "slot": {
        "steps": 600_000,
        "handover": (293_000 / 600_000,),
        "alpha": (0.05,),
        "gate_bias": (-2.0,),
        "gate_penalty": (0.1,),
        "seed": 1,
        "variant": "published",
    },
}

# Short episodes show more beginnings, and fewer bodies that have been torn by what came before. The actor learns from
# many windows, so that it keeps its gait. In other tasks such an actor averages over old actions, and learns little of
# the few new ones that lead over a stair, through a passage or into the soil.
_LONG_MEMORY: dict[str, Any] = {
    "windows_kept": 40,
    "minibatches": 48,
    "minibatch_size": 128,
    "weight_average": 0.995,
    "max_episode_steps": 200,
    "num_layouts": 256,
    "num_envs": 8,
}
#: Options of ``cfp-analytic`` that differ from task to task; found by the experiments that the documentation reports.
ANALYTIC: dict[str, dict[str, Any]] = {
    "shapematch": {
        "steps": 4_800,
        "handover": (3_200 / 4_800,),
        "action_step": (0.3,),
        "gate_bias": (-2.0,),
        "windows_kept": 2,
        "td_lambda": 0.0,
        "minibatches": 24,
        "weight_average": 0.98,
        "warmup": 0,
        "num_layouts": 256,
    },
    "run": _LONG_MEMORY | {"steps": 12_800, "handover": (9_600 / 12_800,), "displacement": False},
    "kick": _LONG_MEMORY | {"steps": 41_600, "handover": (38_400 / 41_600,), "action_step": (0.15, 0.02)},
    "grow": {"steps": 16_000, "handover": (12_800 / 16_000,)},
    "obstacle": {"steps": 48_000, "handover": (44_800 / 48_000,), "final_step": 0.3},
    "slot": {"steps": 19_200, "handover": (16_000 / 19_200,)},
    "catch": {"steps": 28_800, "handover": (25_600 / 28_800,), "max_episode_steps": 300},
    "dig": {"steps": 28_800, "handover": (25_600 / 28_800,), "weight_average": 0.98},
}

#: Options of the presets ``quick`` and ``long`` of ``cfp-sac`` that differ from task to task.
SAC: dict[str, dict[str, Any]] = {
    # Without gravity noise on cells drives the robot apart. In episodes of 30 steps one-step returns lead further.
    "shapematch": {"noise_cells": 0, "n_steps": 1, "critics_first": (600 / 28_800, 0.5)},
    "obstacle": {"alpha": (0.005,)},  # that of RUN; with five times as much the robot does not reach the stairs
    # Without these options returns are lower, and differ more from episode to episode.
    "slot": {"alpha": (0.005,), "gamma": 0.99, "n_steps": 10, "max_episode_steps": 1_000},
    # The way through the soil takes hundreds of steps. The paper's penalty closes the gate for good.
    "dig": {"gamma": 0.99, "gate_penalty": (0.01,)},
}
#: Options of the presets ``quick`` and ``long`` that differ on a GPU that is named, not found by auto: as many
#: robots as fill a card, and fewer but larger updates. Not chosen by measurements yet.
GPU: dict[str, dict[str, Any]] = {
    "cfp-sac": {"num_envs": 1_024, "gradient_steps": 8, "batch_size": 4_096, "buffer_size": 1_000_000},
    "cfp-analytic": {"num_envs": 1_024, "minibatch_size": 2_048, "windows_kept": 4},
}
#: Options in environment steps of all robots together: on a GPU they grow with the number of robots, so that a training
#: has as many batched steps as on a CPU.
COUNTED = ("steps", "random_steps", "update_start", "eval_every", "checkpoint_every", "log_every")
#: Bytes of a transition, nearly all of them two images, and the part of a GPU's memory that transitions may take.
TRANSITION, REPLAY_SHARE = 25_000, 1 / 3
#: Tasks in which ``quick`` makes one update of the networks for each step. With fewer, KICK, OBSTACLE, GROW and DIG
#: learned less in the same time; SLOT was not tried with fewer.
MANY_UPDATES = ("kick", "obstacle", "grow", "slot", "dig")


def preset(task: str, name: Preset = "quick", algo: str | None = None) -> SACConfig | AnalyticConfig:
    """Return the default options of a training; ``dataclasses.replace`` changes some of them.

    Args:
        task: A name from `dittogym.TASKS`, or ``"MODULE:NAME"``. A custom task, for which nothing was published, has
            its own action grids and, for ``"cfp-sac"``, the numbers of RUN; it has no preset ``"paper"``.
        name: ``"quick"`` for several robots with fewer particles, which takes minutes; ``"long"``, only for
            ``"cfp-sac"``, for the same with more steps, half an hour (SHAPE MATCH) to three hours of a core; or
            ``"paper"``, only for ``"cfp-sac"``, for the published numbers, with one robot of full particles and the
            interpolation of the reference implementation, which takes days.
        algo: ``"cfp-analytic"`` or ``"cfp-sac"``; None for ``"cfp-analytic"`` with ``"quick"``, and ``"cfp-sac"`` with
            the other presets.

    Returns:
        The options, a `cfp.AnalyticConfig` or a `cfp.SACConfig`.

    Raises:
        cfp.ConfigError: There is no such task or algorithm, or it has no such preset.

    Examples:
        >>> import cfp
        >>> options = cfp.preset("run")
        >>> options.algo, options.resolutions, options.steps
        ('cfp-analytic', (8, 16), 12800)
    """
    algo = algo or default_algo(name)
    if algo not in ("cfp-analytic", "cfp-sac"):
        raise ConfigError(f"algo must be cfp-analytic or cfp-sac, got {algo!r}")
    return sac_preset(task, name) if algo == "cfp-sac" else analytic_preset(task, name)


def default_algo(name: str) -> str:
    """The learner of the coarse-to-fine policy with a preset: that from rewards has more than one."""
    return "cfp-analytic" if name == "quick" else "cfp-sac"


def sac_preset(task: str, name: str = "quick") -> SACConfig:
    """The defaults of ``cfp-sac``, see `preset`."""
    check_task(task)
    allowed = typing.get_args(Preset) if task in PAPER else ("quick", "long")
    if name not in allowed:
        raise ConfigError(f"preset must be one of {', '.join(allowed)} for {task}, got {name!r}")
    paper = SACConfig(task=task, preset="paper", **_published(task))
    return paper if name == "paper" else _scaled_down(paper, name)


def analytic_preset(task: str, name: str = "quick") -> AnalyticConfig:
    """The defaults of ``cfp-analytic``, see `preset`."""
    check_task(task)
    if name != "quick":
        raise ConfigError(f"preset must be quick for algo cfp-analytic, got {name!r}")
    published = _published(task)
    options: dict[str, Any] = {
        "steps": 25_600,
        "handover": (19_200 / 25_600,),
        "resolutions": published["resolutions"],
        "action_step": (0.1, 0.02),
        "gate_bias": (-3.0,),  # a gate that is nearly closed leaves the coarse policy as it is at first
        "num_envs": 4,
        "reward": "speed" if task in ON_SPEED else "task",
        "log_every": 320,
    } | ANALYTIC.get(task, {})
    options |= {name: published[name] for name in ("split", "gate_scale") if name in published}
    options |= dict.fromkeys(("eval_every", "checkpoint_every"), options["steps"] // 12)
    return AnalyticConfig(task=task, **options)


def for_gpu(config: Config, memory: int | None = None) -> Config:
    """The default options on a GPU, see `GPU`.

    Args:
        config: Those on a CPU.
        memory: Of the GPU, in bytes; None: not known.
    """
    changes = dict(GPU.get(config.algo, {}))
    if not changes or config.preset == "paper":
        return config
    ratio = changes["num_envs"] // config.num_envs
    for name in COUNTED:
        value = getattr(config, name, None)
        if value is not None:
            changes[name] = tuple(part * ratio for part in value) if isinstance(value, tuple) else value * ratio
    if "buffer_size" in changes and memory is not None:
        changes["buffer_size"] = min(changes["buffer_size"], int(REPLAY_SHARE * memory) // TRANSITION)
    return replace(config, **changes)


def _published(task: str) -> dict[str, Any]:
    if task in PAPER:
        return PUBLISHED | PAPER[task]
    spec = dittogym.make_spec(task)
    return PUBLISHED | {"resolutions": (spec.coarse, spec.fine)}


def _scaled_down(paper: SACConfig, name: str) -> SACConfig:
    """``quick`` and ``long``: many small robots, small networks, coarser actions first."""
    task, quick = paper.task, name == "quick"
    horizon, many = dittogym.make_spec(task).horizon, task in MANY_UPDATES
    quick_steps, quick_handover = 48_000 if many else 38_400, 0.75
    # A longer run needs fewer evaluations and checkpoints a step, and as many steps of the critics alone. RUN gained
    # nothing from more than 160,000 steps of the first stage; the curves of SHAPE MATCH are flat before 60,000.
    long_steps, long_handover = 90_000 if task == "shapematch" else 240_000, 2 / 3
    steps = quick_steps if quick else long_steps
    coarse = paper.resolutions[0]
    options: dict[str, Any] = {
        "preset": name,
        "seed": 0,
        "steps": steps,
        "handover": (quick_handover if quick else long_handover,),
        "resolutions": (coarse // 2, coarse) if coarse > 4 else paper.resolutions,
        "random_steps": (480, 100),
        "alpha": (0.5 * paper.alpha[0],),
        # A gate that begins nearly closed and critics that learn first disturb the policy of the first stage least.
        "gate_bias": (-3.0,),
        "critics_first": (800 / 36_000 if many else 2_250 / 28_800, 0.5),
        "max_episode_steps": max(30, horizon // 4),
        "num_envs": 16,
        "particles": "lite",
        "variant": None,
        "eval_deterministic": False,
        "interpolation": "half_pixel",
        "encoder": "small",
        "fill_missing": True,
        "batch_size": 64 if many else 128,
        "learning_rate": 5e-4,
        "gamma": 0.95,
        "tau": 0.01,
        "buffer_size": 20_000 if many else 50_000,
        "gradient_steps": 16 if many else 4,
        "noise_cells": 4,
        "noise_scale": (0.2, 1.0),
        "final_rate": 0.1,
        "n_steps": 3,
        "weight_average": 0.998,
        "eval_every": steps // (8 if quick else 24),
        "checkpoint_every": steps // (16 if quick else 24),
        "log_every": 320 if quick else 1_600,
    } | SAC.get(task, {})
    if not quick:
        critics_alone = options["critics_first"][0] * (quick_handover * quick_steps)
        options |= {"buffer_size": 100_000, "critics_first": (critics_alone / (long_handover * steps), 0.1)}
    return replace(paper, **options)


def like_start(base: Config, values: dict[str, Any]) -> Config:
    """A default configuration for the policy that the JSON ``values`` start from, if any.

    A policy of as many stages that is refined keeps its action grids. For policies with the paper's networks the next
    grid is the paper's. An update takes several times as long, so there are fewer, of smaller batches. Strong
    exploration noise would disturb a policy that can do something already. What else differs was not measured for them.
    Their actions on the whole patch take as much memory as two images.
    """
    if not isinstance(base, CoarseToFineConfig) or values.get("start_from") is None:
        return base
    if {option.name for option in dataclasses.fields(base)} <= values.keys():  # those of a run, whose start may be gone
        return base
    spec, small = load(values["start_from"]).spec, base.encoder == "small"
    base = replace(base, encoder=spec.encoder)
    if isinstance(base, SACConfig) and small and spec.encoder != "small":
        usual = {name: getattr(LearningConfig(), name) for name in ("n_steps", "weight_average")}
        base = replace(base, gradient_steps=4, batch_size=64, noise_cells=0, max_episode_steps=None, **usual)
        if len(base.resolutions) > 1:
            grids = _published(base.task)["resolutions"]
            base = replace(base, resolutions=grids, buffer_size=base.buffer_size // 2)
    if values.get("refine") and len(spec.resolutions) == len(base.resolutions):
        base = replace(base, resolutions=spec.resolutions)
        return replace(base, gate_bias=spec.gate_bias) if spec.gate_bias else base
    return base
