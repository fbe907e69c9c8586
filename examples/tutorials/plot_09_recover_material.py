r"""
Recover a material
==================

Which matter is this robot made of, judging by its silhouettes alone? A robot of unknown stiffness and yield stress is
driven by known muscles and filmed. Gradient descent through the simulation finds the constants with which a simulated
robot, filled with other particles, makes the same film.
"""

# %%
# A wave that stretches and shears, and slack muscles in the last third to see what springs back.

import math

import matplotlib.pyplot as plt
import torch
from torch import Tensor

import dittogym
from dittogym.observation.image import soft_silhouette

STEPS, RESOLUTION, ITERATIONS = 10, 4, 40
TRUTH = {"mu": 700.0, "yield_stress": 45.0}
GUESS = {"mu": 500.0, "yield_stress": 62.0}


def muscles() -> Tensor:
    """Actions (STEPS, 1, 2, R, R)."""
    row, column = torch.meshgrid(*[torch.arange(RESOLUTION) / RESOLUTION] * 2, indexing="ij")
    actions = torch.zeros(STEPS, 1, 2, RESOLUTION, RESOLUTION)
    for step in range(2 * STEPS // 3):
        actions[step, 0, 0] = torch.sin(2 * math.pi * (column + 0.1 * step))
        actions[step, 0, 1] = -torch.cos(2 * math.pi * (row - 0.1 * step))
    return 0.8 * actions


# %%
# Constants of the matter are options of ``reset``. A tensor that requires gradients is differentiated through: the
# film's graph reaches back to it.


def film(env: dittogym.TorchEnv, seed: int, physics: dict[str, Tensor]) -> Tensor:
    """Soft silhouettes (STEPS, 64, 64) of a robot of the given matter."""
    env.reset(seed=seed, options={"physics": physics})
    pictures = []
    for action in muscles():
        env.step(action)
        pictures.append(soft_silhouette(env.soft_observation())[0])
    return torch.stack(pictures)


env = dittogym.TorchEnv("shapematch", resolution=RESOLUTION, particles="lite")
with torch.no_grad():
    recording = film(env, 1, {name: torch.tensor(value) for name, value in TRUTH.items()})

# %%
# Adam works on logarithms: constants are positive, and a per cent is a per cent.

logarithm = torch.tensor([math.log(value) for value in GUESS.values()], requires_grad=True)
adam = torch.optim.Adam([logarithm], lr=0.06, betas=(0.8, 0.95))
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, ITERATIONS, 0.003)
history = []
for _ in range(ITERATIONS):
    physics = dict(zip(GUESS, logarithm.exp(), strict=True))
    loss = (film(env, 0, physics) - recording).square().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
    schedule.step()
    history.append(logarithm.detach().exp())

# %%
# The two robots are filled with different particles, which bounds how well it can be done.

found = dict(zip(GUESS, history[-1].tolist(), strict=True))
figure, axes = plt.subplots(1, 3, figsize=(11, 3))
axes[0].imshow(recording[-1], cmap="gray")
axes[0].set(title="the last picture of the film", xticks=[], yticks=[])
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
