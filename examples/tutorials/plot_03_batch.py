r"""
A batch of robots
=================

All tensors have a leading batch dimension, and every material parameter can differ between the simulations of a
batch. This tutorial simulates 64 robots of RUN with different stiffness and gravity in parallel.
"""

# %%
# `dittogym.TorchEnv` is an environment whose inputs and outputs are tensors. With `particles="lite"` each robot has
# 2,000 particles instead of 22,000; :doc:`/concepts/fidelity` compares the two.

import math
import time

import matplotlib.pyplot as plt
import torch

import dittogym

NUM, STEPS = 64, 40
batch = dittogym.TorchEnv("run", num_envs=NUM, particles="lite", substeps=50)
stiffness = torch.logspace(-0.3, 0.3, 8).repeat(8) * batch.spec.mu
gravity = torch.linspace(-3.0, -15.0, 8).repeat_interleave(8)
physics = {"mu": stiffness, "gravity": torch.stack((torch.zeros(NUM), gravity), 1)}
batch.reset(seed=0, options={"physics": physics})

# %%
# The actions are a wave that travels to the left, the same for horizontal and vertical muscles.

column = torch.arange(batch.action_resolution) / batch.action_resolution


def wave(step: int, num_envs: int) -> torch.Tensor:
    """Actions (num_envs, 2, R, R)."""
    row = torch.sin(2 * math.pi * (column + 0.15 * step))
    return row.expand(num_envs, *batch.action_shape)


began = time.perf_counter()
with torch.no_grad():
    for step in range(STEPS):
        _, reward, terminated, truncated, info = batch.step(wave(step, NUM))
seconds = time.perf_counter() - began
print(f"{NUM * STEPS / seconds:.0f} environment steps a second, {NUM} robots side by side")

# %%
# The displacement depends on stiffness and gravity.

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
picture = left.pcolormesh(
    stiffness[:8], gravity[::8], info["displacement"].reshape(8, 8) * 100, shading="nearest", cmap="viridis"
)
left.set(xscale="log", xlabel="second Lamé parameter mu, Pa", ylabel="gravity, m/s²")
figure.colorbar(picture, label="displacement, cm")
best = int(info["displacement"].argmax())
right.imshow(batch.render(best, muscles=True))
right.set(title="the robot that moved furthest", xticks=[], yticks=[])
figure.tight_layout()

# %%
# The simulations of a batch do not affect each other: element 13 moves as it does alone, bit for bit with the native
# backend and to rounding with the others. Element i of a batch that is reset with seed s begins like a single
# environment with seed s + i.

alone = dittogym.TorchEnv("run", particles="lite", substeps=50)
alone.reset(seed=13, options={"physics": {"mu": stiffness[13], "gravity": (0.0, gravity[13].item())}})
with torch.no_grad():
    for step in range(STEPS):
        alone.step(wave(step, 1))
difference = (alone.state.x[0] - batch.state.x[13]).abs().max().item()
print(f"largest difference of a position: {difference:.1e} m")
assert difference < 1e-3
