r"""
On a GPU, and on a cluster
==========================

The same program runs on a laptop's CPU and on a GPU: say ``device="cuda"``. What changes is how many robots it takes
to fill the machine. This page measures that where it was built. (On a GPU nothing of this has been timed yet; there
``backend="native"`` has to be asked for, otherwise the physics runs operator by operator.)
"""

# %%
# Tensors live on the environment's device, actions too.

import time

import matplotlib.pyplot as plt
import torch

import dittogym

device = "cuda" if torch.cuda.is_available() else "cpu"
print(f"torch {torch.__version__}, {device}, {torch.get_num_threads()} threads")


def throughput(num_envs: int, gradient: bool = False) -> float:
    """Environment steps a second, of all robots together; the best of three tries."""
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
# A step of one robot cannot be spread well over many cores, a batch can: each robot is independent. On a GPU go on
# doubling until the curve is flat, or memory ends: `torchmpm.estimate_memory` says beforehand what gradients take.

sizes = (1, 2, 4, 8, 16, 32)
forward = [throughput(size) for size in sizes]
backward = [throughput(size, gradient=True) for size in sizes]
figure, axis = plt.subplots(figsize=(7, 3.5))
axis.plot(sizes, forward, "o-", label="forward")
axis.plot(sizes, backward, "s-", label="with the gradient")
axis.set(xscale="log", xlabel="robots side by side", ylabel="environment steps a second")
axis.legend()
figure.tight_layout()

# %%
# On the command line
# -------------------
#
# ``python -m cfp.train --task run --device cuda --num-envs 256`` simulates and learns on the GPU. One run does not
# spread over several GPUs or machines; many runs do: ``python -m baselines.compare --executor ray`` hands them to a
# Ray cluster, and a Slurm array starts one command for each.

for size, alone, both in zip(sizes, forward, backward, strict=True):
    print(f"{size:3d} robots: {alone:7.0f} steps/s, with the gradient {both:6.0f}")

assert max(forward) >= forward[0]
assert all(a > b for a, b in zip(forward, backward, strict=True)), "a gradient is not for nothing"
