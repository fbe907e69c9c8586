"""Which kernels a call launches, and on how many blocks: decided from sizes alone, without a GPU."""

from collections.abc import Callable
from typing import NamedTuple

from torchmpm.grid import PAD
from torchmpm.native.cuda.arguments import Kernel
from torchmpm.native.cuda.driver import Card

#: Threads of a block with the nodes of a robot in shared memory, forward and in the adjoint, and of the blocks that
#: share a robot. More of them would spill registers, in double precision more than half as many.
SHARED_THREADS, ADJOINT_THREADS, TEAM_THREADS = 512, 384, 256
#: Particles that a thread keeps in registers without spilling them. Of more, it keeps none there.
PER_THREAD = 4
#: Side of a window in shared memory below which no robot would fit.
SMALLEST_WINDOW = 16
#: Robots of up to so many particles get a block each. So do larger ones that keep this share of a card busy: additions
#: in shared memory are so much faster that the rest of it may be idle. Estimates, which no card has confirmed yet.
SMALL, BUSY = 4096, 1 / 8


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
        """Nodes of the whole grid along an axis."""
        return self.resolution + 2 * PAD

    def are_few(self, card: Card) -> bool:
        """Whether a block for each robot would leave most of the card idle."""
        return self.batch < BUSY * card.multiprocessors


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
    """One block for each robot, with its nodes in shared memory; ``None`` where blocks had better share a robot.

    The window is as large as the memory allows: two bodies may be far apart. Robots that do not fit are given up before
    their first substep.
    """
    if call.are_few(card) and call.particles > SMALL:
        return None
    threads = (ADJOINT_THREADS if call.adjoint else SHARED_THREADS) // (2 if call.real == "double" else 1)
    kernel = _kernel(call, shared=True, threads=threads, per_thread=-(-call.particles // threads))
    for side in range(call.width, min(call.width, SMALLEST_WINDOW) - 1, -1):
        size = kernel.shared_bytes(side, side, call.bodies, call.rules)
        if size <= card.shared_bytes:
            scratch = kernel.scratch_bytes(side, side, call.resolution, call.particles, call.substeps)
            teams = min(call.batch, _at_least_one(kernel, resident(kernel, size)))
            return Pass(kernel, side, side, 1, teams, size, scratch)
    return None


def team_pass(call: Call, card: Card, resident: Resident) -> Pass:
    """Several blocks for each robot, with its nodes in global memory.

    Where there are few robots, and the card has as many threads, each has one particle, which it keeps in registers.
    """
    few, width = call.are_few(card), call.width
    team = -(-call.particles // (TEAM_THREADS if few else TEAM_THREADS * PER_THREAD))
    for per_thread in (1, 0) if few else (0,):
        kernel = _kernel(call, shared=False, threads=TEAM_THREADS, per_thread=per_thread)
        size = kernel.shared_bytes(width, width, call.bodies, call.rules)
        blocks = _at_least_one(kernel, resident(kernel, size))
        if team <= blocks:
            break
    team = min(team, blocks)
    scratch = kernel.scratch_bytes(width, width, call.resolution, call.particles, call.substeps)
    return Pass(kernel, width, width, team, min(call.batch, blocks // team), size, scratch)


def _kernel(call: Call, *, shared: bool, threads: int, per_thread: int) -> Kernel:
    if call.adjoint or per_thread > PER_THREAD:
        per_thread = 0  # any number
    return Kernel(call.adjoint, shared, call.real, threads, per_thread, call.kinds, call.muscles)


def _at_least_one(kernel: Kernel, blocks: int) -> int:
    if blocks < 1:
        raise ValueError(f"the card cannot run a block of {kernel.threads} threads of {kernel.name}")
    return blocks
