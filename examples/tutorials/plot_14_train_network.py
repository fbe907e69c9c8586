r"""
Train your own network
======================

Any PyTorch module can act in the simulation and be trained by backpropagation through it. This tutorial trains a small
network that makes the robot of SHAPE MATCH as wide or as tall as it is told.
"""

# %%
# The network
# -----------
#
# The network observes the occupancy channel of the image and a command. Its output is an action of 8 × 8 cells.

import matplotlib.pyplot as plt
import torch
from torch import Tensor, nn

import dittogym

ROBOTS, STEPS, UPDATES, SIZE, WIDEST = 8, 12, 60, 8, 0.25
env = dittogym.TorchEnv("shapematch", num_envs=ROBOTS, particles=600, resolution=SIZE)


class Policy(nn.Module):
    """Actions (B, 2, R, R) for images (B, 3, 64, 64) and commands (B, 1)."""

    def __init__(self) -> None:
        super().__init__()
        first, second = nn.Linear(256 + 1, 128), nn.Linear(128, 128)
        self.layers = nn.Sequential(first, nn.ELU(), second, nn.ELU())
        self.last = nn.Linear(128, 2 * SIZE**2)
        nn.init.zeros_(self.last.weight)  # begins with weak, constant actions

    def forward(self, image: Tensor, command: Tensor) -> Tensor:
        """Choose the actions."""
        pixels = nn.functional.avg_pool2d(image[:, :1] / 255, 4).flatten(1)
        hidden = self.layers(torch.cat((pixels, command / WIDEST), dim=1))
        return self.last(hidden).unflatten(1, (2, SIZE, SIZE)).tanh()


# %%
# An episode
# ----------
#
# The elongation of a robot is the difference between its horizontal and its vertical variance, divided by their sum:
# positive for a wide robot, negative for a tall one. The command is the elongation that the robot should reach.
#
# The image consists of integers, so the gradient takes one path only: from the particles back through the physics to
# the actions, and from each action to the weights of the network. ``env.step(action, soft=True)`` returns an image that
# has a gradient as well.


def elongation(x: Tensor) -> Tensor:
    """Elongation (B, 1) of particles at positions (B, N, 2)."""
    horizontal, vertical = x.var(dim=1).T
    return ((horizontal - vertical) / (horizontal + vertical))[:, None]


def episode(policy: Policy, command: Tensor, seed: int) -> Tensor:
    """Elongations (STEPS, B, 1) after each step for commands (B, 1)."""
    observation, _ = env.reset(seed=seed)
    reached = []
    for _ in range(STEPS):
        observation, *_ = env.step(policy(observation, command))
        reached.append(elongation(env.state.x))
    return torch.stack(reached)


# %%
# Training
# --------
#
# Each update plays one episode with every robot. The loss counts the second half of the episode, so that robots hold
# their shape. Clipping the norm of the gradient limits the effect of single robots that tear.

torch.manual_seed(0)
policy = Policy()
adam = torch.optim.Adam(policy.parameters(), lr=1e-3, betas=(0.8, 0.99))
decay = torch.optim.lr_scheduler.LinearLR(adam, 1.0, 0.1, UPDATES)
curve = []
for update in range(UPDATES):
    spread = torch.linspace(-1, 1, ROBOTS) + (torch.rand(ROBOTS) - 0.5) / ROBOTS
    command = WIDEST * spread[:, None]
    reached = episode(policy, command, seed=ROBOTS * update)
    loss = (reached[STEPS // 2 :] - command).square().mean()
    adam.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(policy.parameters(), 0.1, error_if_nonfinite=True)
    adam.step()
    decay.step()
    curve.append(loss.item() ** 0.5)

# %%
# Evaluation
# ----------
#
# Evaluation uses other commands and initial positions than training. During training the error rises for a while: as
# soon as the muscles are strong enough for plastic flow, the network has to learn to stop in time.

with torch.no_grad():
    command = torch.linspace(-0.2, 0.2, ROBOTS)[:, None]
    reached = episode(policy, command, seed=100_000)[-1]

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
left.plot(curve)
left.set(xlabel="update", ylabel="root mean square error", ylim=(0, None))
right.plot([-WIDEST, WIDEST], [-WIDEST, WIDEST], color="0.7", label="command = elongation")
right.plot(command, reached, "o")
right.set(xlabel="command", ylabel="elongation after the episode")
right.legend()
figure.tight_layout()

# %%
# Three of the robots at the end of the episode.

figure, axes = plt.subplots(1, 3, figsize=(9, 3.2))
for axis, robot in zip(axes, (0, ROBOTS // 2, ROBOTS - 1), strict=True):
    centred = env.state.x[robot] - env.state.x[robot].mean(dim=0)
    axis.scatter(*centred.T, s=3)
    axis.set(aspect="equal", xlim=(-0.13, 0.13), ylim=(-0.13, 0.13), xticks=[], yticks=[])
    axis.set_title(f"command {command[robot].item():.2f}, reached {reached[robot].item():.2f}")
figure.tight_layout()

error, untrained = ((x - command).square().mean().sqrt().item() for x in (reached, 0))
print(f"root mean square error {error:.3f}, with zero actions about {untrained:.3f}")

# %%
# Longer episodes
# ---------------
#
# Memory and the size of gradients grow with the number of steps. In long episodes, cut the graph with ``env.detach()``
# after every few steps, and estimate the rest of the return by a critic:
# :doc:`Learning by gradients </concepts/learning>` works in this way.

assert error < 0.5 * untrained
