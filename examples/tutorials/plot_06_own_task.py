r"""
Define a custom task
====================

A task is a dataclass with a reward function. This tutorial defines HOP, which rewards the robot's height and has its
own obstacle and success criterion. The task then works like the built-in ones: with Gymnasium, in batches, with
gradients, and with every algorithm.
"""

# %%
# The function gets a :class:`dittogym.contract.Moment` and returns named terms, one number for each simulation of the
# batch. Each term is multiplied by its weight. The engine adds the terms that all tasks share: the action cost, the
# penalty for a torn robot, and a constant for every step.

import dataclasses

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import torch

import dittogym
from dittogym.geometry import ceiling, floor, solid


def reward_fn(moment: dittogym.contract.Moment, spec: dittogym.TaskSpec) -> dittogym.Outcome:
    """Reward height above the start; a hop of 3 cm is a success."""
    height = moment.now.com[:, 1] - moment.start.com[:, 1]
    return dittogym.Outcome({"height": height}, success=height > 0.03)


def hop(wall: int = 60) -> dittogym.TaskSpec:
    """HOP, with a wall that begins at the given column of nodes."""
    return dataclasses.replace(
        dittogym.make_spec("run"),
        name="hop",
        horizon=20,
        reward_fn=reward_fn,
        weights={"height": 100.0, "split": 1.0, "action": 2e-4},
        obstacles=(solid("wall", i=(wall, wall + 4), j=(None, 40)), floor(), ceiling(119)),
    )


# %%
# ``register`` creates Gymnasium ids. The arguments of the function become options of ``gymnasium.make``.

dittogym.register("hop", hop)
env = gymnasium.make("dittogym/hop-coarse-v0", particles="lite", wall=64)
observation, _ = env.reset(seed=0)
total = 0.0
for _ in range(20):
    observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
    total += reward
terms = [name for name in info if name.startswith("reward_terms/")]
print(f"zero actions: return {total:.2f}, terms {terms}, ended {terminated or truncated}")

# %%
# The same task as a differentiable function: because ``reward_fn`` is made of torch operations, its reward can be
# maximised by gradient ascent.

batch = dittogym.TorchEnv("hop", particles="lite")
theta = torch.zeros(20, *batch.action_shape, requires_grad=True)
adam = torch.optim.Adam([theta], lr=0.2)
curve = []
for _ in range(8):
    batch.reset(seed=0)
    rewards = [batch.step(action[None])[1] for action in theta.tanh()]
    loss = -torch.stack(rewards).sum()
    adam.zero_grad()
    loss.backward()
    adam.step()
    curve.append(-loss.item())
print("return by iteration:", ", ".join(f"{value:.1f}" for value in curve))

# %%
# The resulting motion:

batch.reset(seed=0)
heights, successes, pictures = [], 0, []
with torch.no_grad():
    for step, action in enumerate(theta.tanh()):
        *_, info = batch.step(action[None])
        heights.append(info["com"][0, 1].item())
        successes += bool(info["is_success"])
        if step % 5 == 4:
            pictures.append(batch.render(muscles=True, size=256))
figure, axes = plt.subplots(1, len(pictures), figsize=(10, 2.8))
for axis, picture in zip(axes, pictures, strict=True):
    axis.imshow(picture)
    axis.set(xticks=[], yticks=[])
figure.tight_layout()
print(f"highest {max(heights) - heights[0]:.3f} m above the first step; {successes} of 20 steps count as success")

# %%
# To train a policy on it, put ``reward_fn``, ``hop`` and the line that registers it into a file ``hop.py``:
# ``python -m cfp.train --task hop:hop --out runs/hop``.

assert curve[-1] > curve[0] + 1.0
assert "dittogym/hop-fine-v0" in gymnasium.registry
