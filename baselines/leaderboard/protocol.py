"""The protocols of the leaderboard. A published one never changes; another way to evaluate gets a new name."""

from dataclasses import dataclass, replace

from baselines.registry import configure
from cfp.config import RunConfig
from cfp.errors import ConfigError
from cfp.sections import EnvironmentConfig
from dittogym import make_spec


@dataclass(frozen=True)
class FixedProtocol:
    """How every policy of the leaderboard is evaluated."""

    version: str
    """Name, as in ``--protocol``."""
    tasks: tuple[str, ...]
    """Tasks, each with a ranking of its own; all of them define success."""
    environment: EnvironmentConfig
    """The same for all policies, whatever they were trained in, but for the orientation of the action array."""
    seeds: range
    """Seeds of the layouts, that is of the initial particle positions; one episode is played on each."""
    counts: tuple[int, ...]
    """The robot's particles on each layout, in tasks that draw no positions at random and so start alike with every
    seed. Another count fills the same body in another way."""
    deterministic: bool
    """Whether policies act without noise. Observations never have any."""
    device: str
    """Where the physics runs."""

    def config(self, task: str, seed: int, environment: EnvironmentConfig) -> RunConfig:
        """Options of an episode: of a task, on the layout of a seed, in this ``environment`` but for the particles."""
        if not any(body.shape.draws for body in make_spec(task).bodies):
            environment = replace(environment, particles=self.counts[self.seeds.index(seed)])
        return replace(configure({"algo": "zero", "task": task}), device=self.device, environment=environment)

    def check_task(self, task: str) -> None:
        """Check that a task belongs to the protocol."""
        if task not in self.tasks:
            raise ConfigError(f"task must be one of {', '.join(self.tasks)} under {self.version}, got {task!r}")


V1 = FixedProtocol(
    version="v1",
    tasks=("shapematch", "run", "grow", "kick", "dig", "obstacle", "catch", "slot"),
    # Lite particles, because the paper's particle counts take a laptop about ten times as long. The rest is as in the
    # environments of these versions, written down because their defaults may change.
    environment=EnvironmentConfig(
        num_envs=1, particles="lite", substeps=100, dt=1e-4, dtype="float32", parity="clean", resample=False
    ),
    # A run with seed s trains, chooses and evaluates its policy on seeds from s to s + 30,000, where s is at most 2^31.
    seeds=range(3_000_000_000, 3_000_000_008),
    counts=tuple(range(2000, 1680, -40)),
    deterministic=True,  # noise is for exploration; without it an episode depends on the policy and the layout only
    device="cpu",  # there an episode does not depend on those that are played beside it, to the last bit
)

#: All protocols by name.
PROTOCOLS = {protocol.version: protocol for protocol in (V1,)}
