r"""
Define a custom task
====================

A task is a dataclass with a reward function. This tutorial defines HOP, which rewards the robot's height and has its
own obstacle and success criterion. The task then works like the built-in ones: with Gymnasium, in batches, with
gradients, and with every algorithm.
"""

# %%
# The function gets a :class:`dittogym.Transition` and returns named terms, one number for each simulation of the batch.
# Each term is multiplied by its weight. The environment adds the terms that all tasks share, with a weight of 0 if none
# is given: the action cost ``action``, the penalty ``split`` for a torn robot, and ``alive``, a constant for every
# step, which HOP leaves out.

import dataclasses

import gymnasium
import matplotlib.pyplot as plt
import torch

import dittogym
from dittogym.geometry import ceiling, floor, solid


def reward_fn(transition: dittogym.Transition, spec: dittogym.TaskSpec) -> dittogym.Reward:
    """Reward height above the start; it is a success to end 3 cm higher."""
    height = transition.now.com[:, 1] - transition.start.com[:, 1]
    return dittogym.Reward({"height": height}, success=height > 0.03)


def hop(wall: int = 60, effort: float = 2e-4) -> dittogym.TaskSpec:
    """HOP, with a wall that begins at the given column of nodes, and a weight of the action cost."""
    return dataclasses.replace(
        dittogym.make_spec("run"),
        name="hop",
        horizon=20,
        reward_fn=reward_fn,
        weights={"height": 100.0, "split": 1.0, "action": effort},
        obstacles=(solid("wall", i=(wall, wall + 4), j=(None, 40)), floor(), ceiling(119)),
    )


# %%
# ``register`` creates Gymnasium ids. The arguments of the function become options of ``gymnasium.make``.

dittogym.register("hop", hop)
env = gymnasium.make("dittogym/hop-coarse-v0", particles="lite", wall=64)
observation, _ = env.reset(seed=0)
sums: dict[str, float] = {}
for _ in range(20):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    for name, value in info.items():
        if name.startswith("reward_terms/"):
            sums[name] = sums.get(name, 0.0) + float(value)
for name, value in sums.items():
    print(f"{name:30} {value:8.2f}")

# %%
# Shape the reward
# ----------------
#
# The table above is the first thing to look at: the terms of an episode with random actions, already weighted.
#
# - **Keep the terms at similar scales.** Where the action cost exceeds what a good motion earns,
#   the best policy does not move at all.
# - **Reward progress, not only the goal.** A term that is the same for all reachable states gives no gradient. Height
#   pays as soon as the robot rises a little; a bonus for 3 cm alone would not.
# - **Measure from the start** (``transition.start``), so that the return does not depend on where a robot was placed.
# - **Bound what can be exploited**: a robot can throw single particles away, so use means over the robot, clip speeds,
#   and keep the penalty ``split`` for a torn robot.
# - **Keep success separate from the reward.** Success says what you want; the reward is what the policy is trained on.
#   An episode that ends with success earns nothing afterwards, so the bonus must exceed what staying would earn.
# - **Prefer smooth functions of the particles.** Then gradients exist; for counts and thresholds, ``transition.ops``
#   has operations with smooth versions.
#
# Because ``reward_fn`` is made of torch operations, the return can be maximised by gradient ascent, a quick test of
# whether a reward leads anywhere. This is done here with two weights of the action cost:


def optimise(batch: dittogym.TorchEnv, iterations: int = 8) -> tuple[torch.Tensor, list[float]]:
    """Actions (20, 2, R, R) found by gradient ascent, and the greatest height of each iteration, m."""
    theta = torch.zeros(20, *batch.action_shape, requires_grad=True)
    adam, heights = torch.optim.Adam([theta], lr=0.2), []
    for _ in range(iterations):
        _, start = batch.reset(seed=0)
        steps = [batch.step(action[None]) for action in theta.tanh()]
        loss = -torch.stack([reward for _, reward, *_ in steps]).sum()
        adam.zero_grad()
        loss.backward()
        adam.step()
        heights.append(max((info["com"] - start["com"])[0, 1].item() for *_, info in steps))
    return theta.detach().tanh(), heights


figure, axis = plt.subplots(figsize=(7, 3))
found = {}
for effort in (1e-2, 2e-4):
    batch = dittogym.TorchEnv("hop", effort=effort, particles="lite")
    actions, heights = optimise(batch)
    found[effort] = batch, actions, heights
    axis.plot([100 * height for height in heights], "o-", label=f"weight of the action cost {effort:g}")
axis.set(xlabel="iteration", ylabel="greatest height, cm")
axis.legend()
figure.tight_layout()

# %%
# Watch it
# --------

batch, actions, heights = found[2e-4]
recording = batch.film(lambda observation: actions[None, batch.env_state.steps[0]])
recording

# %%
# To train a policy on it, put ``reward_fn``, ``hop`` and the line that registers it into a file ``hop.py``:
# ``torchmpm train --task hop:hop --out runs/hop``.

assert heights[-1] > heights[0] + 0.005
assert heights[-1] > 2 * found[1e-2][2][-1]
assert "dittogym/hop-fine-v0" in gymnasium.registry
