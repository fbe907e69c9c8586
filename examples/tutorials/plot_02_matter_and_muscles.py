r"""
Materials and muscles
=====================

Muscles act on three squares of different materials for 25 ms and then relax for 125 ms. The elastic square returns to
its shape, the plastic one keeps its new shape, and a third one with a higher yield stress keeps part of it.
"""

# %%
# Actuation is a stress along two directions of the material, given as a field on the nodes of the grid: `[:, 0]` acts
# along the material's x, `[:, 1]` along its y. Positive values contract. It acts on bodies with `muscle=True`.

import matplotlib.pyplot as plt
import torch

import torchmpm

COUNT, SIDE = 1500, 0.16
MATERIALS = {
    "elastic": torchmpm.Elastic(mu=500.0, lam=50.0),
    "yields at 130 Pa": torchmpm.VonMises(mu=500.0, lam=50.0, yield_stress=130.0),
    "yields at 110 Pa": torchmpm.VonMises(mu=500.0, lam=50.0, yield_stress=110.0),
}
points = torchmpm.sampling.box(torchmpm.sampling.sobol(COUNT, seed=0), (0.5 - SIDE / 2,) * 2, (SIDE, SIDE))
start = torchmpm.ParticleState.at_rest(torch.as_tensor(points))
pull = torch.zeros(1, 2, 128, 128, dtype=torch.float64)
pull[:, 0], pull[:, 1] = 75.0, -75.0  # thinner and taller


def shape(state: torchmpm.ParticleState) -> float:
    """Height over width, from the spread of the particles."""
    width, height = state.x[0].std(0).tolist()
    return height / width


# %%
# `damping` reduces the velocity of every node in each substep, so that the squares come to rest.

curves, ends = {}, {}
for name, material in MATERIALS.items():
    body = torchmpm.Body(COUNT, material, mass=2.0, volume=1.0, muscle=True)
    solver = torchmpm.Solver(torchmpm.Grid(128), bodies=(body,), damping=0.998)
    state, curves[name] = start, []
    with torch.no_grad():
        for step in range(30):
            curves[name].append(shape(state))
            state = solver.step(state, pull if step < 5 else None, substeps=50)
    ends[name] = state

figure, axes = plt.subplots(1, 4, figsize=(11, 3), width_ratios=(2, 1, 1, 1))
for name, curve in curves.items():
    axes[0].plot([5 * step for step in range(30)], curve, label=name)
axes[0].axvspan(0, 25, color="0.9")
axes[0].set(xlabel="time, ms (muscles active in the grey part)", ylabel="height over width")
axes[0].legend()
for axis, (name, state) in zip(axes[1:], ends.items(), strict=True):
    axis.scatter(state.x[0, :, 0], state.x[0, :, 1], s=0.5, color="#26798c")
    axis.set(xlim=(0.35, 0.65), ylim=(0.35, 0.65), aspect="equal", xticks=[], yticks=[], title=name)
figure.tight_layout()

# %%
# The yield stress bounds the elastic strain: the norm of a particle's deviatoric strain never exceeds ``yield_stress
# / (2 mu)``. Plastic flow preserves the volume, so the plastic square keeps its initial area.

for name, state in ends.items():
    F = state.F[0]
    area = torch.linalg.det(F).mean().item()
    print(f"{name:17s} height over width {shape(state):.2f}, mean det F {area:.3f}")

assert abs(shape(ends["elastic"]) - 1.0) < 0.1
assert shape(ends["yields at 110 Pa"]) > 1.5
assert 1.0 < shape(ends["yields at 130 Pa"]) < shape(ends["yields at 110 Pa"])
