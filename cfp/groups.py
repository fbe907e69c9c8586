"""Groups of options as frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from cfp.agent.losses import Precision
from cfp.agent.networks import Interpolation
from cfp.errors import ConfigError

Tier: TypeAlias = Literal["full", "lite"] | int | tuple[int, int]
"""Particles: the paper's, about 2,000, a count, or one count for robot and one for object."""

TASK_OPTIONS = ("target", "variant")
"""Fields of `EnvironmentConfig` that are options of some task."""


def at_least_one(**counts: int) -> None:
    """Check counts by name.

    Raises:
        ConfigError: One is below 1.
    """
    for name, value in counts.items():
        if value < 1:
            raise ConfigError(f"{name}: got {value}, allowed 1 or more")


def not_negative(**numbers: float) -> None:
    """Check numbers by name.

    Raises:
        ConfigError: One is below 0.
    """
    for name, value in numbers.items():
        if not value >= 0:
            raise ConfigError(f"{name}: got {value}, allowed 0 or more")


def positive(**numbers: float) -> None:
    """Check numbers by name.

    Raises:
        ConfigError: One is not above 0.
    """
    for name, value in numbers.items():
        if not value > 0:
            raise ConfigError(f"{name}: got {value}, allowed more than 0")


def share(**numbers: float) -> None:
    """Check shares by name.

    Raises:
        ConfigError: One is not between 0 and 1, ends included.
    """
    for name, value in numbers.items():
        if not 0 <= value <= 1:
            raise ConfigError(f"{name}: got {value}, allowed 0 to 1")


@dataclass(frozen=True)
class EnvironmentConfig:
    """Where the robot lives: options of `dittogym.TorchEnv`."""

    num_envs: int = 16
    """Robots simulated side by side."""
    particles: Tier = "lite"
    """Particles: full (the paper's), lite (about 2,000), a count, or one count for robot and one for object."""
    substeps: int = 100
    """Physics steps in one environment step."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of the physics."""
    backend: str = "auto"
    """How the physics is computed: auto, eager, compile, ..."""
    action_layout: Literal["image", "grid"] | None = None
    """Orientation of the action array: image (as the observation) or grid (the reference's); None: by parity."""
    parity: Literal["clean", "reference"] = "clean"
    """clean: the reference's faults that only hide the truth are mended; reference: they are kept."""
    resample: bool = False
    """Draw the particles anew at every reset."""
    target: str | None = None
    """SHAPE MATCH: star, I, M, T or the path of an image; None: the task's default."""
    variant: Literal["registered", "published"] | None = None
    """SLOT: matter of the registered environment (None too) or of the published training run (preset paper)."""

    def task_options(self) -> dict[str, Any]:
        """What of it belongs to the task, for `dittogym.make_spec`."""
        return {name: value for name in TASK_OPTIONS if (value := getattr(self, name)) is not None}

    @property
    def layout(self) -> Literal["image", "grid"]:
        """The action layout that these options amount to."""
        return self.action_layout or ("grid" if self.parity == "reference" else "image")

    def learned_at(self, tier: Tier) -> EnvironmentConfig:
        """The same place to learn in: other particles, evenly spread, no stale values, actions as here."""
        return replace(self, particles=tier, parity="clean", action_layout=self.layout)

    def judged_at(self, tier: Tier) -> EnvironmentConfig:
        """The same place to judge in, with other particles: at full size as it is, else as `learned_at`.

        With the reference's parity, fewer particles would be a lighter, softer and fainter robot.
        """
        return replace(self, particles=tier) if tier == "full" else self.learned_at(tier)


@dataclass(frozen=True)
class NetworkConfig:
    """Choices inside the networks."""

    interpolation: Interpolation = "half_pixel"
    """Bicubic upsampling: half_pixel (the environment's rule, blended on its patch) or aligned (the reference's)."""
    split: bool = False
    """Separate narrow encoders for observation and action (DIG)."""
    gate_scale: float = 1.0
    """Largest gate value (the reference: 0.25 with split encoders)."""


@dataclass(frozen=True)
class LearningConfig:
    """Soft actor-critic."""

    learning_rate: float = 3e-4
    """Adam's step size for actor and critics."""
    actor_rate: float | None = None
    """Adam's step size for the actor alone; None: the same as for the critics."""
    actor_start: int = 0
    """Environment steps of each level in which only the critics learn: a trained actor waits for their judgement."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Polyak factor of the target critics."""
    batch_size: int = 256
    """Transitions in an update."""
    buffer_size: int = 200_000
    """Transitions in the replay ring."""
    gradient_steps: int = 1
    """Updates after each batched step of num_envs robots."""
    update_start: int = 256
    """Updates begin when more transitions than this are stored."""
    anchor: float = 100.0
    """With refine: weight of the mean square by which actions differ from those of the policy that is refined."""
    reward_momentum: float = 0.99
    """Momentum of the running reward mean and variance."""
    max_grad_norm: float = 10.0
    """Largest gradient norm of one parameter tensor."""
    precision: Precision = "float32"
    """Of the networks in updates: float32, bfloat16, or auto (bfloat16 on CPUs with instructions for it)."""
    compile: bool = False
    """Run the updates through torch.compile."""
    warm_critic: bool = False
    """Each level begins with critics and reward statistics of the one before (the reference: anew)."""

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        if self.batch_size < 2:  # rewards are divided by their deviation in the batch
            raise ConfigError(f"batch_size: got {self.batch_size}, allowed 2 or more")
        at_least_one(
            buffer_size=self.buffer_size,
            gradient_steps=self.gradient_steps,
            update_start=self.update_start,
        )
        share(gamma=self.gamma, tau=self.tau, reward_momentum=self.reward_momentum)
        positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        if self.actor_rate is not None:
            positive(actor_rate=self.actor_rate)
        not_negative(actor_start=self.actor_start, anchor=self.anchor)


@dataclass(frozen=True)
class ReportConfig:
    """What is measured and written while training."""

    eval_every: int = 10_000
    """Environment steps between evaluations; 0: none."""
    eval_episodes: int = 5
    """Episodes of an evaluation and of the final table."""
    eval_deterministic: bool = False
    """Evaluate without action noise (the reference does so in SHAPE MATCH only)."""
    patience: int = 0
    """Evaluations in a row without a new best that end a stage early (the last: the run); 0: only steps count."""
    checkpoint_every: int = 1_000
    """Environment steps between checkpoints."""
    log_every: int = 500
    """Environment steps between rows of progress.csv and TensorBoard points."""
    video: bool = True
    """Record video.mp4 at the end."""
    video_every: int = 0
    """Environment steps between films of one episode in videos/; 0: none."""
    wandb: Literal["off", "offline", "online"] = "off"
    """Weights & Biases: off, offline (kept in the folder of the run), or online (uploads)."""
    wandb_project: str = "torchmpm"
    """Project there."""
