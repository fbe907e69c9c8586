"""The sequences of kernels behind the operators of torch: a step, and its adjoint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmpm.native.cuda.adjoint import adjoint_pass
from torchmpm.native.cuda.grid import ADJOINT, SUMS, node_adjoint, node_velocities, rule_codes
from torchmpm.native.cuda.step import particles_pass
from torchmpm.native.cuda.tables import BodyPart, Tables
from torchmpm.native.cuda.transfer import NOWHERE
from torchmpm.native.pack import ROWS

#: Particles, or nodes, of a program: one per thread.
BLOCK = 128
#: Programs for the nodes of all simulations together, at most, unless there are more simulations.
NODE_PROGRAMS = 4096


@dataclass(frozen=True, eq=False)
class Inputs:
    """Tensors of a call, contiguous and on one device; see :func:`torchmpm.native.ops.native_step`."""

    planes: Tensor
    field: Tensor | None
    origin: Tensor
    gravity: Tensor
    values: Tensor
    shift: Tensor
    result_bar: Tensor | None = None


def launch(kernel: Any, programs: int, *arguments: Any, **constants: Any) -> None:
    """Run a kernel, on the GPU or in Triton's interpreter."""
    kernel[(programs,)](*arguments, **constants, BLOCK=BLOCK, num_warps=BLOCK // 32, enable_fp_fusion=True)


class Program:
    """What a step and its adjoint share: buffers, and the launches of one substep.

    Sums on the nodes are zero between launches. A box of nodes per substep and simulation starts empty, widens with the
    particles, and tells the passes over the nodes where to read.
    """

    def __init__(self, inputs: Inputs, tables: Tables, substeps: int, numbers: int) -> None:
        planes = inputs.planes
        self.inputs, self.tables, self.substeps = inputs, tables, substeps
        self.batch, self.particles = planes.shape[1:]
        self.cells = tables.width**2
        self.sums = planes.new_zeros(self.batch * self.cells * numbers)
        self.boxes = torch.empty(substeps, self.batch, 4, dtype=torch.int32, device=planes.device)
        self.codes = torch.empty(self.batch * self.cells if tables.slots else 1, dtype=torch.int32, device=planes.device)

    def prepare(self) -> None:
        """Empty the boxes and find the rule of each node."""
        self.boxes.fill_(NOWHERE.value)
        if not self.tables.slots:
            return
        rules, programs = self.tables.rules, -(-self.cells // BLOCK)
        sizes = (len(rules), self.tables.width, self.cells, programs)
        launch(rule_codes, self.batch * programs, self.codes, rules, self.inputs.shift, *sizes)

    def move(self, slots: tuple[Tensor, Tensor, Tensor], velocity: Tensor, box: Tensor, **flags: bool) -> None:
        """Launch :func:`torchmpm.native.cuda.step.particles_pass` for each body; ``slots`` are its three buffers."""
        for body in self.tables.bodies:
            constants, sizes, kind = self.of_body(body)
            launch(
                particles_pass,
                self.batch * -(-body.count // BLOCK),
                *slots,
                self.sums,
                velocity,
                box,
                *constants,
                *sizes,
                **kind,
                **flags,
            )

    def of_body(self, body: BodyPart) -> tuple[tuple[Tensor, ...], tuple[int, ...], dict[str, Any]]:
        """What every pass over the particles of a body wants to know: tensors, sizes, and compile-time constants."""
        inputs, tables = self.inputs, self.tables
        field = inputs.origin if inputs.field is None else inputs.field
        tensors = (field, inputs.origin, inputs.values, tables.constants, tables.constants[body.bounds :])
        values_batch, columns = inputs.values.shape[1:]
        sizes = (self.particles, self.batch * self.particles, body.first, body.count, -(-body.count // BLOCK))
        sizes += (body.column, columns, values_batch, tables.resolution, tables.width)
        muscle = body.muscle and inputs.field is not None
        return tensors, sizes, {"KIND": body.kind, "VARYING": body.varying, "MUSCLE": muscle}

    def nodes(self, kernel: Any, *buffers: Tensor, bars: tuple[Tensor, ...] = ()) -> None:
        """Launch a pass over the nodes: ``buffers`` are sums, answers, and the box of the substep."""
        tables, inputs = self.tables, self.inputs
        programs = max(1, min(-(-self.cells // BLOCK), NODE_PROGRAMS // self.batch))
        tensors = (*buffers, self.codes, tables.rules, inputs.gravity, *bars, tables.constants)
        sizes = (tables.resolution, tables.width, programs)
        launch(kernel, self.batch * programs, *tensors, *sizes, SLOTS=tables.slots)


class Forward(Program):
    """A step: a pass over the particles, then over the nodes, for each substep."""

    def __init__(self, inputs: Inputs, tables: Tables, substeps: int) -> None:
        super().__init__(inputs, tables, substeps, SUMS.value)
        self.state = torch.empty_like(inputs.planes)
        self.velocity = inputs.planes.new_empty(self.batch * self.cells * 2)

    def run(self) -> None:
        """Launch everything; allocates nothing."""
        self.state.copy_(self.inputs.planes)
        self.prepare()
        state = (self.state, self.state, self.state)
        for s in range(self.substeps):
            self.move(state, self.velocity, self.boxes[s], ARRIVE=s > 0, LEAVE=True, TAPE=False)
            self.nodes(node_velocities, self.sums, self.velocity, self.boxes[s])
        self.move(state, self.velocity, self.boxes[0], ARRIVE=True, LEAVE=False, TAPE=False)

    def results(self) -> tuple[Tensor, ...]:
        """The planes of the new state."""
        return (self.state,)


class Backward(Program):
    """The adjoint of a step: replays its substeps onto a tape of states, then goes back through them.

    What the nodes were is not on the tape: going back, mass and momentum are added up once more.
    """

    def __init__(self, inputs: Inputs, tables: Tables, substeps: int, wants_field: bool, wants_values: bool) -> None:
        super().__init__(inputs, tables, substeps, ADJOINT.value)
        planes, nothing = inputs.planes, inputs.planes.new_empty(0)
        self.tape = planes.new_empty(substeps, *planes.shape)
        self.answers = planes.new_empty(self.batch * self.cells * ADJOINT.value)
        self.bars, self.origin_bar, self.gravity_bar = (
            torch.empty_like(t) for t in (planes, inputs.origin, inputs.gravity)
        )
        self.field_bar = nothing if inputs.field is None or not wants_field else torch.empty_like(inputs.field)
        self.values_bar = planes.new_empty(ROWS, *planes.shape[1:]) if wants_values else nothing.clone()

    def run(self) -> None:
        """Launch everything; allocates nothing."""
        assert self.inputs.result_bar is not None
        self.prepare()
        self.replay()
        self.boxes.fill_(NOWHERE.value)
        self.bars.copy_(self.inputs.result_bar)
        for bar in (self.field_bar, self.values_bar, self.origin_bar, self.gravity_bar):
            bar.zero_()
        for s in range(self.substeps, -1, -1):
            self.go_back(s)

    def replay(self) -> None:
        """Fill the tape with the states at the start of the substeps."""
        tape = self.tape
        tape[0].copy_(self.inputs.planes)
        for s in range(self.substeps):
            slots = (tape[max(s - 1, 0)], tape[s], tape[min(s + 1, self.substeps - 1)])
            self.move(slots, self.answers, self.boxes[s], ARRIVE=s > 0, LEAVE=s < self.substeps - 1, TAPE=True)
            if s < self.substeps - 1:
                self.nodes(node_velocities, self.sums, self.answers, self.boxes[s])

    def go_back(self, substep: int) -> None:
        """Finish the adjoint of the substep that starts at ``substep``, and begin that of the one before."""
        last = self.substeps - 1
        state, before = self.tape[min(substep, last)], self.tape[max(substep - 1, 0)]
        box, bars = self.boxes[max(substep - 1, 0)], (self.bars, self.values_bar, self.field_bar, self.origin_bar)
        flags = {"WANT_FIELD": self.field_bar.numel() > 0, "WANT_VALUES": self.values_bar.numel() > 0}
        flags |= {"FINISH": substep <= last, "BEGIN": substep > 0}
        for body in self.tables.bodies:
            constants, sizes, kind = self.of_body(body)
            programs = self.batch * -(-body.count // BLOCK)
            buffers = (state, before, *bars, self.sums, self.answers, box, *constants)
            launch(adjoint_pass, programs, *buffers, *sizes, **kind, **flags)
        if substep > 0:
            self.nodes(node_adjoint, self.sums, self.answers, box, bars=(self.gravity_bar,))

    def results(self) -> tuple[Tensor, ...]:
        """Derivatives in planes, field, origin, gravity and values."""
        return self.bars, self.field_bar, self.origin_bar, self.gravity_bar, self.values_bar
