"""The sequences of kernels behind the operators of torch: a step, and its adjoint."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmpm.grid import PAD
from torchmpm.native.cuda.adjoint import begin_adjoint, finish_adjoint
from torchmpm.native.cuda.grid import ADJOINT, SUMS, node_adjoint, node_velocities, rule_codes
from torchmpm.native.cuda.step import particles_pass
from torchmpm.native.cuda.tables import DeviceTables
from torchmpm.native.cuda.transfer import NOWHERE
from torchmpm.native.tables import Inputs

#: Particles, or nodes, of a program: one per thread.
BLOCK = 128
#: Programs for the nodes of all simulations together, at most, unless there are more simulations.
NODE_PROGRAMS = 4096


def launch(kernel: Any, programs: int, *arguments: Any, **constants: Any) -> None:
    """Run a kernel, on the GPU or in Triton's interpreter."""
    kernel[(programs,)](*arguments, **constants, BLOCK=BLOCK, num_warps=BLOCK // 32, enable_fp_fusion=True)


class Program:
    """What a step and its adjoint share: buffers, and the launches of one substep.

    Sums on the nodes are zero between launches. A box of nodes per substep and simulation starts empty, widens with the
    particles, and tells the passes over the nodes where to read.
    """

    results: tuple[Tensor, ...]  # buffers with what the last run has found

    def __init__(self, inputs: Inputs, tables: DeviceTables, substeps: int, numbers: int) -> None:
        planes, self.width = inputs.components, tables.tables.resolution + 2 * PAD
        self.inputs, self.device_tables, self.tables, self.substeps = inputs, tables, tables.tables, substeps
        self.batch, self.particles, self.cells = *planes.shape[1:], self.width**2
        self.sums = planes.new_zeros(self.batch * self.cells * numbers)
        self.boxes = torch.empty(substeps, self.batch, 4, dtype=torch.int32, device=planes.device)
        nodes = self.batch * self.cells if tables.slots else 1
        self.codes = torch.empty(nodes, dtype=torch.int32, device=planes.device)

    def run(self) -> tuple[Tensor, ...]:
        """Launch everything, and return the results; allocates nothing."""
        raise NotImplementedError

    def prepare(self) -> None:
        """Empty the boxes and find the rule of each node."""
        self.boxes.fill_(NOWHERE.value)
        if not self.device_tables.slots:
            return
        rules, programs = self.device_tables.rules, -(-self.cells // BLOCK)
        sizes = (len(rules), self.width, self.cells, programs)
        launch(rule_codes, self.batch * programs, self.codes, rules, self.inputs.shift, *sizes)

    def over_particles(self, kernel: Any, *buffers: Tensor, **flags: bool) -> None:
        """Launch a pass over the particles for each body."""
        inputs, tables = self.inputs, self.tables
        # Without actuation the field is not read, but a kernel needs some pointer.
        field = inputs.origin if inputs.field is None else inputs.field
        values_batch, columns = inputs.values.shape[1:]
        for k, body in enumerate(self.device_tables.bodies):
            blocks = -(-body.count // BLOCK)
            constants = (self.device_tables.constants, self.device_tables.bounds_of(k))
            sizes = [self.particles, self.batch * self.particles, body.first, body.count, blocks]
            sizes += [body.column, columns, values_batch, tables.resolution, self.width]
            muscle = body.muscle and inputs.field is not None
            kind = {"KIND": body.kind, "VARYING": body.varying, "MUSCLE": muscle}
            tensors = (*buffers, field, inputs.origin, inputs.values, *constants)
            launch(kernel, self.batch * blocks, *tensors, *sizes, **kind, **flags)

    def advance(self, states: Sequence[Tensor], velocity: Tensor, *, TAPE: bool) -> None:
        """From the planes in the first state to those in the last, a substep each; without ``TAPE`` all are one."""
        last, flags = len(states) - 1, {"TAPE": TAPE}
        for s in range(last):
            around, box = (states[max(s - 1, 0)], states[s], states[s + 1]), self.boxes[s]
            self.over_particles(particles_pass, *around, self.sums, velocity, box, FINISH=s > 0, BEGIN=True, **flags)
            self.over_nodes(node_velocities, self.sums, velocity, box)
        if last > 0:
            end = (states[last - 1], states[last], states[last], self.sums, velocity, self.boxes[0])
            self.over_particles(particles_pass, *end, FINISH=True, BEGIN=False, **flags)

    def over_nodes(self, kernel: Any, *buffers: Tensor, bars: tuple[Tensor, ...] = ()) -> None:
        """Launch a pass over the nodes: ``buffers`` are sums, velocities or their derivatives, and a box."""
        tables, inputs = self.tables, self.inputs
        programs = max(1, min(-(-self.cells // BLOCK), NODE_PROGRAMS // self.batch))
        tensors = (*buffers, self.codes, self.device_tables.rules, inputs.gravity, *bars, self.device_tables.constants)
        sizes = (tables.resolution, self.width, programs)
        launch(kernel, self.batch * programs, *tensors, *sizes, SLOTS=self.device_tables.slots)


class Forward(Program):
    """A step: a pass over the particles, then over the nodes, for each substep."""

    def __init__(self, inputs: Inputs, tables: DeviceTables, substeps: int) -> None:
        super().__init__(inputs, tables, substeps, SUMS.value)
        self.state = torch.empty_like(inputs.components)
        self.velocity = inputs.components.new_empty(self.batch * self.cells * 2)
        self.results = (self.state,)

    def run(self) -> tuple[Tensor, ...]:
        """Take all substeps."""
        self.state.copy_(self.inputs.components)
        self.prepare()
        self.advance([self.state] * (self.substeps + 1), self.velocity, TAPE=False)
        return self.results


class Backward(Program):
    """The adjoint of a step: replays its substeps onto a tape of states, then goes back through them.

    What the nodes were is not on the tape: going back, mass and momentum are added up once more.
    """

    def __init__(
        self, inputs: Inputs, tables: DeviceTables, substeps: int, wants_field: bool, wants_values: bool
    ) -> None:
        super().__init__(inputs, tables, substeps, ADJOINT.value)
        planes = inputs.components
        length = -(-planes.numel() // 4) * 4  # whole fours, see tables
        self.tape = planes.new_empty(substeps, length)[:, : planes.numel()].unflatten(1, planes.shape)
        self.node_bars = planes.new_empty(self.batch * self.cells * ADJOINT.value)
        self.results = inputs.empty_cotangents(wants_field, wants_values)
        self.bars, self.field_bar, self.origin_bar, self.gravity_bar, self.values_bar = self.results

    def run(self) -> tuple[Tensor, ...]:
        """Take all substeps, then go back."""
        assert self.inputs.result_bar is not None
        self.prepare()
        self.tape[0].copy_(self.inputs.components)
        self.advance(self.tape.unbind(), self.node_bars, TAPE=True)
        self.boxes.fill_(NOWHERE.value)
        self.bars.copy_(self.inputs.result_bar)
        for bar in self.results[1:]:
            bar.zero_()
        wants = {"WANT_FIELD": self.field_bar.numel() > 0, "WANT_VALUES": self.values_bar.numel() > 0}
        buffers = (self.bars, self.values_bar, self.field_bar, self.origin_bar, self.node_bars)
        for s in range(self.substeps - 1, -1, -1):
            self.over_particles(begin_adjoint, self.tape[s], self.bars, self.sums, self.boxes[s])
            self.over_nodes(node_adjoint, self.sums, self.node_bars, self.boxes[s], bars=(self.gravity_bar,))
            self.over_particles(finish_adjoint, self.tape[s], *buffers, **wants)
        return self.results
