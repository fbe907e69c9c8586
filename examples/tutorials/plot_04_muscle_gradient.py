r"""
Gradients through the muscles
=============================

Which pull makes the robot jump? Every step is differentiable in the action, the state and the matter, so ask for the
gradient of a height and follow it.
"""

# %%
# The graph of a control step holds its hundred substeps; `torchmpm.estimate_memory` says how much memory that takes.
# Here ten steps in a row, small ones: 50 substeps each.

import matplotlib.pyplot as plt
import torch

import dittogym

STEPS = 10
env = dittogym.TorchEnv("run", particles=1000, substeps=50, dtype="float64")
env.reset(seed=0)
start = env.save()


def height(actions: torch.Tensor) -> torch.Tensor:
    """How high the robot's centre gets within the steps, for actions (STEPS, 2, R, R)."""
    env.load(start)
    for action in actions:
        env.step(action[None])
    return env.state.x[0, :, 1].mean()


# %%
# The gradient
# ------------
#
# One call of ``backward`` gives the derivative in every action of every step.

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
figure.suptitle("what a contraction would do for the height: red lifts, blue lowers")
figure.tight_layout()

# %%
# Is it right? Compare with a central difference along a random direction, in float64.

generator = torch.Generator().manual_seed(0)
direction = torch.randn(actions.shape, generator=generator, dtype=torch.float64)
with torch.no_grad():
    eps = 1e-5
    measured = ((height(actions + eps * direction) - height(actions - eps * direction)) / (2 * eps)).item()
exact = (gradient * direction).sum().item()
print(f"autograd {exact:.8e}, central difference {measured:.8e}")

# %%
# Climb it
# --------
#
# A few steps of Adam on the actions, kept within [-1, 1] by a hyperbolic tangent.

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
print(f"height {resting.item():.4f} m at rest, {jumping.item():.4f} m with the pulls found")

assert abs(exact - measured) < 1e-5 * abs(exact)
assert jumping > resting + 0.005
