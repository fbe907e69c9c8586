r"""
Train a policy and watch it
===========================

This tutorial trains a policy for SHAPE MATCH from the command line for less than a minute, and watches it. Without the
options below, as in ``make demo``, training takes a few minutes and leads to a better policy.
"""

# %%
# Train
# -----
#
# The policy sees a 64 x 64 image of the robot and answers with an image of 2 x 32 x 32 muscle actions. By default it
# learns by gradients through the simulation; ``--algo cfp-sac`` learns from rewards alone, as in the paper.

import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import cfp
import dittogym

folder = tempfile.TemporaryDirectory()
out = Path(folder.name) / "star"
options = "--task shapematch --seed 0 --steps 960 --resolutions 32 --eval-every 192 --no-video"
command = [sys.executable, "-m", "cfp.train", "--out", str(out), *options.split()]
print(subprocess.run(command, check=True, capture_output=True, text=True).stdout[-600:])

# %%
# A run is a folder. If it is interrupted, the same command with ``--resume`` continues it, and the result is the same
# bit for bit. ``index.html`` shows the run in a browser.

print(*sorted(path.name for path in out.iterdir()))

with (out / "evaluations.csv").open() as file:
    evaluations = list(csv.DictReader(file))
steps, returns = ([float(row[name]) for row in evaluations] for name in ("step", "mean"))
figure, axis = plt.subplots(figsize=(7, 3))
axis.plot(steps, returns, "o-")
axis.set(xlabel="environment steps", ylabel="return of five episodes")
figure.tight_layout()

# %%
# Watch it
# --------
#
# The policy has the ``predict`` method of stable-baselines3; loading it never runs code from the file. Colours show
# the muscles: contraction is red, expansion blue.

policy = cfp.load(out)
env = dittogym.TorchEnv("shapematch", resolution=policy.resolution, particles="lite")
recording = env.film(policy, seed=7)
recording

# %%
# Films, filmstrips and replays are saved with ``recording.save("star.mp4")``, ``"star.png"`` or ``"star.html"``.

print(f"return {sum(recording.rewards):.0f}")
folder.cleanup()

assert sum(recording.rewards) > 100  # zero actions: 57
