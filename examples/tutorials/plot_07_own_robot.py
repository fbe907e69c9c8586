r"""
Make a custom robot run
=======================

A robot's body can be an image file, an array, or the corners of an outline. This tutorial draws a stool, and plans
muscle actions with which it runs.
"""

# %%
# The body
# --------
#
# In this picture the bright pixels form the robot. The body is scaled to the area of the task's own robot and placed at
# its initial position, so that rewards and limits remain meaningful.

import dataclasses

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch

import dittogym
from baselines import GradientPlanner, GradientPlannerConfig

stool = np.zeros((120, 120), np.uint8)
for corner, opposite in (((10, 30), (110, 60)), ((10, 60), (35, 100)), ((85, 60), (110, 100))):
    cv2.rectangle(stool, corner, opposite, 255, cv2.FILLED)
distance = np.hypot(*np.mgrid[-50:51, -50:51])
BODIES = {
    "a picture (or its file)": stool,
    "a Boolean array": (distance < 50) & (distance > 20),
    "an outline": [(0, 0), (5, 0), (5, 2), (2, 2), (2, 5), (0, 5)],
}

figure, axes = plt.subplots(1, len(BODIES), figsize=(9, 3.2))
for axis, (name, body) in zip(axes, BODIES.items(), strict=True):
    shown = dittogym.TorchEnv("run", body=body, particles="lite")
    shown.reset(seed=0)
    axis.imshow(shown.render(size=300))
    axis.set(title=name, xticks=[], yticks=[])
figure.tight_layout()

# %%
# The actions
# -----------
#
# RUN rewards speed to the right. A planner knows the simulator: it improves the next actions by gradients of the
# reward, executes some of them, and plans again. It needs no training, whatever the body looks like. 1,000 particles
# and one second of simulated time are enough to see what this body can do.

spec = dataclasses.replace(dittogym.make_spec("run", body=stool), horizon=100)
env = dittogym.TorchEnv(spec, particles=1000)
env.reset(seed=0)
planner = GradientPlanner(env, GradientPlannerConfig(horizon=16, commit=8, iterations=4), seed=0)

# %%
# Watch it
# --------
#
# ``film`` resets the environment, plays an episode, and returns a recording, which a notebook shows as a replay. In a
# script, ``recording.save("stool.html")`` writes the replay to a file, and ``recording.save("stool.webp")`` a film.

recording = env.film(lambda observation: planner.act())
recording

# %%
travelled = (env.state.x[0, :, 0].mean() - recording.shots[0].x[:, 0].mean()).item()
print(f"{100 * travelled:.0f} cm in {recording.duration:.1f} s")

# %%
# To train a policy for this body, make it a :ref:`custom task <sphx_glr_gallery_plot_06_own_task.py>`: a function that
# returns ``dataclasses.replace(dittogym.make_spec("run", body=PICTURE), name="stool")``. With ``PICTURE =
# Path(__file__).with_name("stool.png")`` the file is found from every working directory. Targets of SHAPE MATCH can be
# pictures and outlines, too (``target=``).

assert torch.isfinite(env.state.x).all()
assert travelled > 0.1
