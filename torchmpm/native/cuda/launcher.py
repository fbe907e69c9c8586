"""Runs the CUDA kernels on tensors: what :mod:`torchmpm.native.kernels` calls there."""

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from torchmpm.native.cuda.arguments import COUNTERS, Arguments, Kernel, kinds_of
from torchmpm.native.cuda.driver import Cuda, Driver, Launch
from torchmpm.native.cuda.plan import Call, Pass, passes
from torchmpm.native.tables import COTANGENTS, BodyTable, Inputs, RuleTable, Tables

REAL = {torch.float32: "float", torch.float64: "double"}


class Launcher:
    """Launches kernels through a driver; plans what it launches once for all calls of the same sizes.

    A call does not wait for the device. Which robots a kernel gave up, the next one reads there.
    """

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._plan = functools.lru_cache(maxsize=256)(self._make_plan)

    def forward(self, inputs: Inputs, tables: Tables, substeps: int) -> Tensor:
        """Components (13, B, N) after some substeps."""
        result = torch.empty_like(inputs.components)
        self._run(inputs, tables, substeps, result=result)
        return result

    def backward(
        self, inputs: Inputs, tables: Tables, substeps: int, wants_field: bool, wants_values: bool
    ) -> tuple[Tensor, ...]:
        """Replay the substeps, then go back; derivatives as :meth:`Inputs.empty_cotangents` lists them."""
        bars = inputs.empty_cotangents(wants_field, wants_values)
        self._run(inputs, tables, substeps, **dict(zip(COTANGENTS, bars, strict=True)))
        return bars

    def _run(self, inputs: Inputs, tables: Tables, substeps: int, **outputs: Tensor) -> None:
        _, batch, particles = inputs.components.shape
        device, bodies = inputs.components.device, tables.bodies[: tables.num_bodies]
        call = Call(
            adjoint=inputs.result_bar is not None,
            real=REAL[inputs.components.dtype],
            batch=batch,
            particles=particles,
            substeps=substeps,
            resolution=tables.resolution,
            bodies=tables.num_bodies,
            rules=tables.num_rules,
            kinds=kinds_of(bodies),
            muscles=inputs.field is not None and any(body.muscle for body in bodies),
        )
        plan = self._plan(call, device)
        body_table, rule_table = (_upload(content, device) for content in _contents(tables))
        status = torch.empty(batch, dtype=torch.int32, device=device) if len(plan) > 1 else None
        tensors = inputs._asdict() | outputs | {"bodies": body_table, "rules": rule_table, "status": status}
        sizes = ("resolution", "num_bodies", "num_rules", "h", "dt", "margin", "extent", "damping")
        common: dict[str, Any] = {
            "batch": batch,
            "particles": particles,
            "substeps": substeps,
            "values_batch": inputs.values.shape[1],
            "value_columns": inputs.values.shape[2],
            **{name: getattr(tables, name) for name in (*sizes, "mass_epsilon", "stretch_floor")},
            **{name: tensor.data_ptr() for name, tensor in tensors.items() if tensor is not None and tensor.numel()},
        }
        for one, function in plan:
            scratch, teams = _scratch(one, device)
            meetings = 0 if one.kernel.shared else teams * COUNTERS  # blocks that share no robot do not meet
            counters = torch.zeros(meetings, dtype=torch.int32, device=device)
            arguments = Arguments(
                **common,
                rows=one.rows,
                columns=one.columns,
                team=one.team,
                scratch_bytes=one.scratch_bytes,
                scratch=scratch.data_ptr(),
                counters=counters.data_ptr(),
            )
            launch = Launch(teams * one.team, one.kernel.threads, one.shared_bytes, not one.kernel.shared)
            self.driver.launch(function, launch, arguments, device)
            del scratch, counters  # the next launch on this stream may have their memory

    def _make_plan(self, call: Call, device: torch.device) -> list[tuple[Pass, Any]]:
        def resident(kernel: Kernel, shared_bytes: int) -> int:
            return self.driver.resident(self.driver.load(kernel, device), kernel.threads, shared_bytes, device)

        return [(one, self.driver.load(one.kernel, device)) for one in passes(call, self.driver.card(device), resident)]


def _scratch(one: Pass, device: torch.device) -> tuple[Tensor, int]:
    """Memory for the teams of a launch, and their number: fewer of them where there is too little."""
    teams = one.teams
    while True:
        try:
            return torch.empty(teams * one.scratch_bytes, dtype=torch.uint8, device=device), teams
        except torch.OutOfMemoryError as error:
            if teams == 1:
                size = f"{one.scratch_bytes / 1e9:.2g} GB"
                raise torch.OutOfMemoryError(f"backend 'native' is out of memory: a robot needs {size}") from error
            teams = (teams + 1) // 2


def _contents(tables: Tables) -> tuple[bytes, bytes]:
    """The tables of the bodies and of the rules."""
    return (
        ctypes.string_at(tables.bodies, tables.num_bodies * ctypes.sizeof(BodyTable)),
        ctypes.string_at(tables.rules, tables.num_rules * ctypes.sizeof(RuleTable)),
    )


@functools.lru_cache(maxsize=256)
def _upload(content: bytes, device: torch.device) -> Tensor:
    """Bytes on a device; kept, so that a step copies nothing there. Other streams need not wait for the copy."""
    with torch.inference_mode(False):
        return torch.tensor(list(content), dtype=torch.uint8, device=device)


#: Launches on GPUs.
CUDA = Launcher(Cuda())
