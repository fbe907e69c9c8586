r"""
Your first simulation
=====================

This tutorial simulates a ball of gel that falls onto a table and bounces. A `torchmpm.ParticleState` holds the state
of all particles. A `torchmpm.Solver` describes everything that does not change; its method ``step`` returns a new
state.

Units are SI units in two dimensions: metres, seconds, kilograms. The simulation window is one metre wide, and a
substep lasts 0.1 ms.
"""

# %%
# The scene
# ---------
#
# The scene consists of an elastic body of 2,000 particles, a table with its top at 0.2 m, and gravity.
# `torchmpm.lame` computes the Lamé parameters, in Pa, from Young's modulus and Poisson's ratio. The mass and volume
# of a body are those of one particle; here they give a density of 1,000 kg/m².

import itertools
import math

import matplotlib.pyplot as plt
import torch

import torchmpm

COUNT, RADIUS = 2000, 0.08
area = math.pi * RADIUS**2
mu, lam = torchmpm.lame(young=4e4, poisson=0.3)
gel = torchmpm.Elastic(mu, lam)
ball = torchmpm.Body(COUNT, gel, mass=1000.0 * area / COUNT, volume=area / COUNT)
table = torchmpm.VelocityRule("-y", j=(None, 25))  # 26 nodes, 1/128 m apart; without friction
solver = torchmpm.Solver(torchmpm.Grid(128), bodies=(ball,), gravity=(0.0, -9.8), rules=(table,))

# %%
# The initial positions are points of the unit square, mapped to a disc. Points of a Sobol sequence are more evenly
# spread than random ones.

points = torchmpm.sampling.disc(torchmpm.sampling.sobol(COUNT, seed=0), centre=(0.5, 0.45), radius=RADIUS)
state = torchmpm.ParticleState.at_rest(torch.as_tensor(points))  # float64, a batch of one
print(state.x.shape, state.F.shape)

# %%
# The simulation
# --------------
#
# Each step has 50 substeps and simulates 5 ms. `torchmpm.diagnostics` computes the energies.

times, heights, energies, pictures = [], [], [], []
for step in range(101):
    times.append(step * 50 * solver.dt)
    heights.append(state.x[0, :, 1].mean().item())
    kinetic = torchmpm.diagnostics.kinetic_energy(solver, state)
    elastic = torchmpm.diagnostics.elastic_energy(solver, state)
    potential = torchmpm.diagnostics.potential_energy(solver, state)
    energies.append([kinetic.item(), elastic.item(), potential.item()])
    if step % 20 == 0:
        pictures.append(state.x[0])
    with torch.no_grad():
        state = solver.step(state, substeps=50)

figure, axes = plt.subplots(1, len(pictures), figsize=(10, 2.6), sharey=True)
for axis, x, step in zip(axes, pictures, range(0, 101, 20), strict=True):
    axis.scatter(x[:, 0], x[:, 1], s=0.5, color="#26798c")
    axis.axhline(0.2, color="#707782")
    axis.set(xlim=(0.35, 0.65), ylim=(0.15, 0.6), aspect="equal", xticks=[], title=f"{times[step]:.2f} s")
axes[0].set_ylabel("height, m")

# %%
# The total energy never increases. It decreases slightly whenever velocities are transferred between particles and
# grid.

figure, axis = plt.subplots(figsize=(8, 3))
for label, values in zip(("kinetic", "elastic", "potential"), zip(*energies, strict=True), strict=True):
    axis.plot(times, values, label=label)
total = [sum(values) for values in energies]
axis.plot(times, total, "k", label="total")
axis.set(xlabel="time, s", ylabel="energy, J")
axis.legend()

# %%
# The result can be checked against known physics: until it touches the table the ball is in free fall, the mass is
# conserved, and the energy does not increase.

fall = 20  # steps, 0.1 s
assert abs(heights[fall] - (heights[0] - 0.5 * 9.8 * times[fall] ** 2)) < 1e-3
assert torch.allclose(torchmpm.diagnostics.mass(solver, state), torch.tensor([1000.0 * area], dtype=torch.float64))
assert max(later - now for now, later in itertools.pairwise(total)) < 1e-3 * total[0]
assert min(heights) < 0.3 < heights[-1], "the ball fell and bounced"
