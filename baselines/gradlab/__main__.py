"""``python -m baselines.gradlab``: up to which horizon does a gradient help on a task?"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from baselines.common.rollout import soft_step
from baselines.gradlab.measure import Probe, Smoothing, measure
from baselines.gradlab.report import format_table, write
from cfp.config import positive
from cfp.envs.make import choose_device
from cfp.errors import ConfigError
from cfp.experiment.cli import run_command
from dittogym import TorchEnv
from dittogym.tasks import task_name


@dataclass(frozen=True)
class Lab:
    """Measure the gradient of a task's smooth return in the actions, by horizon, and write a table and a picture.

    Finite differences against step width, norm, float32 against float64, first against zeroth order.
    """

    task: str = "run"
    """Which task."""
    out: Path | None = None
    """Folder of the results; runs/gradlab-TASK if not given."""
    quick: bool = False
    """Other defaults: a tiny robot, short horizons, seconds."""
    seed: int = 0
    """Controls particles, actions and noise."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    particles: Literal["full", "lite"] | int = "lite"
    """Particles: full, lite (about 2,000) or a count."""
    resolution: Literal["coarse", "fine"] | int = "coarse"
    """Action grid."""
    substeps: int = 100
    """Physics steps in a control step."""
    backend: str = "auto"
    """How the physics is computed: auto, eager, compile, ..."""
    horizons: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Control steps over which rewards are summed; those beyond the end of the episode are left out."""
    warmup: int = 8
    """Control steps, driven at random, before the measured ones."""
    amplitude: float = 0.3
    """Actions are uniform in plus or minus this."""
    widths: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
    """Step widths of finite differences, root mean square per action value."""
    directions: int = 4
    """Random directions of finite differences."""
    sigma: float = 0.1
    """Width of the noise on actions of which first and zeroth order estimate the mean gradient."""
    samples: int = 16
    """Simulations for either estimate, an even number."""
    chunk: int = 16
    """Simulations at once: bounds the memory."""

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        for name, least in {"warmup": 0, "directions": 1, "chunk": 1}.items():
            if getattr(self, name) < least:
                raise ConfigError(f"{name}: got {getattr(self, name)}, allowed {least} or more")
        if self.samples < 4 or self.samples % 2:
            raise ConfigError(f"samples: got {self.samples}, allowed an even number, 4 or more")
        positive(sigma=self.sigma, amplitude=self.amplitude)
        growing = all(early < late for early, late in pairwise((0, *self.horizons)))
        if not self.horizons or not growing:
            raise ConfigError(f"horizons: got {self.horizons}, allowed are growing numbers from 1")
        if not self.widths or min(self.widths) <= 0:
            raise ConfigError(f"widths: got {self.widths}, allowed are numbers above 0")


QUICK = Lab(quick=True, particles=200, substeps=5, horizons=(1, 2, 4), warmup=1, samples=4, directions=2)


def parse(arguments: Sequence[str]) -> Lab:
    """Read a command line; ``--quick`` chooses other defaults.

    Raises:
        ConfigError: An option is wrong.
        SystemExit: ``--help``, or an option that does not exist or cannot be read (exit code 2).
    """
    default = QUICK if "--quick" in arguments else Lab()
    lab: Lab = tyro.cli(Lab, prog="python -m baselines.gradlab", args=list(arguments), default=default)
    lab.check()
    return replace(lab, out=lab.out or Path("runs") / f"gradlab-{task_name(lab.task)}")


def make_env(lab: Lab) -> TorchEnv:
    """The task in float64.

    Raises:
        ConfigError: It refuses an option, or the episode is over before the first horizon.
    """
    device = choose_device(lab.device)
    try:
        env = TorchEnv(
            lab.task,
            resolution=lab.resolution,
            particles=lab.particles,
            substeps=lab.substeps,
            backend=lab.backend,
            dtype="float64",
            device=device,
        )
        env.reset(seed=lab.seed)
    except (ValueError, TypeError) as error:
        raise ConfigError(" ".join(str(error).split())) from error
    if lab.warmup + lab.horizons[0] > env.spec.horizon:
        raise ConfigError(
            f"warmup: got {lab.warmup}, allowed at most {env.spec.horizon - lab.horizons[0]} before a horizon of "
            f"{lab.horizons[0]} in an episode of {env.spec.horizon} steps"
        )
    return env


def total_steps(lab: Lab, horizons: Sequence[int]) -> int:
    """Control steps to be simulated; a gradient counts as three."""
    longest = horizons[-1]
    once = longest * (1 + 2 * lab.directions * len(lab.widths) + lab.samples)
    return once + sum(horizons) * (3 * (2 + lab.samples) + 3)


def run(lab: Lab) -> str:
    """Measure, write the folder, and return what to print.

    Raises:
        ConfigError: See `make_env`.
        NoGradientError: The task's reward has no gradient.
        OSError: The folder cannot be made.
    """
    assert lab.out is not None
    env = make_env(lab)
    lab.out.mkdir(parents=True, exist_ok=True)  # before the work, not after it
    horizons = [horizon for horizon in lab.horizons if horizon <= env.spec.horizon - lab.warmup]
    generator = torch.Generator().manual_seed(lab.seed)
    shape = (horizons[-1], *env.action_shape)

    def normal(count: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=env.dtype).to(env.device)

    drive = 2.0 * torch.rand(lab.warmup + shape[0], *env.action_shape, generator=generator, dtype=env.dtype) - 1.0
    drive = (lab.amplitude * drive).to(env.device)
    with torch.no_grad():
        for action in drive[: lab.warmup]:
            env.step(action[None])
    with tqdm(total=total_steps(lab, horizons), unit=" steps", disable=None) as bar:
        probe = Probe(env.model, env.env_state, soft_step, lab.chunk, bar.update)
        directions, smoothing = normal(lab.directions), Smoothing(normal(lab.samples), lab.sigma)
        rows, errors = measure(probe, drive[lab.warmup :], horizons, lab.widths, directions, smoothing)
    config = dataclasses.asdict(lab) | {"out": str(lab.out)}
    sentence = write(lab.out, config, rows, lab.widths, errors.tolist())
    return f"{format_table(rows)}\n\n{sentence}\nwritten to {lab.out}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: print(run(parse(sys.argv[1:] if arguments is None else arguments))))


if __name__ == "__main__":
    sys.exit(main())
