r"""
Match a shape by gradient
=========================

In SHAPE MATCH a disc must take the shape of a star. An episode has 30 actions with 2 x 16 x 16 values each. Random
search over these 15,360 values is impractical, but gradient descent works. This tutorial is a short version of the
method of ``torchmpm train --algo gradient``, and takes half a minute.
"""

# %%
# The reward counts pixels that are on or off, so its derivative is zero. `soft_silhouette` is a smooth version of the
# silhouette. Blurring it and the target gives gradients also where an arm of the star is still missing.

import matplotlib.pyplot as plt
import torch
from torch.nn.functional import conv2d

import dittogym
from dittogym.observation import soft_silhouette

# segment=None: no checkpoints, so the gradient is faster and needs more memory
env = dittogym.TorchEnv("shapematch", resolution=16, particles="lite", target="star", segment=None)
target = torch.as_tensor(env.spec.target, dtype=torch.float32)


def blurred(image: torch.Tensor, width: float) -> torch.Tensor:
    """Blur an image (64, 64) with a Gaussian of a given width in pixels."""
    if width == 0:
        return image
    offset = torch.arange(-12.0, 13.0)
    bell = torch.exp(-0.5 * (offset / width).square())
    bell = bell / bell.sum()
    padded = conv2d(image[None, None], bell.view(1, 1, -1, 1), padding=(12, 0))
    return conv2d(padded, bell.view(1, 1, 1, -1), padding=(0, 12))[0, 0]


# %%
# This function simulates an episode. Its loss is the mean difference of the blurred images over all steps, so
# reaching the shape early is better. The gradient goes through all 3,000 substeps, because ``detach`` is never
# called.


def episode(theta: torch.Tensor, width: float) -> tuple[torch.Tensor, float]:
    """Simulate an episode; return its loss, and its return."""
    env.reset(seed=0)
    loss, total, goal = torch.zeros(()), 0.0, blurred(target, width)
    for action in theta.tanh():
        _, reward, *_ = env.step(action[None])
        picture = soft_silhouette(env.soft_observation())[0]
        loss = loss + (blurred(picture, width) - goal).abs().mean()
        total += reward.item()
    return loss / len(theta), total


# %%
# The gradient of each step is clipped to three times its usual norm, because derivatives are many times larger where
# the robot tears.

theta = torch.zeros(env.spec.horizon, *env.action_shape, requires_grad=True)
adam = torch.optim.Adam([theta], lr=0.1, betas=(0.9, 0.98))
usual, curve = None, []
for width in (4, 2, 1, 0):
    for _ in range(10):
        loss, total = episode(theta, width)
        adam.zero_grad()
        loss.backward()
        norms = theta.grad.flatten(1).norm(dim=1)
        usual = norms if usual is None else 0.9 * usual + 0.1 * norms.minimum(3 * usual)
        theta.grad *= (3 * usual / norms.clamp_min(1e-12)).clamp_max(1.0)[:, None, None, None]
        adam.step()
        curve.append(total)

# %%
# The return of the true reward:

with torch.no_grad():
    _, resting = episode(torch.zeros_like(theta), 0)
    _, found = episode(theta, 0)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
left.plot(curve)
left.axhline(resting, color="0.6", linestyle="--", label="zero actions")
left.set(xlabel="iteration", ylabel="return, lite particles")
left.legend()
right.imshow(env.render())
right.set(title="after 40 iterations", xticks=[], yticks=[])
figure.tight_layout()
print(f"return {resting:.0f} with zero actions, {found:.0f} with the optimised actions")

assert found > resting + 200
