r"""
Your first simulation
=====================

A ball of gel falls on a table and bounces. State goes in, state comes out: a `torchmpm.ParticleState` holds all that
moves, a `torchmpm.Solver` describes the rest of the world and is never changed by a step.

Units are SI in two dimensions: metres, seconds, kilograms; the window is one metre wide, a substep takes 0.1 ms.
"""

# %%
# The world
# ---------
#
# One body of 2,000 particles of an elastic solid, a table whose top is 0.2 m high, and gravity. The Lamé parameters
# are in pascal; `torchmpm.lame` computes them from Young's modulus and Poisson's ratio. Mass and volume are those of
# one particle; here they make a gel with a density of 1,000 kg/m².

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
# Particles come from points of the unit square that a shape maps into the world. A Sobol sequence leaves fewer clumps
# and holes than random numbers.

points = torchmpm.sampling.disc(torchmpm.sampling.sobol(COUNT, seed=0), centre=(0.5, 0.45), radius=RADIUS)
state = torchmpm.ParticleState.at_rest(torch.as_tensor(points))  # float64, a batch of one
print(state.x.shape, state.F.shape)

# %%
# Motion
# ------
#
# A step of 50 substeps, 5 ms, again and again. Energies come from `torchmpm.diagnostics`.

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
# The total energy falls, because particles and grid exchange velocities and lose a little each time, and never rises.

figure, axis = plt.subplots(figsize=(8, 3))
for label, values in zip(("kinetic", "elastic", "potential"), zip(*energies, strict=True), strict=True):
    axis.plot(times, values, label=label)
total = [sum(values) for values in energies]
axis.plot(times, total, "k", label="total")
axis.set(xlabel="time, s", ylabel="energy, J")
axis.legend()

# %%
# Can it be trusted? Until it touches the table the ball falls like any other body, mass is kept to the last digit,
# and energy does not grow.

fall = 20  # steps, 0.1 s
assert abs(heights[fall] - (heights[0] - 0.5 * 9.8 * times[fall] ** 2)) < 1e-3
assert torch.allclose(torchmpm.diagnostics.mass(solver, state), torch.tensor([1000.0 * area], dtype=torch.float64))
assert max(later - now for now, later in itertools.pairwise(total)) < 1e-3 * total[0]
assert min(heights) < 0.3 < heights[-1], "it came down and jumped"
