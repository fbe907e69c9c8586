r"""
Identify a material
===================

This tutorial identifies the stiffness and yield stress of a robot from its silhouettes alone. A robot with unknown
parameters is recorded under known actions. Gradient descent through the simulation then finds the parameters with
which a simulated robot, with different particles, produces the same recording.
"""

# %%
# The actions are a wave that stretches and shears the robot. They are zero in the last four steps, to observe
# how it relaxes.

import math

import matplotlib.pyplot as plt
import torch
from torch import Tensor

import dittogym
from dittogym.observation import soft_silhouette

STEPS, RESOLUTION, ITERATIONS = 10, 4, 40
TRUTH = {"mu": 700.0, "yield_stress": 45.0}
GUESS = {"mu": 500.0, "yield_stress": 62.0}


def muscles() -> Tensor:
    """Actions (STEPS, 1, 2, R, R)."""
    places = torch.arange(RESOLUTION) / RESOLUTION
    row, column = torch.meshgrid(places, places, indexing="ij")
    actions = torch.zeros(STEPS, 1, 2, RESOLUTION, RESOLUTION)
    for step in range(STEPS - 4):
        actions[step, 0, 0] = torch.sin(2 * math.pi * (column + 0.1 * step))
        actions[step, 0, 1] = -torch.cos(2 * math.pi * (row - 0.1 * step))
    return 0.8 * actions


# %%
# Material parameters are options of ``reset``. If a parameter is a tensor that requires gradients, the recording is
# differentiable with respect to it.


def record(env: dittogym.TorchEnv, seed: int, physics: dict[str, Tensor]) -> Tensor:
    """Soft silhouettes (STEPS, 64, 64) of a robot with the given material parameters."""
    env.reset(seed=seed, options={"physics": physics})
    pictures = []
    for action in muscles():
        env.step(action)
        pictures.append(soft_silhouette(env.soft_observation())[0])
    return torch.stack(pictures)


env = dittogym.TorchEnv("shapematch", resolution=RESOLUTION, particles="lite")
with torch.no_grad():
    recording = record(env, 1, {name: torch.tensor(value) for name, value in TRUTH.items()})

# %%
# Adam optimises the logarithms of the parameters, which keeps them positive and makes steps relative.

logarithm = torch.tensor([math.log(value) for value in GUESS.values()], requires_grad=True)
adam = torch.optim.Adam([logarithm], lr=0.06, betas=(0.8, 0.95))
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, ITERATIONS, 0.003)
history = []
for _ in range(ITERATIONS):
    physics = dict(zip(GUESS, logarithm.exp(), strict=True))
    loss = (record(env, 0, physics) - recording).square().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
    schedule.step()
    history.append(logarithm.detach().exp())

# %%
# The two robots consist of different particles, which limits the accuracy.

found = dict(zip(GUESS, history[-1].tolist(), strict=True))
figure, axes = plt.subplots(1, 3, figsize=(11, 3))
axes[0].imshow(recording[-1], cmap="gray")
axes[0].set(title="last frame of the recording", xticks=[], yticks=[])
for axis, (name, true), values in zip(axes[1:], TRUTH.items(), torch.stack(history).T, strict=True):
    axis.plot(values)
    axis.axhline(true, color="0.5", linestyle="--")
    axis.set(xlabel="iteration", title=f"{name}, Pa")
figure.tight_layout()
for name, true in TRUTH.items():
    print(
        f"{name}: true {true:.1f} Pa, guess {GUESS[name]:.1f}, found {found[name]:.1f} ({found[name] / true - 1:+.1%})"
    )

assert all(abs(found[name] / true - 1) < 0.05 for name, true in TRUTH.items())
