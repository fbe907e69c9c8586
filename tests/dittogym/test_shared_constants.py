"""A material that is learned, in an environment where one simulation fails; beside ``tests/dittogym``, see core.py."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import dittogym
from dittogym import core
from torchmpm import Elastic, tree
from torchmpm.backends import compiler_found


class Learned(torch.nn.Module):
    """A law of somebody else, which only the eager backend runs."""

    def __init__(self, mu: Tensor) -> None:
        super().__init__()
        self.mu = torch.nn.Parameter(mu)

    def return_map(self, F: Any, Jp: Tensor) -> Any:
        return F, Jp

    def stress(self, F: Any, Jp: Tensor) -> Any:
        return Elastic(self.mu, 50.0).stress(F, Jp)

    def energy(self, F: Any, Jp: Tensor) -> Any:
        return Elastic(self.mu, 50.0).energy(F, Jp)

    def stiffness(self) -> Any:
        return Elastic(self.mu, 50.0).stiffness()


BACKENDS = [
    pytest.param("native", marks=pytest.mark.skipif(not compiler_found(), reason="no C++ compiler")),
    *("eager", "module"),
]


@pytest.mark.parametrize("actions", [False, True], ids=["material", "material and actions"])
@pytest.mark.parametrize("name", ["F", "v", "x"])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_broken_simulation_does_not_spoil_the_gradient_of_a_material(backend: str, name: str, actions: bool) -> None:
    """It is that of the others alone; and the broken one is not hidden."""
    start = torch.tensor(650.0, dtype=torch.float64)
    law: Any = Learned(start) if backend == "module" else Elastic(start.requires_grad_(), 50.0)
    spec = dittogym.make_spec("run")
    spec = replace(spec, robot=replace(spec.robot, material=law))
    options: dict[str, Any] = {"particles": 100, "substeps": 12, "dtype": "float64"}
    env = dittogym.TorchEnv(spec, 2, backend="eager" if backend == "module" else backend, **options)
    env.reset(seed=0)
    sound, drive = env.env_state, torch.linspace(-1.0, 1.0, 256, dtype=torch.float64).reshape(2, 2, 8, 8)
    broken = replace(sound, particles=sound.particles.clone())
    getattr(broken.particles, name)[0, ::7] = math.nan
    gradients, ends = [], []
    for state, part in ((broken, slice(0, 2)), (sound, slice(1, 2))):
        action = drive[part].clone().requires_grad_(actions)
        after, _ = core.transition(env.model, tree.map(lambda t, part=part: t[part], state), action)
        loss = after.particles.x[-1].square().sum() + after.particles.F[-1].square().sum()
        gradients += torch.autograd.grad(loss, law.mu)
        ends.append(after.particles)
    assert gradients[1] != 0
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=0)
    assert torch.equal(ends[0].x[1], ends[1].x[0])
    assert not all(plane[0].isfinite().all() for plane in ends[0].components())
