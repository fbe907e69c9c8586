r"""
Design body and controller together
===================================

Gradients reach every input of a simulation, including the initial positions of the particles and the stiffness of
each. This tutorial optimises a gait for RUN, first for the task's own round robot, and then together with the shape
and the stiffness of the body.
"""

# %%
# Parameters of the body
# ----------------------
#
# The particles of the disc are moved to new places by a map that preserves areas, and with them masses: the body
# becomes longer where it becomes lower. With :math:`u` from 0 at the rear end to 1 at the front, lengths are multiplied
# by :math:`g(u)`, and heights above the floor by :math:`1/g(u)`. Stiffness is multiplied by the exponential of a
# bounded linear function of :math:`u` and the height.

import dataclasses
import math

import matplotlib.pyplot as plt
import torch
from torch import Tensor

import dittogym

STEPS, PERIOD, ITERATIONS = 32, 16, 16
spec = dataclasses.replace(dittogym.make_spec("run"), horizon=100)
env = dittogym.TorchEnv(spec, particles=1000)
env.reset(seed=0)
disc = env.state.x[0]
corner, size = disc.min(0).values, disc.max(0).values - disc.min(0).values
u, height = ((disc - corner) / size).T


def body(design: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (N, 2), m, and Lamé parameters mu (N,), Pa, of the particles for six numbers."""
    stretch, first, second = 0.4 * design[0].tanh(), 0.4 * design[1].tanh(), 0.4 * design[2].tanh()
    g = stretch.exp() * (1 + first * (2 * u - 1) + second * (6 * u**2 - 6 * u + 1))
    length = stretch.exp() * (u + first * (u**2 - u) + second * (2 * u**3 - 3 * u**2 + u))  # the integral of g
    positions = corner + size * torch.stack((length, height / g), dim=1)
    stiffness = design[3] + design[4] * (2 * u - 1) + design[5] * (2 * height - 1)
    return positions, spec.mu * (0.5 * stiffness.tanh()).exp()


# %%
# Parameters of the controller
# ----------------------------
#
# A gait is a periodic action: a mean image, a cosine and a sine.


def gait(theta: Tensor, step: int) -> Tensor:
    """Action (1, 2, R, R) of a step, for coefficients (3, 2, R, R)."""
    phase = 2 * math.pi * step / PERIOD
    return (theta[0] + theta[1] * math.cos(phase) + theta[2] * math.sin(phase)).tanh()[None]


def start(design: Tensor) -> None:
    """Reset the environment with a body."""
    positions, mu = body(design)
    env.reset(options={"positions": positions, "physics": {"mu": mu[None]}})


def travelled(theta: Tensor, design: Tensor) -> Tensor:
    """How far the centre of mass moves to the right, m."""
    start(design)
    before = env.state.x[0, :, 0].mean()
    for step in range(STEPS):
        env.step(gait(theta, step))
    return env.state.x[0, :, 0].mean() - before


# %%
# Optimisation
# ------------
#
# One backward pass gives the derivatives with respect to gait and body. The norm of each gradient is clipped, because
# derivatives grow large where matter tears.


def optimise(co_design: bool) -> tuple[Tensor, Tensor, list[float]]:
    """The best gait and design, and the distance of each iteration, m."""
    generator = torch.Generator().manual_seed(0)
    theta = (0.3 * torch.randn(3, *env.action_shape, generator=generator)).requires_grad_()
    design = torch.zeros(6, requires_grad=True)
    groups = [{"params": [theta], "lr": 0.2}, {"params": [design], "lr": 0.15 if co_design else 0.0}]
    adam, curve, best = torch.optim.Adam(groups), [], (theta, design)
    for _ in range(ITERATIONS):
        distance = travelled(theta, design)
        if distance.item() >= max(curve, default=-math.inf):
            best = theta.detach().clone(), design.detach().clone()
        curve.append(distance.item())
        adam.zero_grad()
        (-distance).backward()
        for parameter in (theta, design):
            torch.nn.utils.clip_grad_norm_([parameter], 1.0, error_if_nonfinite=True)
        adam.step()
    return *best, curve


results = {name: optimise(name == "gait, shape and stiffness") for name in ("gait", "gait, shape and stiffness")}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), width_ratios=(1.2, 1))
for name, (_, _, curve) in results.items():
    left.plot([100 * value for value in curve], "o-", label=name)
    print(f"{name}: {100 * max(curve):.1f} cm in {STEPS} steps")
left.set(xlabel="iteration", ylabel="distance, cm")
left.legend()
theta, design, curve = results["gait, shape and stiffness"]
positions, mu = body(design)
drawn = right.scatter(*positions.T, c=mu, s=4, cmap="viridis")
right.set(aspect="equal", title="the body that was found")
figure.colorbar(drawn, label="mu, Pa")
figure.tight_layout()

# %%
# Watch it
# --------
#
# With ``seed=None`` the film starts with the positions and the stiffness of the last reset. The gait goes on beyond the
# steps for which it was optimised.

start(design)
recording = env.film(lambda observation: gait(theta, int(env.env_state.steps[0])), seed=None)
recording

# %%
# To train a policy for such a body, give it to a :ref:`custom task <sphx_glr_gallery_plot_06_own_task.py>`.

assert max(curve) > curve[0] + 0.02
assert max(curve) > max(results["gait"][2])
