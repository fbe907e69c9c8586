r"""
Gradients through the muscles
=============================

Every step is differentiable with respect to the action, the state and the material. This tutorial computes the
gradient of the robot's height with respect to its actions, and follows it to make the robot jump.
"""

# %%
# The gradient goes through ten control steps, here with 50 substeps each.

import matplotlib.pyplot as plt
import torch

import dittogym

STEPS = 10
env = dittogym.TorchEnv("run", particles=1000, substeps=50, dtype="float64")
env.reset(seed=0)
start = env.save()


def height(actions: torch.Tensor) -> torch.Tensor:
    """Height of the robot's centre after the steps, for actions (STEPS, 2, R, R)."""
    env.load(start)
    for action in actions:
        env.step(action[None])
    return env.state.x[0, :, 1].mean()


# %%
# The gradient
# ------------
#
# One backward pass gives the derivatives with respect to all actions of all steps.

actions = torch.zeros(STEPS, *env.action_shape, dtype=torch.float64, requires_grad=True)
resting = height(actions)
(gradient,) = torch.autograd.grad(resting, actions)

shown = (0, 3, 6, 9)
limit = gradient.abs().max().item()
figure, axes = plt.subplots(2, len(shown), figsize=(9, 4.4))
for column, step in enumerate(shown):
    for muscle, name in enumerate("xy"):
        axes[muscle, column].imshow(gradient[step, muscle], cmap="coolwarm", vmin=-limit, vmax=limit)
        axes[muscle, column].set(xticks=[], yticks=[], title=f"step {step}, {name} muscle")
figure.suptitle("derivative of the height: where contraction lifts (red) and lowers (blue) the robot")
figure.tight_layout()

# %%
# Compare the gradient with a central difference along a random direction, in float64.

generator = torch.Generator().manual_seed(0)
direction = torch.randn(actions.shape, generator=generator, dtype=torch.float64)
with torch.no_grad():
    eps = 1e-5
    measured = ((height(actions + eps * direction) - height(actions - eps * direction)) / (2 * eps)).item()
exact = (gradient * direction).sum().item()
print(f"autograd {exact:.8e}, central difference {measured:.8e}")

# %%
# Optimisation
# ------------
#
# Take a few steps of Adam. A hyperbolic tangent keeps the actions within [-1, 1].

theta = torch.zeros_like(actions, requires_grad=True)
adam = torch.optim.Adam([theta], lr=0.3)
curve = []
for _ in range(12):
    loss = -height(theta.tanh())
    adam.zero_grad()
    loss.backward()
    adam.step()
    curve.append(-loss.item())

with torch.no_grad():
    jumping = height(theta.tanh())
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
left.plot(curve, "o-")
left.set(xlabel="iteration", ylabel="height after ten steps, m")
right.imshow(env.render(muscles=True))
right.set(title="the last step; contraction red", xticks=[], yticks=[])
figure.tight_layout()
print(f"height {resting.item():.4f} m with zero actions, {jumping.item():.4f} m with the optimised actions")

assert abs(exact - measured) < 1e-5 * abs(exact)
assert jumping > resting + 0.005
