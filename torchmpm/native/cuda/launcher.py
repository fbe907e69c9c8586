"""Runs the CUDA kernels on tensors: the operators of :mod:`torchmpm.native.kernels` there."""

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.native.cuda.arguments import COUNTERS, Arguments
from torchmpm.native.cuda.driver import Cuda, Driver, Launch
from torchmpm.native.cuda.plan import Call, Pass, passes
from torchmpm.native.tables import BodyTable, Cotangents, Inputs, RuleTable, tables_of

REAL = {torch.float32: "float", torch.float64: "double"}
#: Derivatives that the adjoint writes, in the order of :class:`Cotangents`.
COTANGENTS = ("components_bar", "field_bar", "origin_bar", "gravity_bar", "values_bar")


class Launcher:
    """Launches kernels through a driver; plans what it launches once for all calls of the same sizes.

    A call does not wait for the device. Which robots a kernel gave up, the next one reads there.
    """

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._plan = functools.lru_cache(maxsize=256)(self._make_plan)

    def forward(self, *arguments: Any) -> Tensor:
        """Advance all simulations; see :func:`torchmpm.native.kernels.native_step`."""
        *tensors, handle, substeps = arguments
        inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
        result = torch.empty_like(inputs.components)
        self._run(inputs, handle, substeps, result=result)
        return result

    def backward(self, *arguments: Any) -> Cotangents:
        """Adjoint of :meth:`forward`; see :func:`torchmpm.native.kernels.native_step_backward`."""
        *tensors, handle, substeps, wants_field, wants_values = arguments
        inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
        cotangents = inputs.empty_cotangents(wants_field, wants_values)
        self._run(inputs, handle, substeps, **dict(zip(COTANGENTS, cotangents, strict=True)))
        return cotangents

    def _run(self, inputs: Inputs, handle: int, substeps: int, **outputs: Tensor) -> None:
        _, batch, particles = inputs.components.shape
        device, tables = inputs.components.device, tables_of(handle)
        muscles = inputs.field is not None and any(body.muscle for body in tables.bodies[: tables.num_bodies])
        real = REAL[inputs.components.dtype]
        call = Call(inputs.result_bar is not None, real, batch, particles, substeps, muscles)
        plan = self._plan(call, handle, device)
        bodies, rules = _device_tables(handle, device)
        status = torch.empty(batch, dtype=torch.int32, device=device) if len(plan) > 1 else None
        tensors = inputs._asdict() | outputs | {"bodies": bodies, "rules": rules, "status": status}
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
            counters = torch.zeros(teams * COUNTERS, dtype=torch.int32, device=device)
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

    def _make_plan(self, call: Call, handle: int, device: torch.device) -> list[tuple[Pass, Any]]:
        load = functools.partial(self.driver.load, device=device)
        resident = self.driver.resident
        return [
            (one, load(one.kernel))
            for one in passes(
                call,
                tables_of(handle),
                self.driver.card(device),
                lambda kernel, size: resident(load(kernel), kernel.threads, size, device),
            )
        ]


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


@functools.lru_cache(maxsize=256)
def _device_tables(handle: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The bodies and the rules of a handle on a device; kept, so that a step copies nothing there."""
    tables = tables_of(handle)
    contents = (
        ctypes.string_at(tables.bodies, tables.num_bodies * ctypes.sizeof(BodyTable)),
        ctypes.string_at(tables.rules, tables.num_rules * ctypes.sizeof(RuleTable)),
    )
    with torch.inference_mode(False):
        bodies, rules = (_upload(content, device) for content in contents)
    return bodies, rules


def _upload(content: bytes, device: torch.device) -> Tensor:
    host = torch.tensor(list(content), dtype=torch.uint8, device="cpu")
    return host.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else host


#: Launches on CUDA.
launcher = Launcher(Cuda())
