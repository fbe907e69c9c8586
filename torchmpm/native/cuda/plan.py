"""Which kernels a call launches, and on how many blocks: decided from sizes alone, without a GPU."""

from collections.abc import Callable
from typing import NamedTuple

from torchmpm.grid import PAD
from torchmpm.native.cuda.arguments import Kernel
from torchmpm.native.cuda.driver import Card

#: Threads of a block with the nodes of a robot in shared memory, and of the blocks that share a robot.
SHARED_THREADS, TEAM_THREADS = 512, 256
#: Particles that a thread keeps in registers without spilling them.
PER_THREAD = 4
#: Sides of windows in shared memory: a robot of the tasks needs more than the smaller, and none the larger.
SMALLEST_WINDOW, LARGEST_WINDOW = 48, 64


class Call(NamedTuple):
    """The sizes of a call."""

    adjoint: bool
    real: str  # "float" or "double"
    batch: int
    particles: int
    substeps: int
    resolution: int
    bodies: int
    rules: int
    kinds: int  # see arguments.kinds_of
    muscles: bool  # a field acts on a body

    @property
    def width(self) -> int:
        """Nodes of the whole window along an axis."""
        return self.resolution + 2 * PAD


class Pass(NamedTuple):
    """One launch: a kernel with a window of nodes, on some teams of blocks."""

    kernel: Kernel
    rows: int
    columns: int
    team: int  # blocks that share a robot
    teams: int
    shared_bytes: int  # of a block
    scratch_bytes: int  # of a team


#: How many blocks of a kernel with some shared memory a card can run at once.
Resident = Callable[[Kernel, int], int]


def passes(call: Call, card: Card, resident: Resident) -> list[Pass]:
    """The launches of a call: robots in shared memory where they fit, and those that do not in global memory.

    Raises:
        ValueError: The card cannot run one of the kernels.
    """
    small = shared_pass(call, card, resident)
    return [*([] if small is None else [small]), team_pass(call, card, resident)]


def shared_pass(call: Call, card: Card, resident: Resident) -> Pass | None:
    """One block for each robot, with its nodes in shared memory; ``None`` for those that do not fit there.

    Two bodies can be far apart, and a window that follows both would be as large as the whole grid.
    """
    per_thread = -(-call.particles // SHARED_THREADS)
    if call.bodies > 1 or per_thread > PER_THREAD:
        return None
    kernel = _kernel(call, shared=True, threads=SHARED_THREADS, per_thread=per_thread)
    for side in range(min(call.width, LARGEST_WINDOW), min(call.width, SMALLEST_WINDOW) - 1, -1):
        size = kernel.shared_bytes(side, side, call.bodies, call.rules)
        if size <= card.shared_bytes:
            scratch = kernel.scratch_bytes(side, side, call.resolution, call.particles, call.substeps)
            teams = min(call.batch, _at_least_one(kernel, resident(kernel, size)))
            return Pass(kernel, side, side, 1, teams, size, scratch)
    return None


def team_pass(call: Call, card: Card, resident: Resident) -> Pass:
    """Several blocks for each robot, with its nodes in global memory.

    Where there are few robots, more blocks share one: each thread has one particle.
    """
    few = call.batch * -(-call.particles // TEAM_THREADS) <= card.multiprocessors
    per_thread = 1 if few else PER_THREAD
    while True:
        team = -(-call.particles // (TEAM_THREADS * per_thread))
        kernel = _kernel(call, shared=False, threads=TEAM_THREADS, per_thread=per_thread)
        size = kernel.shared_bytes(call.width, call.width, call.bodies, call.rules)
        blocks = _at_least_one(kernel, resident(kernel, size))
        if team <= blocks:
            break
        per_thread *= 2  # beyond the registers, but it runs
    scratch = kernel.scratch_bytes(call.width, call.width, call.resolution, call.particles, call.substeps)
    return Pass(kernel, call.width, call.width, team, min(call.batch, blocks // team), size, scratch)


def _kernel(call: Call, *, shared: bool, threads: int, per_thread: int) -> Kernel:
    if call.adjoint:
        per_thread = 1  # it takes any number of particles, and need not be compiled for each
    return Kernel(call.adjoint, shared, call.real, threads, per_thread, call.kinds, call.muscles)


def _at_least_one(kernel: Kernel, blocks: int) -> int:
    if blocks < 1:
        raise ValueError(f"the card cannot run a block of {kernel.threads} threads of {kernel.name}")
    return blocks
