r"""
On a GPU, and on a cluster
==========================

The same program runs on a CPU and, with ``device="cuda"``, on a GPU. A GPU needs many more robots in parallel than a
CPU before all of it is busy. This tutorial measures the speed for different numbers of robots, on the machine on which
the documentation was built. On a GPU the fused kernels need the extra ``torchmpm[cuda12]`` or ``torchmpm[cuda13]``.
"""

# %%
# All tensors are on the device of the environment, including actions.

import time

import matplotlib.pyplot as plt
import torch

import dittogym

device = "cuda" if torch.cuda.is_available() else "cpu"
print(f"torch {torch.__version__}, {device}, {torch.get_num_threads()} threads")


def throughput(num_envs: int, gradient: bool = False) -> float:
    """Environment steps per second of all robots together, best of three measurements."""
    env = dittogym.TorchEnv("run", num_envs=num_envs, particles="lite", device=device)
    env.reset(seed=0)
    action = torch.zeros(num_envs, *env.action_shape, device=device, requires_grad=gradient)
    best = float("inf")
    for _ in range(3):
        env.detach()
        began = time.perf_counter()
        with torch.set_grad_enabled(gradient):
            _, reward, *_ = env.step(action)
            if gradient:
                reward.sum().backward()
        if device == "cuda":
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - began)
    return num_envs / best


# %%
# A batch of robots can be divided among many cores; a single robot uses only a few. On a GPU, double the batch
# size until the curve is flat or the memory is full.

sizes = (1, 2, 4, 8, 16, 32)
forward = [throughput(size) for size in sizes]
backward = [throughput(size, gradient=True) for size in sizes]
figure, axis = plt.subplots(figsize=(7, 3.5))
axis.plot(sizes, forward, "o-", label="forward")
axis.plot(sizes, backward, "s-", label="with the gradient")
axis.set(xscale="log", xlabel="robots in parallel", ylabel="environment steps per second")
axis.legend()
figure.tight_layout()

# %%
# On the command line
# -------------------
#
# ``torchmpm train --task run --device cuda --num-envs 256`` simulates and trains on the GPU. A single run uses
# one device. Several runs can use several GPUs and machines: ``torchmpm compare --executor ray``
# distributes them over a Ray cluster, and a Slurm array starts one command for each run.

for size, alone, both in zip(sizes, forward, backward, strict=True):
    print(f"{size:3d} robots: {alone:7.0f} steps/s, with the gradient {both:6.0f}")
