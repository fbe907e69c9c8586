r"""
Match a shape by gradient
=========================

SHAPE MATCH asks a disc to become a star. Thirty actions of 2 x 16 x 16 numbers are 15,360 unknowns: hopeless by
trial, easy by gradient. This is the method of ``python -m baselines.train --algo gradient``, cut down to its core and
to half a minute.
"""

# %%
# The silhouette that the reward counts is made of pixels that are on or off, so its derivative is zero.
# `soft_silhouette` is the smooth one; blurring it and the target lets matter feel where a missing arm should grow.

import matplotlib.pyplot as plt
import torch
from torch.nn.functional import conv2d

import dittogym
from dittogym.observation.image import soft_silhouette

env = dittogym.TorchEnv("shapematch", resolution=16, particles="lite", target="star", segment=None)
target = torch.as_tensor(env.spec.target, dtype=torch.float32)


def blurred(image: torch.Tensor, width: float) -> torch.Tensor:
    """A picture (64, 64) after a Gaussian blur of some pixels."""
    if width == 0:
        return image
    offset = torch.arange(-12.0, 13.0)
    bell = torch.exp(-0.5 * (offset / width).square())
    bell = bell / bell.sum()
    padded = conv2d(image[None, None], bell.view(1, 1, -1, 1), padding=(12, 0))
    return conv2d(padded, bell.view(1, 1, 1, -1), padding=(0, 12))[0, 0]


# %%
# One episode under given actions. The loss is the difference of the blurred pictures, over all steps: a robot that
# gets there early is better. ``detach`` is never called, so the gradient reaches through all 3,000 substeps.


def episode(theta: torch.Tensor, width: float) -> tuple[torch.Tensor, float]:
    """Loss, and the task's own return."""
    env.reset(seed=0)
    loss, total = torch.zeros(()), 0.0
    for action in theta.tanh():
        _, reward, *_ = env.step(action[None])
        picture = soft_silhouette(env.soft_observation())[0]
        loss = loss + (blurred(picture, width) - blurred(target, width)).abs().mean()
        total += reward.item()
    return loss / len(theta), total


# %%
# Each step's gradient is clipped to three times its usual norm: where matter tears, derivatives are many times larger
# and say little.

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
# The return counts pixels, with the true, jumping reward.

with torch.no_grad():
    _, resting = episode(torch.zeros_like(theta), 0)
    _, found = episode(theta, 0)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
left.plot(curve)
left.axhline(resting, color="0.6", linestyle="--", label="no action")
left.set(xlabel="iteration", ylabel="return at the lite tier")
left.legend()
right.imshow(env.render())
right.set(title="after 40 iterations", xticks=[], yticks=[])
figure.tight_layout()
print(f"return {resting:.0f} without action, {found:.0f} with the actions found")

assert found > resting + 200
