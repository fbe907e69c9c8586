"""``python -m baselines.gradlab``: up to which horizon does a gradient through the simulation help on a task?"""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from baselines.common.rollout import check_differentiable
from baselines.gradlab.measure import ReturnFunction, measure
from baselines.gradlab.report import write
from cfp.envs.make import choose_device
from cfp.errors import ConfigError
from cfp.experiment.cli import read_command, run_command
from cfp.experiment.folder import Folder, make_folder
from cfp.validation import check_at_least
from dittogym import TorchEnv
from dittogym.spec import DT
from dittogym.tasks import task_name

#: Actions are drawn uniformly from [-ACTION_RANGE, ACTION_RANGE].
ACTION_RANGE = 0.3
#: Random directions of the finite differences.
DIRECTIONS = 4


@dataclass(frozen=True)
class GradLabConfig:
    """Measure the gradient of a task's smooth return with respect to the actions at several horizons.

    Writes a table and a figure. Compares the gradient with finite differences, float32 with float64, and first- with
    zeroth-order estimates.
    """

    task: str = "run"
    """Which task."""
    out: Folder | None = None
    """Folder of the results; runs/gradlab-TASK if not given."""
    quick: bool = False
    """Start from other defaults: a tiny robot and short horizons, which take seconds."""
    seed: int = 0
    """Seed of particles, actions and noise."""
    device: str = "auto"
    """cpu, cuda, or auto."""
    particles: Literal["full", "lite"] | int = "lite"
    """Particles: full, lite (about 2,000) or a count."""
    resolution: Literal["coarse", "fine"] | int = "coarse"
    """Action grid."""
    substeps: int | None = None
    """Substeps of a control step; None: as many as take 10 ms."""
    dt: float = DT
    """Duration of a substep, s."""
    backend: str = "auto"
    """How the physics is computed: auto, eager or native"""
    horizons: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Control steps over which rewards are summed; those beyond the end of the episode are left out."""
    warmup: int = 8
    """Control steps with random actions before the measured ones."""
    samples: int = 16
    """Simulations for each of the first- and zeroth-order estimates, an even number."""

    def check(self) -> None:
        """Check what the types do not express."""
        check_at_least(0, warmup=self.warmup)
        if self.samples < 4 or self.samples % 2:
            raise ConfigError(f"samples must be an even number and at least 4, got {self.samples}")
        if not self.horizons or any(early >= late for early, late in pairwise((0, *self.horizons))):
            raise ConfigError(f"horizons must be increasing and at least 1, got {self.horizons}")


QUICK = GradLabConfig(quick=True, particles=200, substeps=5, horizons=(1, 2, 4), warmup=1, samples=4)


def parse(given: Sequence[str] | None) -> GradLabConfig:
    """Read a command line; ``--quick`` chooses other defaults."""
    default = QUICK if "--quick" in (sys.argv if given is None else given) else GradLabConfig()
    examples = ("--task run", "--task kick --quick")
    config = read_command(GradLabConfig, "baselines.gradlab", examples, given, default=default)
    config.check()
    return replace(config, out=config.out or Path("runs") / f"gradlab-{task_name(config.task)}")


def make_env(config: GradLabConfig) -> TorchEnv:
    """Build and reset the task in float64; a `ConfigError` if it refuses an option or the episode is too short."""
    options = {name: getattr(config, name) for name in ("resolution", "particles", "substeps", "dt", "backend")}
    try:
        env = TorchEnv(config.task, dtype="float64", device=choose_device(config.device), **options)
        env.reset(seed=config.seed)
    except (ValueError, TypeError) as error:
        raise ConfigError(" ".join(str(error).split())) from error
    if (most := env.spec.horizon - config.horizons[0]) < config.warmup:
        raise ConfigError(f"warmup must be at most {most} in an episode of {env.spec.horizon}, got {config.warmup}")
    return env


def run(config: GradLabConfig) -> str:
    """Measure, write the folder, and return the text to print."""
    assert config.out is not None
    env = make_env(config)
    check_differentiable(env)
    make_folder(config.out)  # before the long measurement, not after it
    horizons = [horizon for horizon in config.horizons if horizon <= env.spec.horizon - config.warmup]
    generator = torch.Generator().manual_seed(config.seed)
    shape = (horizons[-1], *env.action_shape)

    def normal(count: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=env.dtype).to(env.device)

    actions = torch.rand(config.warmup + shape[0], *env.action_shape, generator=generator, dtype=env.dtype)
    actions = (ACTION_RANGE * (2.0 * actions - 1.0)).to(env.device)
    with torch.no_grad():
        for action in actions[: config.warmup]:
            env.step(action[None])
    function = ReturnFunction(env.model, env.env_state)
    directions, noise = normal(DIRECTIONS), normal(config.samples)
    results, errors = measure(function, actions[config.warmup :], horizons, directions, noise)
    return write(config.out, dataclasses.asdict(config) | {"out": str(config.out)}, results, errors.tolist())


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: print(run(parse(arguments))))


if __name__ == "__main__":
    sys.exit(main())
