"""Transforms of torch.func over the solver: one gradient per simulation, and a derivative in one direction."""

import torch
from torch.func import grad, jvp, vmap

import torchmpm

gel = torchmpm.VonMises(mu=500.0, lam=50.0, yield_stress=62.0)
body = torchmpm.Body(200, gel, mass=2.0, muscle=True)
solver = torchmpm.Solver(torchmpm.Grid(32), bodies=(body,), gravity=(0.0, -9.0), backend="eager")
disc = torchmpm.sampling.disc(torchmpm.sampling.sobol(200, seed=0), centre=(0.5, 0.5), radius=0.1)
start = torchmpm.ParticleState.at_rest(torch.tensor(disc, dtype=torch.float64))


def width(pull):
    """Width of the body after muscles along x pulled with some Pa for 2 ms."""
    along_x = pull.expand(1, 1, 32, 32)
    actuation = torch.cat([along_x, torch.zeros_like(along_x)], dim=1)
    return solver.step(start, actuation, substeps=20).x[..., 0].std()


pulls = torch.tensor([0.0, 40.0, 80.0], dtype=torch.float64)
slopes = vmap(grad(width))(pulls)
_, tangent = jvp(width, (pulls[1],), (torch.ones((), dtype=torch.float64),))
torch.testing.assert_close(tangent, slopes[1])
print("width per Pa:", " ".join(f"{slope:.3e}" for slope in slopes.tolist()), "m")
